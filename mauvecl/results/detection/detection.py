"""Thresholds with a known false-alarm probability, and detection probabilities with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.content_equality import ContentEquality
from mauvecl.results.counts.tally import Distribution, TailSamples, Tally
from mauvecl.results.detection.roc import Roc
from mauvecl.results.detection.tails import Tail, tail
from mauvecl.results.requests.channels import ChannelPlan, Key
from mauvecl.results.requests.fap_checks import NoThresholdError, Tails, check_atom, check_fap, countable
from mauvecl.results.requests.hypotheses import Hypotheses
from mauvecl.schema.calls import validated
from mauvecl.schema.drawable import Drawable
from mauvecl.schema.fields import Range
from mauvecl.schema.messages import Message
from mauvecl.schema.tables import INTERVAL, Column, interval, number, table_of
from mauvecl.statistics.detection_interval import detection_interval
from mauvecl.statistics.intervals import Interval, central_counts, clopper_pearson
from mauvecl.statistics.statistic import LinearStatistic

if TYPE_CHECKING:
    from astropy.table import QTable


@validated
@dataclass(eq=False)
class Detection(Drawable, ContentEquality, Hypotheses):
    """Simulated null and flare distributions, as returned by `Engine.detect`.

    Attributes are those of `Hypotheses` and the following.

    Attributes
    ----------
    realisations : int
    tails : {"counted", "sampled"}
        Whether a threshold with too few realisations beyond it raises InputError, or is found by importance sampling.
    seed : int
        Seed of the draws.
    """

    realisations: int
    tails: Tails = "counted"
    seed: int = 0
    _tails: dict[tuple[str, int, float], Tail] = field(default_factory=dict, init=False, repr=False, compare=False)
    _distributions: dict[Key, Distribution] = field(default_factory=dict, init=False, repr=False)
    _samples: dict[Key, TailSamples] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, hypotheses: Hypotheses, realisations: int, tails: Tails, seed: int) -> Self:
        """Make a detection that shares the prepared state and closed forms of `hypotheses`."""
        made = object.__new__(cls)
        counts: dict[str, Any] = {"_tails": {}, "_distributions": {}, "_samples": {}}
        vars(made).update(vars(hypotheses) | counts, realisations=realisations, tails=tails, seed=seed)
        return made

    def _line(self) -> str:
        flares, names = len(self.flares), ", ".join(self.statistics)
        return (
            f"of {self.quiet.name!r}, {flares} flare{'s'[: flares != 1]} by {names}, {self.realisations} realisations"
        )

    def collect(self, plan: ChannelPlan, tally: Tally, samples: Sequence[TailSamples | None]) -> None:
        """Add the distributions and tails of one batch."""
        for index, (key, kept) in enumerate(zip(plan.keys, samples, strict=True)):
            self._distributions[key] = tally.distribution(index)
            if kept is not None:
                self._samples[key] = kept

    def distribution(self, statistic: str, flare: int | None = None, *, template: int = 0) -> Distribution:
        """Return the simulated distribution of a statistic.

        Parameters
        ----------
        statistic : str
        flare : int, optional
            Index of the flare; None for the null distribution.
        template : int
            Index of the flare that shaped statistics use as template, for the null distribution.
        """
        self._check(statistic, flare, template)
        if flare is None:
            return self._at(self._null_key(statistic, template))
        return self._at((statistic, "flare", flare))

    def _at(self, key: Key) -> Distribution:
        """Return a counted distribution; raises InputError if values are not finite."""
        statistic, role, flare = key
        counted = self._distributions[key]
        of = "without a flare" if role == "null" else f"with flare {flare + 1}"
        counted.refuse_undefined(f"statistic {statistic!r} {of}")
        return counted

    def histogram(
        self, statistic: str, flare: int | None = None, *, template: int = 0, bins: Annotated[int, Range(1)] = 200
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return edges and counts for plots; parameters as for `distribution`."""
        return self.distribution(statistic, flare, template=template).histogram(bins)

    def threshold(self, fap: float = 1e-3, statistic: str = "chi2", *, template: int = 0) -> Interval:
        """Return the threshold at a false-alarm probability.

        Parameters
        ----------
        fap : float
            False-alarm probability per test.
        statistic : str
        template : int
            Index of the flare that shaped statistics use as template.

        Returns
        -------
        Interval
            The simulated upper quantile, rounded up to a bin's edge (1/512 of a standard deviation, or 2**-13 of the
            value beyond 32 of them), with an order-statistic interval; or the result of importance sampling, if tails
            are sampled and too few realisations lie beyond.

        Raises
        ------
        InputError
            If fewer than 100 realisations lie beyond and tails are counted: the tail is never extrapolated.
        NoThresholdError
            If no threshold has this probability, because one value of the statistic is more probable.
        """
        return self._cut(fap, statistic, template)

    def tail(self, fap: float, statistic: str = "chi2", *, template: int = 0) -> Tail | None:
        """Return the importance sampling behind a threshold, or None if realisations were counted."""
        self._check(statistic, None, template)
        check_fap(fap, self.realisations, self.tails)
        if countable(fap, self.realisations):
            return None
        key = (statistic, self._null(statistic, template), fap)
        if key not in self._tails:
            self._tails[key] = tail(self, fap, statistic, template=template, seed=self.seed)
        return self._tails[key]

    def false_alarm_probability(self, threshold: float, statistic: str = "chi2", *, template: int = 0) -> Interval:
        """Return the fraction of null realisations at or above a threshold; the inverse of `threshold`.

        The fraction is exact at edges of bins, such as counted thresholds, and interpolated linearly within a bin.
        """
        null = self.distribution(statistic, template=template)
        return self._share_above(null, Interval(threshold, threshold, threshold))

    def detection_probability(self, fap: float = 1e-3, statistic: str = "chi2") -> list[Interval]:
        """Return the fraction of realisations at or above the threshold for each flare.

        The interval has 95 % coverage for the probability above the true threshold; see `detection_interval`. The
        values are NaN for `blinding` flares, and if no threshold has the false-alarm probability (`without_threshold`).
        """
        probabilities = []
        for flare in range(len(self.flares)):
            if flare in self.blinding:
                probabilities.append(Interval(np.nan, np.nan, np.nan))
                continue
            try:
                cut = self._cut(fap, statistic, flare)
            except NoThresholdError:
                probabilities.append(Interval(np.nan, np.nan, np.nan))
                continue
            counted = self._at((statistic, "flare_on_null_grid", flare))
            above = [counted.above(value) for value in (cut.value, cut.high, cut.low)]
            shared = 0.0
            if countable(fap, self.realisations) and counted.std > 0:
                # A flare only adds uncorrelated noise; tilted draws are independent of the flare's.
                shared = min(self._at(self._null_key(statistic, flare)).std / counted.std, 1.0)
            probabilities.append(detection_interval(above, counted.n, fap, shared))
        return probabilities

    def without_threshold(self, fap: float) -> tuple[Message, ...]:
        """Return a sentence for each statistic of which no threshold has a false-alarm probability."""
        sentences = []
        for statistic in self.statistics:
            for template in range(len(self.flares)) if self.statistic(statistic).shaped else (0,):
                try:
                    self._cut(fap, statistic, template)
                except NoThresholdError as error:
                    sentences.append(Message(f"NO THRESHOLD: {error}.", "no threshold"))
        return tuple(dict.fromkeys(sentences))

    @staticmethod
    def _share_above(distribution: Distribution, cut: Interval) -> Interval:
        """Return the fraction at or above a threshold, with an interval that includes the threshold's."""
        value, low, high = (distribution.above(x) for x in (cut.value, cut.high, cut.low))
        return Interval(
            value / distribution.n,
            clopper_pearson(int(np.floor(low)), distribution.n).low,
            clopper_pearson(int(np.ceil(high)), distribution.n).high,
        )

    def quantile(
        self, probability: float, statistic: str = "chi2", flare: int | None = None, *, template: int = 0
    ) -> Interval:
        """Return a quantile of a simulated distribution with its order-statistic interval; see `distribution`."""
        return self.distribution(statistic, flare, template=template).quantile_interval(probability)

    def tail_samples(self, statistic: str = "chi2", flare: int | None = None, *, template: int = 0) -> QTable:
        """Return the 1000 largest values of a null, or the smallest of a flare, with their realisations.

        `Engine.realise` with the same seed draws the spectrum of a realisation again.

        Returns
        -------
        QTable
            ``realisation`` and ``value``, the most extreme first.
        """
        self._check(statistic, flare, template)
        key: Key = (statistic, "flare", flare) if flare is not None else self._null_key(statistic, template)
        self._at(key)
        return table_of(TAIL_COLUMNS, [self._samples[key]])

    def roc(self, statistic: str = "chi2", flare: int = 0) -> Roc:
        """Return the ROC curve and the area under it."""
        self._check(statistic, flare)
        null = self._at(self._null_key(statistic, flare))
        return Roc.of(null, self._at((statistic, "flare_on_null_grid", flare)))

    def plot(self, path: str | Path | None = None, *, fap: float = 1e-3, ax: Any = None) -> Any:
        """Plot the null and flare distributions of all statistics with their thresholds; needs matplotlib."""
        return self._draw(path, ax, fap=fap)

    def table(self, fap: float = 1e-3) -> QTable:
        """Return expected and simulated values, thresholds and probabilities, one row per flare and statistic.

        Undefined values are NaN; see `detection_probability`.
        """
        probability = {statistic: self.detection_probability(fap, statistic) for statistic in self.statistics}
        rows = [
            self._row(fap, statistic, flare, probability[statistic][flare])
            for flare in range(len(self.flares))
            for statistic in self.statistics
        ]
        tails = "counted" if countable(fap, self.realisations) else "importance sampling"
        about = {"realisations": self.realisations, "exposure_s": self.quiet.exposure_s, "tails": tails}
        return table_of(COLUMNS, rows, fap=fap, **about)

    def _row(self, fap: float, statistic: str, flare: int, probability: Interval) -> dict[str, Any]:
        """Return the row of one flare and statistic, as `COLUMNS` have it."""
        d, dof = self.distribution(statistic, flare), self.dof(statistic)
        try:
            cut = self.threshold(fap, statistic, template=flare)
        except NoThresholdError:
            cut = Interval(np.nan, np.nan, np.nan)
        theory = self.closed_form(statistic, flare)
        limit = self.closed_form(statistic, template=flare).isf(fap)
        # A weighted sum has no reduced value.
        reduced = np.nan if isinstance(self.statistic(statistic), LinearStatistic) else d.mean / dof
        of_flare = (theory.mean, d.mean, d.std, reduced, theory.sf(limit))
        if flare in self.blinding:
            of_flare = (np.nan,) * 5
        keys = ("expected", "mean", "std", "reduced", "closed_form_probability")
        return dict(zip(keys, of_flare, strict=True)) | {
            "name": self.flares[flare].name,
            "statistic": statistic,
            "dof": dof,
            "threshold": cut.value,
            "threshold_low": cut.low,
            "threshold_high": cut.high,
            "probability": probability.value,
            "low": probability.low,
            "high": probability.high,
            "closed_form_threshold": limit,
            "fap_error": self._fap_error(fap, statistic, flare),
        }

    def _fap_error(self, fap: float, statistic: str, template: int) -> float:
        """Return the relative standard error of the false-alarm probability at a threshold, NaN where there is none."""
        try:
            self._cut(fap, statistic, template)
        except NoThresholdError:
            return float("nan")
        tail = self.tail(fap, statistic, template=template)
        return float(np.sqrt((1 - fap) / (fap * self.realisations))) if tail is None else tail.relative_error

    def _null_key(self, statistic: str, template: int) -> Key:
        return statistic, "null", self._null(statistic, template)

    def _null(self, statistic: str, template: int) -> int:
        return template if self.statistic(statistic).shaped else 0

    def _cut(self, fap: float, statistic: str, template: int) -> Interval:
        """Return the sampled threshold, or the lowest edges of the null's bins with few enough counts above."""
        sampled = self.tail(fap, statistic, template=template)
        if sampled is not None:
            return sampled.threshold
        null = self._at(self._null_key(statistic, template))
        n_low, n_high = central_counts(null.n, fap)
        wanted = (int(np.floor(fap * null.n * (1 + 1e-12))), n_high, max(n_low - 1, 0))
        cut = Interval(*map(null.edge_with_at_most, wanted))
        beyond, at = null.around(cut.value)
        check_atom(f"{statistic} of {self.quiet.name}", fap, beyond / null.n, at / null.n)
        return cut


