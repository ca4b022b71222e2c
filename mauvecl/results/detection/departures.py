"""Compare simulated false-alarm probabilities with the closed form for Gaussian noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.noise.cumulants import Cumulants
from mauvecl.noise.unknowns import ADDITIVE
from mauvecl.results.requests.fap_checks import countable
from mauvecl.schema.calls import validated
from mauvecl.schema.tables import INTERVAL, Column, interval, percent, table_of
from mauvecl.statistics.distributions import Form
from mauvecl.statistics.intervals import Interval
from mauvecl.statistics.statistic import Differences, LinearStatistic, QuadraticStatistic

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.expectation import Expectation
    from mauvecl.results.detection.detection import Detection

Float = NDArray[np.float64]

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
        rest = self.ratio - 1.0 - sum(causes.values())
        if self.others:
            causes[" and ".join(self.others)] = rest
        name, size = max(causes.items(), key=lambda item: abs(item[1]))
        return name if abs(size) > 0.2 * abs(self.ratio - 1.0) else "unexplained"


@validated
def departures(detection: Detection, fap: float) -> list[Departure]:
    """Return the departures of all statistics from the closed forms.

    Shaped statistics have one departure per flare.

    Parameters
    ----------
    detection : Detection
    fap : float
        Wanted false-alarm probability per test.
    """
    scene = detection.scene
    others = []
    if scene.comparison.estimated:
        others.append("variances estimated from the counts")
    others += [ADDITIVE[name].label for name in scene.additive]
    if scene.modulations and not detection.setting.integrates:
        others.append("priors that the reference does not know")
    elif detection.nuisances is not None and not scene.modulations:
        others.append("unknowns that are marginalised over and not drawn")
    digital = _adc_moments(detection.quiet) if scene.clip else None
    rows = []
    for statistic in detection.statistics:
        for template in range(len(detection.flares)) if detection.statistic(statistic).shaped else (0,):
            null = detection.closed_form(statistic, template=template)
            cut = null.isf(fap)
            rounding = clipping = 0.0
            if digital is not None:
                rounding = _shifted_fap(detection, statistic, template, *digital[0], cut) / fap - 1.0
                clipping = _shifted_fap(detection, statistic, template, *digital[1], cut) / fap - 1.0 - rounding
            rows.append(
                Departure(
                    statistic,
                    template,
                    cut,
                    fap,
                    detection.false_alarm_probability(cut, statistic, template=template),
                    _skewed_fap(detection, statistic, template, null, cut) / fap - 1.0,
                    rounding,
                    clipping,
                    tuple(others),
                    detection.realisations,
                )
            )
    return rows


def departure_table(detection: Detection, amplitudes: Sequence[float], fap: float) -> QTable:
    """Return the departures of a detection as a table, without rows if too few realisations lie beyond thresholds.

    `amplitudes` are those of the detection's flares.
    """
    rows = departures(detection, fap) if countable(fap, detection.realisations) else []

    def amplitude(row: Departure) -> float:
        return amplitudes[row.template] if detection.statistic(row.statistic).shaped else float("nan")

    columns = [replace(one, get=amplitude) if one.name == "amplitude" else one for one in COLUMNS]
    return table_of(columns, rows, fap=fap)


#: Columns of the table of departures.
COLUMNS = (
    Column("statistic", description="detection statistic", heading="statistic", kind=str),
    Column("amplitude", description="flare amplitude: relative rise of the photons in the flare's band",
           heading="flare", format=percent("g")),
    Column("gaussian_threshold", "threshold", description="threshold for Gaussian noise"),
    Column("fap", "simulated.value", description="simulated false-alarm probability there", heading="simulated",
           format=".3g"),
    Column("fap_low", "simulated.low", description="its 95 % interval, lower end", heading=INTERVAL,
           format=interval(".3g"), others=("fap_high",)),
    Column("fap_high", "simulated.high", description="its 95 % interval, upper end"),
    Column("ratio", description="simulated over wanted false-alarm probability", heading="ratio", format=".3f"),
    Column("ratio_error", "error", description="standard error of the ratio"),
    Column("skew", description="predicted change of the ratio by the noise's skew and kurtosis"),
    Column("rounding", description="predicted change of the ratio by the ADC's steps"),
    Column("clipping", description="predicted change of the ratio by the ADC's ends"),
    Column("differs", description="whether chance does not explain the ratio: 4 standard errors", kind=bool),
    Column("why", description="main cause of a difference from the closed form", heading="why", kind=str),
)  # fmt: skip


def _skewed_fap(detection: Detection, statistic: str, template: int, null: Form, cut: float) -> float:
    """Return the false-alarm probability at a threshold with the noise's third and fourth cumulants."""
    scene, quiet = detection.scene, detection.quiet
    each = 1 if scene.frames else quiet.n_frames
    c, draws = Cumulants.of(quiet, each), quiet.n_frames // each
    one, flare = detection.statistic(statistic), detection.shape(statistic, template)
    # Cumulants of the difference between an exposure and the mean of reference exposures.
    added = one.added_variance(detection.setting)
    third, fourth, sixth = (
        draws * (c.photon_cumulant(r) + c.dark_cumulant(r)) * (1.0 + (-1.0) ** r * added ** (r - 1)) for r in (3, 4, 6)
    )
    variance = one.variance(detection.setting)
    if isinstance(one, LinearStatistic):
        weights = one.weights_per_dn(detection.setting, flare)
        sd = float(np.sqrt(weights**2 @ variance))
        z, skew, excess = cut / null.std, weights**3 @ third / sd**3, weights**4 @ fourth / sd**4
        # Edgeworth series (Abramowitz & Stegun 26.2.48).
        series = skew * (z**2 - 1) / 6 + excess * (z**3 - 3 * z) / 24 + skew**2 * (z**5 - 10 * z**3 + 15 * z) / 72
        return float(null.sf(cut) + np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi) * series)
    assert isinstance(one, QuadraticStatistic)
    # The square of a skewed variable has more variance and skew than that of a normal one.
    weights = one.square_weights(detection.setting, flare)
    second = null.std**2
    skewed = null.third
    more = weights**2 @ fourth, weights**3 @ (12.0 * fourth * variance + 10.0 * third**2 + sixth)
    plain, there = (
        _gamma_sf(cut, null.mean, second + part * float(more[0]), skewed + part * float(more[1])) for part in (0.0, 1.0)
    )
    return null.sf(cut) * there / plain


