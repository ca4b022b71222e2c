"""Loss of a flare's S/N to unknown instrument values, by closed forms (METHODS section 7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection.nuisances import Nuisances, join_names
from mauvecl.detection.statistics import Matched, Setting
from mauvecl.noise.unknowns import DOCUMENTED_NUISANCES, NUISANCES, PROCESSES, Amplitude
from mauvecl.schema.errors import InputError
from mauvecl.schema.messages import Message
from mauvecl.study.nuisances import NuisanceChoice

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.noise.comparison import Comparison


@dataclass(frozen=True)
class Cost:
    """S/N of a flare by the matched statistic."""

    of: str  # star and flare
    known: float  # with everything known
    plain: float  # with unknowns that scatter the statistic, which ignores them
    marginal: float  # with a statistic that is marginalised over them


def unknown_cost(
    of: str, quiet: Expectation, flare: Expectation, nuisances: NuisanceChoice, comparison: Comparison
) -> Cost:
    """Return the S/N of a flare with and without unknowns, or with the documented ones if none are given.

    `of` names star and flare.
    """
    chosen, used, matched = _or_documented(nuisances), ~quiet.saturated, Matched()
    unknown = chosen.marginalised(quiet)
    plain = Setting(quiet, used, comparison)
    delta = np.where(used, flare.recorded_light_dn - quiet.recorded_light_dn, 0.0)
    if unknown is None or not delta.any():
        return Cost(of, 0.0, 0.0, 0.0)
    weights = matched.plain_weights(plain, flare)
    known = float(weights @ delta)
    spread = scatter(unknown, usual=chosen.usual) * np.abs(unknown.spectra @ weights)
    try:
        marginal = matched.weights_per_dn(Setting(quiet, used, comparison, nuisances=unknown), flare)
    except InputError:
        # The flare has the spectrum of an unknown.
        marginal = np.zeros_like(weights)
    return Cost(of, known, float(known / np.sqrt(1.0 + np.sum(spread**2))), float(marginal @ delta))


def scatter(unknown: Nuisances, *, usual: bool) -> NDArray[np.float64]:
    """Return the standard deviations of nuisance amplitudes, shape (k,): as drawn by default, or else of the prior."""
    drawn = {row.name: row.scatter for row in DOCUMENTED_NUISANCES if usual}
    return np.array(
        [drawn.get(name, sd) if np.isinf(sd) else sd for name, sd in zip(unknown.names, unknown.sd, strict=True)]
    )


def cost_lines(costs: Sequence[Cost], nuisances: NuisanceChoice) -> list[str]:
    """Return a sentence on the faintest flare, or none if no flare has a signal."""
    shown = [cost for cost in costs if cost.known > 0]
    if not shown:
        return []
    faintest = min(shown, key=lambda cost: cost.known)
    named = nuisances != NuisanceChoice()
    which = spoken(nuisances) if named else f"the usual unknowns ({spoken(_or_documented(nuisances))})"
    others = f", the faintest of {len(shown)}," if len(shown) > 1 else ""
    text = (
        f"What unknowns cost: {faintest.of}{others} has a matched S/N of {faintest.known:.3g} with everything known; "
        f"with {which} it is {faintest.plain:.2g} by the plain statistic and {faintest.marginal:.3g} marginalised "
        "(closed forms)."
    )
    return [Message(text, "cost of unknowns")]


def marginal_lines(nuisances: NuisanceChoice) -> list[str]:
    """Return a sentence on what statistics are marginalised over and which unknowns are drawn, or none."""
    if nuisances == NuisanceChoice():
        return []
    texts = [PROCESSES[row.process].drawn for row in DOCUMENTED_NUISANCES]
    drawn = f"; drawn: {'; '.join(texts)}" if nuisances.usual else ""
    return [f"Statistics are marginalised over {spoken(nuisances)}{drawn}."]


def spoken(choice: NuisanceChoice) -> str:
    """Return the unknowns as text, such as "the dark level (+-0.5 deg C) and the light level (free)"."""
    documented = DOCUMENTED_NUISANCES if choice.usual else ()
    sd: dict[str, float | str] = {row.name: row.prior.sd for row in documented if isinstance(row.prior, Amplitude)}
    sd |= choice.spreads()
    sizes = [f"{NUISANCES[name].label} ({_size(value, NUISANCES[name].unit)})" for name, value in sd.items()]
    return join_names(sizes + [f"{name!r} ({_size(one.sd, '')})" for name, one in choice.own.items()])


def _size(sd: float | str, unit: str) -> str:
    if sd in ("free", float("inf")):
        return "free"
    return f"+-{100 * float(sd) if unit == '%' else float(sd):g} {unit}".rstrip()


def _or_documented(nuisances: NuisanceChoice) -> NuisanceChoice:
    return nuisances if nuisances != NuisanceChoice() else NuisanceChoice(usual=True)
