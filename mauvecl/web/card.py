"""Answer card: the probability and its conditions in words."""

from __future__ import annotations

from typing import Any

from mauvecl.answers.detection.chance_with_unknowns import BOTH_CHANCES
from mauvecl.schema.messages import of_kind
from mauvecl.web.closed_forms import ClosedForms, percent, short
from mauvecl.web.headline import TITLES, chances
from mauvecl.web.sentences import note
from mauvecl.web.simulations import OTHER
from mauvecl.web.tabs import TABS
from mauvecl.web.tabs.tab import Answers, Tab

#: Part of the message about the throughput, which the page shows once.
NOMINAL = "The throughput is nominal"
#: Answers whose messages are shown, since they include those of the others.
TOLD = ("detection", "measure")


def card(closed: ClosedForms, answers: Answers) -> dict[str, Any]:
    """Return the contents of the card.

    Returns
    -------
    dict
        ``numbers``, one for each choice of what is unknown; ``chosen``, ``shown`` and ``interval`` of the question's
        choice, and ``words``; ``facts``, pairs of names and values; ``notes``, pairs of sentences and kinds;
        ``simulated``, names of what is simulated; ``files``, tabs and names of downloads.
    """
    q, x = closed.question, closed.quiet
    cut, both = closed.odds.threshold, chances(closed, answers)
    (chosen,) = (one for one in both if one.unknown == q.unknown)
    facts = []
    if "detection" in answers:
        (row,) = (row for row in answers["detection"].table if row["statistic"] == q.statistic)
        cut = float(row["threshold"])
        facts.append(("In closed form", percent(closed.chance)))
    facts += [
        ("Threshold", f"{cut:.4g}" if cut == cut else "none"),
        ("Expected with flare", f"{closed.odds.flaring.mean:.4g}"),
        ("Best S/N per pixel", short(x.snr().max())),
        ("Best S/N per element", short(x.snr_per_element().max())),
    ]
    words = (
        f"chance to detect {closed.words}, by the statistic {q.statistic} at a false-alarm probability of {q.fap:g} "
        f"per test, with the payload {q.instrument}"
    )
    return {
        "headline": True,
        "numbers": [one.shown for one in both],
        "chosen": q.unknown,
        "shown": percent(chosen.value),
        "interval": f"{TITLES[q.unknown]}; {chosen.how}",
        "words": words,
        "facts": facts,
        "notes": _with_kinds(_messages(closed, answers)),
        "simulated": _simulated(answers),
        "files": _files(answers),
    }


def without_headline(tab: Tab, closed: ClosedForms, answers: Answers) -> dict[str, Any]:
    """Return the `card` of a tab that asks for no chance of detection."""
    messages = list(answers[tab.answer].messages) if tab.answer in answers else []
    return {
        "headline": False,
        "numbers": [],
        "chosen": "",
        "shown": tab.title,
        "interval": "",
        "words": tab.words(closed.question),
        "facts": [],
        "notes": _with_kinds([m for m in dict.fromkeys(messages) if not m.startswith(NOMINAL)]),
        "simulated": _simulated(answers),
        "files": _files(answers),
    }


def _simulated(answers: Answers) -> list[str]:
    return sorted(name for name in answers if name not in ("snr", "draw", "seen", OTHER))


def _files(answers: Answers) -> list[str]:
    tables = [f"{tab.name} {name}" for tab in TABS.values() for name in tab.files if tab.offers(name, answers)]
    return tables + [
        f"{tab.name} {name}" for tab in TABS.values() for name, of in tab.documents.items() if of in answers
    ]


def _with_kinds(messages: list[str]) -> list[tuple[str, str]]:
    """Return messages with their kinds: severe ones begin in capitals."""
    return [(note(m), "danger" if m.partition(":")[0].isupper() else "info") for m in messages]


def _messages(closed: ClosedForms, answers: Answers) -> list[str]:
    of_answers = [m for name in TOLD if name in answers for m in answers[name].messages]
    # The card shows both chances itself.
    both = of_kind(of_answers, BOTH_CHANCES)
    return [m for m in dict.fromkeys([*of_answers, *closed.messages]) if not m.startswith(NOMINAL) and m not in both]
