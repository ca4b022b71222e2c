"""Answer card: the probability and its conditions in words."""

from __future__ import annotations

from typing import Any

import numpy as np

from mauvecl.web.closed_forms import ClosedForms, between, percent, short
from mauvecl.web.tabs.tab import Answers

#: Part of the message about the throughput, which the page shows once.
NOMINAL = "The throughput is nominal"
#: Answers whose messages are shown, since they include those of the others.
TOLD = ("detection", "measure", "completeness", "visible", "plan")
#: Sensible relative uncertainty of the nominal throughput (assumed; see the documentation's page on what is nominal).
THROUGHPUT = 0.3


def card(closed: ClosedForms, answers: Answers) -> dict[str, Any]:
    """Return the contents of the card.

    Returns
    -------
    dict
        ``shown``, ``interval`` and ``words``; ``facts``, pairs of names and values; ``notes``, pairs of sentences and
        kinds; ``simulated``, names of what is simulated.
    """
    q, x = closed.question, closed.quiet
    cut, chance, interval, facts = closed.odds.threshold, closed.chance, f"in closed form{_spread(closed)}", []
    if "detection" in answers:
        (row,) = (row for row in answers["detection"].table if row["statistic"] == q.statistic)
        cut, chance = float(row["threshold"]), float(row["probability"])
        interval = f"{between(row['low'], row['high'])}, of {q.realisations.number:,} simulated"
        facts.append(("ClosedForms form", percent(closed.chance)))
    facts += [
        ("Threshold", f"{cut:.4g}" if cut == cut else "none"),
        ("Expected with flare", f"{closed.odds.flaring.mean:.4g}"),
        ("Best S/N per pixel", short(x.snr().max())),
        ("Best S/N per element", short(x.snr_per_element().max())),
    ]
    words = (
        f"chance to detect {closed.words}, by the statistic {q.statistic} at a false-alarm probability of {q.fap:g} "
        "per test"
    )
    # Severe messages begin in capitals.
    notes = [(m, "danger" if m.partition(":")[0].isupper() else "info") for m in _messages(closed, answers)]
    return {
        "shown": percent(chance),
        "value": None if chance != chance else chance,
        "interval": interval,
        "words": words,
        "facts": facts,
        "notes": notes,
        "simulated": sorted(name for name in answers if name not in ("snr", "draw", "seen")),
    }


def _spread(closed: ClosedForms) -> str:
    """Describe the effect of the throughput's uncertainty on a probability."""
    if closed.slow or closed.chance != closed.chance:
        return ""
    ends = [odds.probability for much in (-1, 1) for odds in closed.at(1 + much * THROUGHPUT, np.ones(1), sky=True)]
    return f"; {between(min(ends), max(ends))} if the throughput is {100 * THROUGHPUT:g} % lower or higher"


def _messages(closed: ClosedForms, answers: Answers) -> list[str]:
    of_answers = [m for name in TOLD if name in answers for m in answers[name].messages]
    return [m for m in dict.fromkeys([*of_answers, *closed.messages]) if not m.startswith(NOMINAL)]
