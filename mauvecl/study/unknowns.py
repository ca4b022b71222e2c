"""What is unknown of the instrument, and the same with a flare and without: drawn from priors, and averaged over.

An observer measures the instrument, and takes reference and threshold from it; while a proposal is written it is
unknown. So each draw of the unknown values has its own reference and threshold, and a detection probability is the
average.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.host.errors import InputError
from mauvecl.results.requests.fap import MIN_IN_TAIL
from mauvecl.statistics.intervals import CONFIDENCE, Interval

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.study.study import Study

Float = NDArray[np.float64]

#: What no unknown explains by a straight line.
REST = "the rest"


@dataclass(frozen=True, eq=False)
class DrawnStudies:
    """Values of the unknown, one row a draw.

    Attributes
    ----------
    names : tuple of str
    values : ndarray, shape (n_draw, n_name)
    studies : tuple of Study
        The study on each draw's instrument, nothing unknown any more, with its part of the realisations.
    """

    names: tuple[str, ...]
    values: Float
    studies: tuple[Study, ...]


def drawn(study: Study) -> DrawnStudies:
    """Draws from the study's priors, even in each of them (a Latin hypercube, seeded with the study's seed).

    Raises
    ------
    InputError
        If a prior reaches where the instrument cannot be, or everything is known.
    """
    from scipy.stats import qmc

    asked, priors = study.unknowns, study.unknown_priors()
    sequence = qmc.LatinHypercube(len(priors), rng=np.random.default_rng(study.run.seed))
    even = sequence.random(asked.draws)
    values = np.column_stack([prior.quantile(even[:, k]) for k, prior in enumerate(priors.values())])
    area = study.load_instrument().collecting_area_cm2
    run = study.run.model_copy(update={"realisations": realisations_each(study)})
    certain = study.model_copy(update={"unknowns": type(asked)(), "run": run})
    studies = []
    for row in values:
        changes = dict(zip(priors, (float(v) for v in row), strict=True))
        if "qe_scale" in changes:
            # It scales all light alike, as the area does.
            changes["collecting_area_cm2"] = changes.pop("qe_scale") * area
        changed = certain.with_instrument(changes)
        try:
            changed.load_instrument()
        except InputError as error:
            raise InputError(f"the priors of what is unknown reach too far: {error}") from error
        studies.append(changed)
    return DrawnStudies(tuple(priors), values, tuple(studies))


def realisations_each(study: Study) -> int:
    """Realisations for each draw: as many in all as asked for, but enough to count each draw's threshold."""
    run = study.run
    fewest = int(np.ceil(MIN_IN_TAIL / run.fap)) if run.tails == "counted" else 1000
    return max(run.realisations // study.unknowns.draws, fewest)


def average(intervals: Sequence[Interval]) -> Interval:
    """The mean of probabilities over draws of the unknown, with 95 % for their own errors and the number of draws.

    Draws are even, so that the interval, made for independent ones, errs on the wide side.
    """
    values = np.array([p.value for p in intervals])
    own = np.array([p.high - p.low for p in intervals]) / 2
    reach = float(special.ndtri(0.5 + CONFIDENCE / 2))
    spread = values.std(ddof=1) / np.sqrt(values.size) if values.size > 1 else 0.0
    half = float(np.hypot(reach * spread, np.sqrt(np.sum(own**2)) / values.size))
    mean = float(values.mean())
    return Interval(mean, max(mean - half, 0.0), min(mean + half, 1.0))


def shares(draws: DrawnStudies, outcome: Float) -> dict[str, float]:
    """Share of an outcome's variance that each unknown explains, the largest first, and the rest; one in all.

    The shares are what each adds to a linear fit, averaged over all orders of adding them (Lindeman, Merenda & Gold
    1980; Groemping 2007, doi 10.1198/000313007X188252): draws that are few are not quite independent, and single slopes
    would count twice what two of them share. The rest, last, is what no straight line explains.

    Parameters
    ----------
    draws : DrawnStudies
    outcome : ndarray, shape (n_draw,)
    """
    names, kept = draws.names, np.isfinite(outcome)
    x, y = draws.values[kept], outcome[kept]
    if len(y) <= x.shape[1] + 1 or y.std() == 0.0:
        return dict.fromkeys((*names, REST), float("nan"))
    scaled = (x - x.mean(axis=0)) / x.std(axis=0)
    explained = {(): 0.0} | {
        some: _explained(scaled[:, some], y)
        for size in range(1, len(names) + 1)
        for some in itertools.combinations(range(len(names)), size)
    }
    share = np.zeros(len(names))
    for some, value in explained.items():
        for k in set(range(len(names))) - set(some):
            # So many orders have exactly these before it.
            weight = 1.0 / (len(names) * math.comb(len(names) - 1, len(some)))
            share[k] += weight * (explained[tuple(sorted((*some, k)))] - value)
    parts = {names[k]: float(share[k]) for k in np.argsort(-share)}
    return parts | {REST: 1.0 - explained[tuple(range(len(names)))]}


def _explained(x: Float, y: Float) -> float:
    """Share of the variance that a linear fit explains."""
    straight = np.column_stack([x, np.ones(len(y))])
    left = y - straight @ np.linalg.lstsq(straight, y, rcond=None)[0]
    return float(1.0 - left.var() / y.var())


def draws_table(draws: DrawnStudies, outcomes: dict[str, Float]) -> QTable:
    """One row per draw: the unknown values, and what came of them."""
    from astropy.table import QTable

    table = QTable({name: draws.values[:, k] for k, name in enumerate(draws.names)})
    for name, values in outcomes.items():
        table[name] = values
    return table
