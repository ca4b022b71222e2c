"""What it costs not to know all of the instrument: a flare's S/N by closed forms (METHODS section 7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.noise.unknowns import DOCUMENTED_NUISANCES, NUISANCES, PROCESSES, Amplitude
from mauvecl.schema.errors import InputError
from mauvecl.statistics.linear import Matched
from mauvecl.statistics.nuisances import Nuisances, join_names
from mauvecl.statistics.statistic import Setting
from mauvecl.study.nuisances import NuisanceChoice

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.study.study import Study


@dataclass(frozen=True)
class Cost:
    """The S/N of one flare by the matched statistic.

    Attributes
    ----------
    of : str
        Star and flare.
    known : float
        With everything known.
    plain : float
        Where things are unknown, and the statistic does not know of it: its noise has their scatter.
    marginal : float
        Where it is marginalised over them.
    """

    of: str
    known: float
    plain: float
    marginal: float


def unknown_cost(of: str, quiet: Expectation, flare: Expectation, study: Study) -> Cost:
    """What a study's unknowns cost, or the documented ones where it names none.

    Parameters
    ----------
    of : str
        Star and flare, for the reader.
    quiet, flare : Expectation
    study : Study
    """
    unknown = _chosen(study).marginalised(quiet)
    used, comparison, matched = ~quiet.saturated, study.run.comparison(), Matched()
    plain = Setting(quiet, used, comparison)
    delta = np.where(used, flare.recorded_light_dn - quiet.recorded_light_dn, 0.0)
    if unknown is None or not delta.any():
        return Cost(of, 0.0, 0.0, 0.0)
    weights = matched.plain_weights(plain, flare)
    known = float(weights @ delta)
    spread = scatter(unknown, usual=_chosen(study).usual) * np.abs(unknown.spectra @ weights)
    try:
        marginal = matched.weights_per_dn(Setting(quiet, used, comparison, nuisances=unknown), flare)
    except InputError:
        # What is looked for is what is unknown.
        marginal = np.zeros_like(weights)
    return Cost(of, known, float(known / np.sqrt(1.0 + np.sum(spread**2))), float(marginal @ delta))


def scatter(unknown: Nuisances, *, usual: bool) -> NDArray[np.float64]:
    """How far amplitudes scatter, shape (k,): as drawn where they are the documented ones, else their prior."""
    drawn = {row.name: row.scatter for row in DOCUMENTED_NUISANCES if usual}
    return np.array(
        [drawn.get(name, sd) if np.isinf(sd) else sd for name, sd in zip(unknown.names, unknown.sd, strict=True)]
    )


def cost_lines(costs: Sequence[Cost], study: Study) -> list[str]:
    """One sentence on the faintest flare; none where no flare shows."""
    shown = [cost for cost in costs if cost.known > 0]
    if not shown:
        return []
    faintest = min(shown, key=lambda cost: cost.known)
    named = study.nuisances != NuisanceChoice()
    which = spoken(study.nuisances) if named else f"the usual unknowns ({spoken(_chosen(study))})"
    others = f", the faintest of {len(shown)}," if len(shown) > 1 else ""
    return [
        f"What unknowns cost: {faintest.of}{others} has a matched S/N of {faintest.known:.3g} with everything known; "
        f"with {which} it is {faintest.plain:.2g} by the plain statistic and {faintest.marginal:.3g} marginalised "
        "(closed forms)."
    ]


def marginal_lines(study: Study) -> list[str]:
    """What the statistics of an answer are marginalised over, and what is drawn for it."""
    if study.nuisances == NuisanceChoice():
        return []
    texts = [PROCESSES[row.process].drawn for row in DOCUMENTED_NUISANCES]
    drawn = f"; drawn: {'; '.join(texts)}" if study.nuisances.usual else ""
    return [f"Statistics are marginalised over {spoken(study.nuisances)}{drawn}."]


def spoken(choice: NuisanceChoice) -> str:
    """Unknowns in a sentence: the dark level (+-0.5 deg C) and the light level (free)."""
    documented = DOCUMENTED_NUISANCES if choice.usual else ()
    sd: dict[str, float | str] = {row.name: row.prior.sd for row in documented if isinstance(row.prior, Amplitude)}
    sd |= choice.spreads()
    sizes = [f"{NUISANCES[name].label} ({_size(value, NUISANCES[name].unit)})" for name, value in sd.items()]
    return join_names(sizes + [f"{name!r} ({_size(one.sd, '')})" for name, one in choice.own.items()])


def _size(sd: float | str, unit: str) -> str:
    if sd in ("free", float("inf")):
        return "free"
    return f"+-{100 * float(sd) if unit == '%' else float(sd):g} {unit}".rstrip()


def _chosen(study: Study) -> NuisanceChoice:
    return study.nuisances if study.nuisances != NuisanceChoice() else NuisanceChoice(usual=True)
