"""Detections: thresholds with a known false-alarm probability, detection probabilities and ROC curves.

Departures say by how much simulated false-alarm probabilities differ from closed forms for Gaussian noise, and why.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.detection import NoThresholdError, Tails, check_atom, check_fap, countable
from mauvecl.detection.chi2 import Chi2, Paper
from mauvecl.detection.counts import Distribution, TailSamples, Tally
from mauvecl.detection.distributions import (
    CONFIDENCE_SD,
    Form,
    Interval,
    central_counts,
    clopper_pearson,
    clopper_pearson_ends,
    detection_interval,
)
from mauvecl.detection.requests import ChannelPlan, DetectRequest, Hypotheses, Key
from mauvecl.detection.statistics import Differences, LinearStatistic, Statistic
from mauvecl.detection.tails import Tail, tail
from mauvecl.host.arrays import ContentEquality, Float
from mauvecl.host.exposure.expectation import Expectation
from mauvecl.noise.disturbances import ADDITIVE
from mauvecl.noise.drawing import Cumulants
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import INTERVAL, Column, Drawable, interval, number, percent, table_of
from mauvecl.schema.errors import Message
from mauvecl.schema.fields import Range

if TYPE_CHECKING:
    from astropy.table import QTable

#: Value that is undefined, since a flare saturates every pixel or no threshold has a false-alarm probability.
UNDEFINED = Interval(np.nan, np.nan, np.nan)

#: Rows of a curve's table.
ROC_ROWS = 200
ROC_COLUMNS = (
    Column("threshold", description="value at and above which a detection is claimed"),
    Column("fap", description="false-alarm probability per test, with a 95 % Clopper-Pearson interval"),
    Column("fap_low", description="95 % interval of the false-alarm probability, lower end"),
    Column("fap_high", description="95 % interval of the false-alarm probability, upper end"),
    Column("probability", description="detection probability, with a 95 % Clopper-Pearson interval"),
    Column("probability_low", description="95 % interval of the detection probability, lower end"),
    Column("probability_high", description="95 % interval of the detection probability, upper end"),
)
#: Columns of the area, in tables of several curves.
AREA_COLUMNS = (
    Column("area", "area.value", description="under the curve; 95 % interval by DeLong's method"),
    Column("area_low", "area.low", description="95 % interval of the area, lower end"),
    Column("area_high", "area.high", description="95 % interval of the area, upper end"),
)


@dataclass(frozen=True, eq=False)
class Roc(Drawable):
    """ROC curve from the lowest threshold to the highest, at edges of filled bins."""

    threshold: Float  # shape (n,)
    fap: Float  # false-alarm probability, shape (n,)
    probability: Float  # detection probability, shape (n,)
    realisations: int  # of the null, and of the flare
    area: Interval  # probability that a flare's value exceeds a null's, counting ties half

    @classmethod
    def of(cls, null: Distribution, flare: Distribution) -> Roc:
        """Compute the curve of two histograms on the same grid.

        The area's variance follows DeLong et al. (1988, doi 10.2307/2531595) for independent null and flare. Here they
        share their draws, so the interval is conservative. Without any overlap, its lower end is that of Clopper and
        Pearson for as many pairs as there are realisations.
        """
        # Union of the filled bins; the shapes are (2, n), for null and flare.
        bins, n = (null.bins, flare.bins), np.array([[null.n], [flare.n]])
        lower, first = np.unique(np.concatenate([edges for edges, *_ in bins]), return_index=True)
        upper = np.concatenate([edges for _, edges, _ in bins])[first]
        counts = np.zeros((2, lower.size), np.int64)
        for row, (edges, _, filled) in zip(counts, bins, strict=True):
            row[np.searchsorted(lower, edges)] = filled
        # Integer counts above each edge make the ends of the curve exactly 1 and 0.
        above = np.pad(counts[:, ::-1].cumsum(axis=1)[:, ::-1], ((0, 0), (0, 1))) / n
        share = counts / n
        beaten, beating = 1.0 - above[0, :-1] + 0.5 * share[0], above[1, :-1] - 0.5 * share[1]
        area = float(np.clip(share[1] @ beaten, 0.0, 1.0))
        spread = [float(c @ (values - area) ** 2) for c, values in ((share[1], beaten), (share[0], beating))]
        reach = CONFIDENCE_SD * float(np.sqrt(spread[0] / flare.n + spread[1] / null.n))
        area_interval = Interval(area, max(area - reach, 0.0), min(area + reach, 1.0))
        if max(bins[0][0][0], bins[1][0][0]) > min(bins[0][0][-1], bins[1][0][-1]):
            fewest = min(null.n, flare.n)
            area_interval = clopper_pearson(round(area) * fewest, fewest)
        return cls(np.append(lower[0], upper), above[0], above[1], null.n, area_interval)

    def plot(self, path: str | Path | None = None, *, name: str = "", ax: Any = None) -> Any:
        """Plot detection probability against false-alarm probability; needs matplotlib."""
        return self._draw(path, ax, name=name)

    def table(self, rows: int = ROC_ROWS) -> QTable:
        """Return at most `rows` rows of the curve, evenly spaced in the logarithm of the false-alarm probability.

        Both ends are included. Probabilities have Clopper-Pearson intervals; the metadata contain the area.
        """
        area = {column.name: column.value(self) for column in AREA_COLUMNS}
        return table_of(ROC_COLUMNS, [self.points(rows)], realisations=self.realisations, **area)

    def points(self, rows: int = ROC_ROWS) -> dict[str, Float]:
        """Return at most `rows` points of the curve with their intervals, by the names of `ROC_COLUMNS`."""
        n = self.realisations
        levels = np.append(np.geomspace(1.0, 1.0 / n, max(rows - 1, 1)), 0.0)
        chosen = np.unique(np.minimum(np.searchsorted(-self.fap, -levels), self.fap.size - 1))
        points = {"threshold": self.threshold[chosen]}
        for name, fraction in (("fap", self.fap), ("probability", self.probability)):
            ends = clopper_pearson_ends(np.rint(fraction[chosen] * n).astype(np.int64), n)
            points |= dict(zip((name, f"{name}_low", f"{name}_high"), ends, strict=True))
        return points


@validated
@dataclass(eq=False)
class Detection(Drawable, ContentEquality, Hypotheses):
    """Simulated null and flare distributions, as returned by `Engine.detect`.

    Attributes are those of `Hypotheses`, the number of `realisations`, the `seed` of the draws, and `tails`: whether a
    threshold with too few realisations beyond it raises InputError ("counted") or is found by importance sampling
    ("sampled").
    """

    realisations: int
    tails: Tails = "counted"
    seed: int = 0
    _tails: dict[tuple[*Key, float], Tail] = field(default_factory=dict, init=False, repr=False, compare=False)
    _distributions: dict[Key, Distribution] = field(default_factory=dict, init=False, repr=False)
    _samples: dict[Key, TailSamples] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, hypotheses: Hypotheses, realisations: int, tails: Tails, seed: int) -> Self:
        """Make a detection that shares the prepared state and closed forms of `hypotheses`."""
        detection = object.__new__(cls)
        counts: dict[str, Any] = {"_tails": {}, "_distributions": {}, "_samples": {}}
        vars(detection).update(vars(hypotheses) | counts, realisations=realisations, tails=tails, seed=seed)
        return detection

    def _line(self) -> str:
        flares, names = len(self.flares), ", ".join(self.statistics)
        return (
            f"of {self.quiet.name!r}, {flares} flare{'s'[: flares != 1]} by {names}, {self.realisations} realisations"
        )

    def collect(self, plan: ChannelPlan, tally: Tally, samples: Mapping[int, TailSamples]) -> None:
        """Add the distributions and extremes of one batch."""
        self._distributions |= {key: tally.distribution(index) for index, key in enumerate(plan.keys)}
        self._samples |= {plan.keys[index]: extremes for index, extremes in samples.items()}

    def distribution(self, statistic: str, flare: int | None = None, *, template: int = 0) -> Distribution:
        """Return the simulated distribution of a statistic.

        `flare` is the index of the flare, None for the null distribution, in which shaped statistics use the flare with
        the index `template`.
        """
        return self._at(self._key(statistic, flare, template))

    def _key(self, statistic: str, flare: int | None, template: int) -> Key:
        """Return the key of a distribution; parameters as for `distribution`."""
        self._check(statistic, flare, template)
        if flare is not None:
            return statistic, "flare", flare
        return statistic, "null", template if self.statistic(statistic).shaped else 0

    def _at(self, key: Key) -> Distribution:
        """Return a counted distribution; raises InputError if values are not finite."""
        statistic, role, flare = key
        counted = self._distributions[key]
        of = "without a flare" if role == "null" else f"with flare {flare + 1}"
        counted.refuse_undefined(f"statistic {statistic!r} {of}")
        return counted

    def histogram(
        self, statistic: str, flare: int | None = None, *, template: int = 0, bins: Annotated[int, Range(1)] = 200
    ) -> tuple[Float, NDArray[np.int64]]:
        """Return edges and counts for plots; parameters as for `distribution`."""
        return self.distribution(statistic, flare, template=template).histogram(bins)

    def threshold(self, fap: float = 1e-3, statistic: str = "chi2", *, template: int = 0) -> Interval:
        """Return the threshold at a false-alarm probability per test.

        The threshold is the simulated upper quantile, rounded up to a bin's edge (1/512 of a standard deviation, or
        2**-13 of the value beyond 32 of them), with an order-statistic interval. If too few realisations lie beyond and
        tails are sampled, it is the result of importance sampling. `template` is the index of the flare that shaped
        statistics use as template.

        Raises InputError if fewer than 100 realisations lie beyond and tails are counted, since the tail is never
        extrapolated, and NoThresholdError if one value of the statistic is more probable than `fap`.
        """
        sampled = self.tail(fap, statistic, template=template)
        if sampled is not None:
            return sampled.threshold
        null = self.distribution(statistic, template=template)
        n_low, n_high = central_counts(null.n, fap)
        numbers_above = (int(np.floor(fap * null.n * (1 + 1e-12))), n_high, max(n_low - 1, 0))
        # The lowest edges of the null's bins with few enough counts above.
        cut = Interval(*map(null.edge_with_at_most, numbers_above))
        n_above, n_at = null.counts_around(cut.value)
        check_atom(f"{statistic} of {self.quiet.name}", fap, n_above / null.n, n_at / null.n)
        return cut

    def tail(self, fap: float, statistic: str = "chi2", *, template: int = 0) -> Tail | None:
        """Return the importance sampling behind a threshold, or None if realisations were counted."""
        key = (*self._key(statistic, None, template), fap)
        check_fap(fap, self.realisations, self.tails)
        if countable(fap, self.realisations):
            return None
        if key not in self._tails:
            self._tails[key] = tail(self, fap, statistic, template=template, seed=self.seed)
        return self._tails[key]

    def false_alarm_probability(self, threshold: float, statistic: str = "chi2", *, template: int = 0) -> Interval:
        """Return the fraction of null realisations at or above a threshold; the inverse of `threshold`.

        The fraction is exact at edges of bins, such as counted thresholds, and interpolated linearly within a bin.
        """
        null = self.distribution(statistic, template=template)
        above, n = null.above(threshold), null.n
        return Interval(above / n, clopper_pearson(int(above), n).low, clopper_pearson(math.ceil(above), n).high)

    def detection_probability(self, fap: float = 1e-3, statistic: str = "chi2") -> list[Interval]:
        """Return the fraction of realisations at or above the threshold for each flare.

        The interval has 95 % coverage for the probability above the true threshold; see `detection_interval`. The
        values are NaN for `blinding` flares, and if no threshold has the false-alarm probability (`without_threshold`).
        """
        probabilities = [UNDEFINED] * len(self.flares)
        for flare in range(len(self.flares)):
            cut = None if flare in self.blinding else self._cut(fap, statistic, flare)
            if isinstance(cut, Interval):
                counted, shared = self._at((statistic, "flare_on_null_grid", flare)), 0.0
                above = [counted.above(value) for value in (cut.value, cut.high, cut.low)]
                if countable(fap, self.realisations) and counted.std > 0:
                    # A flare only adds uncorrelated noise; tilted draws are independent of the flare's.
                    shared = min(self.distribution(statistic, template=flare).std / counted.std, 1.0)
                probabilities[flare] = detection_interval(above, counted.n, fap, shared)
        return probabilities

    def without_threshold(self, fap: float) -> tuple[Message, ...]:
        """Return a sentence for each statistic of which no threshold has a false-alarm probability."""
        cuts = [
            self._cut(fap, name, template)
            for name in self.statistics
            for template in range(len(self.flares) if self.statistic(name).shaped else 1)
        ]
        sentences = (f"NO THRESHOLD: {cut}." for cut in cuts if isinstance(cut, NoThresholdError))
        return tuple(Message(sentence, "no threshold") for sentence in dict.fromkeys(sentences))

    def _cut(self, fap: float, statistic: str, template: int) -> Interval | NoThresholdError:
        """Return `threshold`, or the error if no threshold has the false-alarm probability."""
        try:
            return self.threshold(fap, statistic, template=template)
        except NoThresholdError as error:
            return error

    def quantile(
        self, probability: float, statistic: str = "chi2", flare: int | None = None, *, template: int = 0
    ) -> Interval:
        """Return a quantile of a simulated distribution with its order-statistic interval; see `distribution`."""
        return self.distribution(statistic, flare, template=template).quantile_interval(probability)

    def tail_samples(self, statistic: str = "chi2", flare: int | None = None, *, template: int = 0) -> QTable:
        """Return the 1000 largest values of a null, or the smallest of a flare, with their realisations.

        `Engine.realise` with the same seed draws the spectrum of a realisation again. The table has the columns
        ``realisation`` and ``value``, the most extreme first.
        """
        key = self._key(statistic, flare, template)
        self._at(key)
        return table_of(TAIL_COLUMNS, [self._samples[key]])

    def roc(self, statistic: str = "chi2", flare: int = 0) -> Roc:
        """Return the ROC curve and the area under it."""
        self._check(statistic, flare)
        null = self.distribution(statistic, template=flare)
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
        metadata = {"realisations": self.realisations, "exposure_s": self.quiet.exposure_s, "tails": tails}
        return table_of(COLUMNS, rows, fap=fap, **metadata)

    def _row(self, fap: float, statistic: str, flare: int, probability: Interval) -> dict[str, Any]:
        """Return the row of one flare and statistic, as `COLUMNS` have it."""
        d, dof = self.distribution(statistic, flare), self.dof(statistic)
        cut, fap_error = self._cut(fap, statistic, flare), np.nan
        if isinstance(cut, NoThresholdError):
            cut = UNDEFINED
        else:
            tail = self.tail(fap, statistic, template=flare)
            fap_error = np.sqrt((1 - fap) / (fap * self.realisations)) if tail is None else tail.relative_error
        theory = self.closed_form(statistic, flare)
        limit = self.closed_form(statistic, template=flare).isf(fap)
        # A weighted sum has no reduced value.
        reduced = np.nan if isinstance(self.statistic(statistic), LinearStatistic) else d.mean / dof
        of_flare = {"expected": theory.mean, "mean": d.mean, "std": d.std, "reduced": reduced}
        of_flare["closed_form_probability"] = theory.sf(limit)
        if flare in self.blinding:
            of_flare = dict.fromkeys(of_flare, np.nan)
        return of_flare | vars(probability) | {
            "name": self.flares[flare].name, "statistic": statistic, "dof": dof, "probability": probability.value,
            "threshold": cut.value, "threshold_low": cut.low, "threshold_high": cut.high,
            "closed_form_threshold": limit, "fap_error": float(fap_error),
        }  # fmt: skip


COLUMNS = (
    Column("name"),
    Column("statistic", description="detection statistic", heading="statistic"),
    Column("probability", description="detection probability at that threshold", heading="detected",
           # Why there is none, where it is undefined.
           format=lambda chance, cut: number(".4f", "saturated" if cut == cut else "no threshold")(chance),
           others=("threshold",)),
    Column("low", description="its 95 % interval, lower end, the threshold's error included", heading=INTERVAL,
           format=interval(".4f"), others=("high",)),
    Column("high", description="its 95 % interval, upper end, the threshold's error included"),
    Column("dof", description="degrees of freedom without a flare"),
    Column("expected", description="closed-form mean with the flare", heading="expected", format=".2f", detail=True),
    Column("mean", description="simulated mean with the flare", heading="simulated", format=".2f", detail=True),
    Column("std", description="simulated standard deviation with the flare"),
    Column("reduced", description="simulated mean over degrees of freedom; none for weighted sums", heading="reduced",
           format=number(".3f"), detail=True),
    Column("threshold", description="simulated threshold at the false-alarm probability, per test",
           heading="threshold", format=".2f", detail=True),
    Column("threshold_low", description="its 95 % interval, lower end"),
    Column("threshold_high", description="its 95 % interval, upper end"),
    Column("closed_form_threshold", description="threshold for Gaussian noise"),
    Column("closed_form_probability", description="detection probability for Gaussian noise", heading="closed form",
           format=".4f", detail=True),
    Column("fap_error", description="relative standard error of the false-alarm probability at the threshold"),
)  # fmt: skip
TAIL_COLUMNS = (
    Column("realisation", "realisations", description="number of the realisation, by which it can be drawn again"),
    Column("value", "values", description="of the statistic, as the device computed it"),
)


def detection_of(request: DetectRequest, tallies: Iterable[Tally]) -> Detection:
    """Return the result of a request from the tallies of its parts."""
    detection = Detection.of(request.hypotheses, request.realisations, request.tails, request.seed)
    for plan, tally in zip(request.plans, tallies, strict=True):
        detection.collect(plan, tally, tally.tails)
    return detection


#: Differences above this many standard errors are significant.
SIGNIFICANT = 4.0


@dataclass(frozen=True)
class Departure:
    """False-alarm probability of a statistic at the threshold for Gaussian noise."""

    statistic: str
    template: int  # flare that a shaped statistic uses as template
    threshold: float  # for Gaussian noise
    fap: float  # wanted false-alarm probability
    simulated: Interval  # simulated false-alarm probability at the threshold
    # Predicted changes of the false-alarm probability at the threshold, relative to `fap`.
    skew: float  # due to third and fourth cumulants of the noise
    rounding: float  # due to the steps of the ADC
    clipping: float  # due to the ends of its range
    others: tuple[str, ...]  # effects that the closed form does not include and that have no prediction
    realisations: int
    amplitude: float = np.nan  # of the flare that a shaped statistic uses as template, in tables

    @property
    def ratio(self) -> float:
        """Simulated divided by wanted false-alarm probability."""
        return self.simulated.value / self.fap

    @property
    def error(self) -> float:
        """Standard error of the ratio if the closed form is exact."""
        return float(np.sqrt((1.0 - self.fap) / (self.fap * self.realisations)))

    @property
    def differs(self) -> bool:
        """True if the ratio deviates significantly from 1."""
        return abs(self.ratio - 1.0) > SIGNIFICANT * self.error

    @property
    def why(self) -> str:
        """Largest cause of a significant deviation, else an empty string."""
        if not self.differs:
            return ""
        causes = {"skew of the noise": self.skew, "rounding": self.rounding, "clipping": self.clipping}
        if self.others:
            causes[" and ".join(self.others)] = self.ratio - 1.0 - sum(causes.values())
        name, size = max(causes.items(), key=lambda item: abs(item[1]))
        return name if abs(size) > 0.2 * abs(self.ratio - 1.0) else "unexplained"


@validated
def departures(detection: Detection, fap: float) -> list[Departure]:
    """Return the departures of all statistics from the closed forms, at a wanted false-alarm probability per test.

    Shaped statistics have one departure per flare.
    """
    scene, setting = detection.scene, detection.setting
    unpredicted = ["variances estimated from the counts"] if scene.comparison.estimated else []
    unpredicted += [ADDITIVE[name].label for name in scene.additive]
    if scene.modulations and not setting.integrates:
        unpredicted.append("priors that the reference does not know")
    elif detection.nuisances is not None and not scene.modulations:
        unpredicted.append("unknowns that are marginalised over and not drawn")
    digital = _adc_moments(detection.quiet) if scene.clip else []
    rows = []
    for name in detection.statistics:
        statistic = detection.statistic(name)
        added = statistic.added_variance(setting)
        for template in range(len(detection.flares) if statistic.shaped else 1):
            null, flare = detection.closed_form(name, template=template), detection.shape(name, template)
            threshold, changes = null.isf(fap), list[float]()
            for shift, variance in digital:
                mean = np.where(scene.used, (1.0 - (added > 0)) * shift, 0.0)
                recorded = Differences(mean, (1.0 + added) * variance)
                form = statistic.integrate_drawn(setting, detection.quiet, recorded, flare)
                changes.append(form.sf(threshold) / fap - 1.0)
            rounding, with_ends = changes or (0.0, 0.0)
            simulated = detection.false_alarm_probability(threshold, name, template=template)
            skew = _skewed_fap(detection, statistic, flare, null, threshold) / fap - 1.0
            effects = skew, rounding, with_ends - rounding, tuple(unpredicted)
            rows.append(Departure(name, template, threshold, fap, simulated, *effects, detection.realisations))
    return rows


def departure_table(detection: Detection, amplitudes: Sequence[float], fap: float) -> QTable:
    """Return the departures for flares of some amplitudes; no rows if too few realisations are in the tail."""
    rows = []
    for row in departures(detection, fap) if countable(fap, detection.realisations) else ():
        shaped = detection.statistic(row.statistic).shaped
        rows.append(replace(row, amplitude=amplitudes[row.template]) if shaped else row)
    return table_of(DEPARTURE_COLUMNS, rows, fap=fap)


DEPARTURE_COLUMNS = (
    Column("statistic", description="detection statistic", heading="statistic", kind=str),
    Column("amplitude", description="flare amplitude: relative rise of the photons in the flare's band",
           heading="flare", format=percent("g")),
    Column("gaussian_threshold", "threshold", description="threshold for Gaussian noise"),
    Column("fap", "simulated.value", description="simulated false-alarm probability there", heading="simulated",
           format=".3g"),
    Column("fap_low", "simulated.low", description="its 95 % interval, lower end", heading=INTERVAL,
           format=interval(".3g"), others=("fap_high",), detail=True),
    Column("fap_high", "simulated.high", description="its 95 % interval, upper end"),
    Column("ratio", description="simulated over wanted false-alarm probability", heading="ratio", format=".3f"),
    Column("ratio_error", "error", description="standard error of the ratio"),
    Column("skew", description="predicted change of the ratio by the noise's skew and kurtosis"),
    Column("rounding", description="predicted change of the ratio by the ADC's steps"),
    Column("clipping", description="predicted change of the ratio by the ADC's ends"),
    Column("differs", description="whether chance does not explain the ratio: 4 standard errors", kind=bool),
    Column("why", description="main cause of a difference from the closed form", heading="why", kind=str),
)  # fmt: skip


def _skewed_fap(
    detection: Detection, statistic: Statistic, flare: Expectation | None, null: Form, threshold: float
) -> float:
    """Return the false-alarm probability at a threshold with the noise's third and fourth cumulants."""
    setting, quiet, draws = detection.setting, detection.quiet, detection.scene.n_draws
    noise, added = Cumulants.of(quiet, quiet.n_frames // draws), statistic.added_variance(setting)
    # Cumulants of the difference between an exposure and the mean of reference exposures.
    third, fourth, sixth = (
        draws * (noise.photon_cumulant(r) + noise.dark_cumulant(r)) * (1.0 + (-1.0) ** r * added ** (r - 1))
        for r in (3, 4, 6)
    )
    variance = statistic.variance(setting)
    if isinstance(statistic, LinearStatistic):
        weights = statistic.weights_per_dn(setting, flare)
        sd = float(np.sqrt(weights**2 @ variance))
        z, skew, excess = threshold / null.std, weights**3 @ third / sd**3, weights**4 @ fourth / sd**4
        # Edgeworth series (Abramowitz & Stegun 26.2.48).
        series = skew * (z**2 - 1) / 6 + excess * (z**3 - 3 * z) / 24 + skew**2 * (z**5 - 10 * z**3 + 15 * z) / 72
        return float(null.sf(threshold) + np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi) * series)
    assert isinstance(statistic, Chi2 | Paper)
    # The square of a skewed variable has more variance and skew than that of a normal one.
    weights = statistic.square_weights(setting, flare)
    changes = weights**2 @ fourth, weights**3 @ (12.0 * fourth * variance + 10.0 * third**2 + sixth)
    # Shifted gamma distributions with the cumulants of normal and of skewed noise.
    second, skewed = null.std**2 + np.array([0.0, changes[0]]), null.third + np.array([0.0, changes[1]])
    shape = 4.0 * second**3 / skewed**2
    distance = (threshold - null.mean) / np.sqrt(second)
    above, above_skewed = special.gammaincc(shape, np.maximum(shape + distance * np.sqrt(shape), 0.0)).tolist()
    return float(null.sf(threshold) * above_skewed / above)


