"""Averages over unknown instrument values, which are constant and drawn from priors.

The instrument will be calibrated before observers choose reference and threshold, but is unknown when a proposal is
written. Each draw of the unknown values therefore has its own reference and threshold, and detection probabilities are
averaged over draws.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.detection.distributions import CONFIDENCE, Interval
from mauvecl.detection.fap_checks import MIN_IN_TAIL
from mauvecl.noise.unknowns import ThroughputMode, values_of
from mauvecl.schema.errors import InputError
from mauvecl.schema.tables import Column
from mauvecl.study.parts import First

if TYPE_CHECKING:
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.noise.disturbances import Prior
    from mauvecl.study.cases import Case
    from mauvecl.study.study import Study

Float = NDArray[np.float64]

#: Name of the variance that no unknown explains linearly.
REST = "the rest"


@dataclass(frozen=True, eq=False)
class DrawnStudies:
    """Draws of unknown instrument values."""

    names: tuple[str, ...]
    labels: tuple[str, ...]
    values: Float  # shape (n_draw, n_name)
    studies: tuple[Study, ...]  # the study with each draw's instrument, without unknowns, and its share of realisations

    @property
    def by_name(self) -> dict[str, Float]:
        """Drawn values of each unknown."""
        return dict(zip(self.names, self.values.T, strict=True))


def drawn(study: Study) -> DrawnStudies:
    """Draw instrument values from a study's priors, as a Latin hypercube with the study's seed.

    Raises
    ------
    InputError
        If a prior includes values that the instrument cannot have, or nothing is unknown.
    """
    from scipy.stats import qmc

    asked = study.unknowns
    nominal = study.observation.load_instrument()
    rows, priors = values_of(nominal), _unknown_priors(study, nominal)
    sequence = qmc.LatinHypercube(len(priors), rng=np.random.default_rng(study.run.seed))
    even = sequence.random(asked.draws)
    values = np.column_stack([prior.quantile(even[:, k]) for k, prior in enumerate(priors.values())])
    run = study.run.model_copy(update={"realisations": realisations_each(study)})
    certain = study.model_copy(update={"unknowns": type(asked)(), "run": run})
    studies = []
    for row in values:
        changes: dict[str, Any] = {}
        at = nominal
        for name, value in zip(priors, row, strict=True):
            one = rows[name].changes(at, float(value))
            changes |= one
            # The next mode is added to those before it.
            at = at.model_copy(update=one) if isinstance(rows[name], ThroughputMode) else at
        changed = certain.with_instrument(changes)
        try:
            nominal.with_(**changes)
        except InputError as error:
            raise error.within("the priors of unknown values include impossible ones") from error
        studies.append(changed)
    return DrawnStudies(tuple(priors), tuple(rows[name].label for name in priors), values, tuple(studies))


def throughput_cases(case: Case) -> list[Case]:
    """Return the case with each mode of its calibration at one standard deviation; empty if it has none.

    The sign of a mode is arbitrary; it is chosen so that the same pixels lie in the output range. Raises InputError if
    the wavelengths are not known well enough for that.
    """
    moved, pixels = [], case.instrument.read_pixels
    for mode in values_of(case.instrument).values():
        if isinstance(mode, ThroughputMode):
            signs = (replace(case, study=case.study.with_instrument(mode.changes(case.instrument, x))) for x in (1, -1))
            same = next((one for one in signs if one.instrument.read_pixels == pixels), None)
            if same is None:
                raise InputError(
                    "an error of the calibrated wavelengths changes the pixels of the output range",
                    "an output range that ends further from a pixel",
                    key="observation.instrument",
                )
            moved.append(same)
    return moved


def _unknown_priors(study: Study, nominal: Instrument) -> dict[str, Prior]:
    """Return the priors of unknown values of a study's instrument; values that the study sets are known."""
    o = study.observation
    known = {*o.changes, *(() if o.temperature_c is None else ("temperature_c",))}
    priors = {name: prior for name, prior in study.unknowns.priors(nominal).items() if name not in known}
    if study.unknowns.draws and not priors:
        raise InputError("no instrument value is unknown", "a prior, or unknowns.draws = 0", key="unknowns.draws")
    return priors


def realisations_each(study: Study) -> int:
    """Return the realisations per draw: an equal share, but enough to count the threshold of each draw."""
    run, draws = study.run, int(study.unknowns.draws)
    fewest = int(np.ceil(MIN_IN_TAIL / run.fap)) if run.tails == "counted" else 1000
    return max(run.realisations // draws, fewest)


def average(intervals: Sequence[Interval]) -> Interval:
    """Return the mean of probabilities over draws, with a 95 % interval for their own errors and the number of draws.

    The interval assumes independent draws and is therefore conservative for a Latin hypercube.
    """
    values = np.array([p.value for p in intervals])
    own = np.array([p.high - p.low for p in intervals]) / 2
    reach = float(special.ndtri(0.5 + CONFIDENCE / 2))
    spread = values.std(ddof=1) / np.sqrt(values.size) if values.size > 1 else 0.0
    half = float(np.hypot(reach * spread, np.sqrt(np.sum(own**2)) / values.size))
    mean = float(values.mean())
    return Interval(mean, max(mean - half, 0.0), min(mean + half, 1.0))


def shares(draws: DrawnStudies, outcome: Float) -> dict[str, float]:
    """Return the share of an outcome's variance that each unknown explains, largest first, and the unexplained rest.

    A share is the mean increase of the explained variance when the unknown is added to a linear fit, over all orders of
    adding them (Lindeman, Merenda & Gold 1980; Groemping 2007, doi 10.1198/000313007X188252). Shares from single slopes
    would count variance twice, since a few draws are correlated by chance.

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
            # Fraction of orders in which exactly these precede unknown k.
            weight = 1.0 / (len(names) * math.comb(len(names) - 1, len(some)))
            share[k] += weight * (explained[tuple(sorted((*some, k)))] - value)
    parts = {names[k]: float(share[k]) for k in np.argsort(-share)}
    return parts | {REST: 1.0 - explained[tuple(range(len(names)))]}


def _explained(x: Float, y: Float) -> float:
    """Return the share of the variance that a linear fit explains."""
    straight = np.column_stack([x, np.ones(len(y))])
    left = y - straight @ np.linalg.lstsq(straight, y, rcond=None)[0]
    return float(1.0 - left.var() / y.var())


#: Unknowns whose shares of a scatter are named, at most.
MAX_NAMED = 3


def describe_shares(shares: Mapping[str, float]) -> str:
    """Return the largest shares of a scatter in words, and how many there are."""
    first = First(shares.items(), MAX_NAMED, "unknowns")
    note = f" ({first.note})" if first.note else ""
    return ", ".join(f"{name} {100 * share:.0f} %" for name, share in first) + note


def draw_columns(draws: DrawnStudies) -> tuple[Column, ...]:
    """Return the columns of the drawn values of unknowns, for rows with `draws`."""
    return tuple(
        Column(name, description=f"drawn {label}").of(lambda row: row.draws.by_name)
        for name, label in zip(draws.names, draws.labels, strict=True)
    )
