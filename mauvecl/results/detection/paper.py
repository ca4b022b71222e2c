"""The MauveSim paper's own chi-squared, beside a calibrated answer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mauvecl.statistics.intervals import Interval
from mauvecl.statistics.smoothing import Smoothing

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

#: Amplitude: chi-squared and reduced chi-squared of the G2V star, V = 7.4, 50 s (the paper, section "G2V star").
PAPER_G2V = {0.24: (6159.88, 3.75), 0.081: (1078.36, 0.66)}

WHY = (
    "The paper's values are no calibrated chi-squared: with 1643 points a reduced value scatters by 0.035 about one, "
    "so 0.66 lies ten standard deviations below. Divided by the smoothed flare spectrum in DN/s instead of the noise's "
    "variance they are reproduced; what such a number means, only its simulated null can tell (`statistic='paper'`)."
)


def reconstruct(quiet: Expectation, flare: Expectation) -> Interval:
    """The median and the central 95 % of the reduced statistic `paper` under a flare, for Gaussian noise.

    Parameters
    ----------
    quiet, flare : Expectation

    Notes
    -----
    The paper does not define its chi-squared. Of the forms tried this one comes nearest to its pair of G2V values: both
    noisy spectra are smoothed with a Gaussian of 10.5 nm FWHM, as its figure says, and compared as
    `scipy.stats.chisquare` would, with the flare's mean as the expected values.
    """
    smoothing = Smoothing.of(quiet, np.ones(quiet.wavelength_nm.size, bool), (flare,))
    delta, variance = flare.recorded_light_dn - quiet.recorded_light_dn, flare.variance_dn2 + quiet.variance_dn2
    form = smoothing.form(smoothing.scale(flare), delta, variance)
    middle, low, high = (form.isf(p) / quiet.wavelength_nm.size for p in (0.5, 0.975, 0.025))
    return Interval(middle, low, high)