def _adc_moments(x: Expectation) -> list[tuple[Float, Float]]:
    """Return mean shift and variance of an exposure behind the ADC, DN, without and with its lower limit.

    Saturation at the upper limit is part of the closed forms.
    """
    mean, sd = x.mean_raw_dn, np.sqrt(np.maximum(x.unsaturated_variance_dn2 / x.n_frames - 1 / 12, 0.0))
    recorded = x.recorded_dn / x.n_frames
    # Integers around each pixel's mean; the outermost ones include the tails.
    first, last = np.floor(mean - 9 * sd) - 1, np.ceil(mean + 9 * sd) + 1
    dn = first[:, None] + np.arange(int((last - first).max()) + 1)
    gap = dn[:, :-1] + 0.5 - mean[:, None]
    z = np.divide(gap, sd[:, None], out=np.where(gap >= 0, np.inf, -np.inf), where=sd[:, None] > 0)
    probability = np.diff(special.ndtr(z), prepend=0.0, append=1.0)
    moments = []
    for low in (-np.inf, 0.0):
        clipped = np.clip(dn, low, x.highest_dn)
        centre = np.sum(probability * clipped, axis=1)
        variance = np.sum(probability * (clipped - centre[:, None]) ** 2, axis=1)
        moments.append((x.n_frames * (centre - recorded), x.n_frames * variance))
    return moments