def _gamma_sf(value: float, mean: float, variance: float, third: float) -> float:
    """Return the probability of exceeding a value for a shifted gamma distribution with given cumulants."""
    shape = 4.0 * variance**3 / third**2
    return float(special.gammaincc(shape, max(shape + (value - mean) / np.sqrt(variance) * np.sqrt(shape), 0.0)))


def _shifted_fap(
    detection: Detection, statistic: str, template: int, shift: Float, variance: Float, cut: float
) -> float:
    """Return the false-alarm probability at a threshold for a changed mean and variance of each pixel."""
    one, used = detection.statistic(statistic), detection.scene.used
    added = one.added_variance(detection.setting)
    moved = Differences(np.where(used, (1.0 - (added > 0)) * shift, 0.0), (1.0 + added) * variance)
    return one.integrate_drawn(detection.setting, detection.quiet, moved, detection.shape(statistic, template)).sf(cut)


def _adc_moments(x: Expectation) -> tuple[tuple[Float, Float], tuple[Float, Float]]:
    """Compute the mean shift and the variance of an exposure behind the ADC, without and with its lower limit, in DN.

    Saturation at the upper limit is part of the closed forms.

    Returns
    -------
    rounded, clipped : (shift, variance), each shape (n_pixel,)
    """
    mean, sd = x.mean_raw_dn, np.sqrt(np.maximum(x.unsaturated_variance_dn2 / x.n_frames - 1 / 12, 0.0))
    recorded = x.recorded_dn / x.n_frames
    moments = []
    for low, high in ((-np.inf, float(x.highest_dn)), (0.0, float(x.highest_dn))):
        shift, variance = np.zeros_like(mean), np.zeros_like(mean)
        for p, (m, s) in enumerate(zip(mean, sd, strict=True)):
            # Integers around the mean; the outermost ones include the tails.
            dn = np.arange(np.floor(m - 9 * s) - 1, np.ceil(m + 9 * s) + 2)
            below = special.ndtr((dn[:-1] + 0.5 - m) / s) if s > 0 else (dn[:-1] + 0.5 >= m).astype(float)
            chance = np.diff(below, prepend=0.0, append=1.0)
            seen = np.clip(dn, low, high)
            centre = float(chance @ seen)
            shift[p], variance[p] = centre - recorded[p], chance @ (seen - centre) ** 2
        moments.append((x.n_frames * shift, x.n_frames * variance))
    return moments[0], moments[1]
