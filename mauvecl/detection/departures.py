"""Departures of simulated false-alarm probabilities from the closed forms for Gaussian noise, and their causes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from mauvecl.detection import countable
from mauvecl.detection.chi2 import Chi2, Paper
from mauvecl.detection.detection import Detection
from mauvecl.detection.distributions import Form, Interval
from mauvecl.detection.statistics import Differences, LinearStatistic, Statistic
from mauvecl.host.arrays import Float
from mauvecl.noise.disturbances import ADDITIVE
from mauvecl.noise.drawing import Cumulants
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import INTERVAL, Column, interval, percent, table_of

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.exposure.expectation import Expectation

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
            threshold, rounding, with_ends = null.isf(fap), 0.0, 0.0
            for shift, variance in digital:
                mean = np.where(scene.used, (1.0 - (added > 0)) * shift, 0.0)
                recorded = Differences(mean, (1.0 + added) * variance)
                form = statistic.integrate_drawn(setting, detection.quiet, recorded, flare)
                rounding, with_ends = with_ends, form.sf(threshold) / fap - 1.0
            simulated = detection.false_alarm_probability(threshold, name, template=template)
            skew = _skewed_fap(detection, statistic, flare, null, threshold) / fap - 1.0
            effects = skew, rounding, with_ends - rounding, tuple(unpredicted)
            rows.append(Departure(name, template, threshold, fap, simulated, *effects, detection.realisations))
    return rows


def departure_table(detection: Detection, amplitudes: Sequence[float], fap: float) -> QTable:
    """Return the departures of a detection as a table, without rows if too few realisations lie beyond thresholds.

    `amplitudes` are those of the detection's flares.
    """
    rows = []
    for row in departures(detection, fap) if countable(fap, detection.realisations) else ():
        shaped = detection.statistic(row.statistic).shaped
        rows.append(replace(row, amplitude=amplitudes[row.template]) if shaped else row)
    return table_of(DEPARTURE_COLUMNS, rows, fap=fap)


#: Columns of the table of departures.
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