def _detected(probability: float, threshold: float) -> str:
    """Return a detection probability, or why there is none."""
    if probability == probability:
        return f"{probability:.4f}"
    return "saturated" if threshold == threshold else "no threshold"


#: Columns of the table of detections.
COLUMNS = (
    Column("name"),
    Column("statistic", description="detection statistic", heading="statistic"),
    Column("dof", description="degrees of freedom without a flare"),
    Column("expected", description="closed-form mean with the flare", heading="expected", format=".2f"),
    Column("mean", description="simulated mean with the flare", heading="simulated", format=".2f"),
    Column("std", description="simulated standard deviation with the flare"),
    Column("reduced", description="simulated mean over degrees of freedom; none for weighted sums", heading="reduced",
           format=number(".3f")),
    Column("threshold", description="simulated threshold at the false-alarm probability, per test",
           heading="threshold", format=".2f"),
    Column("threshold_low", description="its 95 % interval, lower end"),
    Column("threshold_high", description="its 95 % interval, upper end"),
    Column("probability", description="detection probability at that threshold", heading="detected",
           format=_detected, others=("threshold",)),
    Column("low", description="its 95 % interval, lower end, the threshold's error included", heading=INTERVAL,
           format=interval(".4f"), others=("high",)),
    Column("high", description="its 95 % interval, upper end, the threshold's error included"),
    Column("closed_form_threshold", description="threshold for Gaussian noise"),
    Column("closed_form_probability", description="detection probability for Gaussian noise", heading="closed form",
           format=".4f"),
    Column("fap_error", description="relative standard error of the false-alarm probability at the threshold"),
)  # fmt: skip
#: Columns of the table of extremes.
TAIL_COLUMNS = (
    Column("realisation", "realisations", description="number of the realisation, by which it can be drawn again"),
    Column("value", "values", description="of the statistic, as the device computed it"),
)
