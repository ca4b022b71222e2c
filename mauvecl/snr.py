"""Signal-to-noise distributions: what the device is asked, and the tables made of its answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl import layout
from mauvecl.scene import Scene
from mauvecl.tally import Grid, Tally

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.expectation import Expectation

#: One distribution per pixel: 2048 bins of sigma / 128 over +-8 sigma.
OBSERVER_BINS = 2048
OBSERVER_FINE_BITS = 4

#: Percentages of the quantiles reported: the median and one, two and three sigma.
PERCENTAGES = (0.135, 2.5, 16.0, 50.0, 84.0, 97.5, 99.865)


def observers(x: Expectation, scene: Scene) -> NDArray[np.void]:
    """What an observer subtracts and assumes in each pixel, for the device.

    Returns
    -------
    ndarray of layout.OBSERVER, shape (n_padded,)
    """
    table = np.zeros(len(scene.pixels), layout.OBSERVER)
    table["variance"] = 1.0  # padding: 0 / 1
    real = table[: scene.n_pixel]
    real["net_offset"] = scene.n_draws * scene.base_dn[0] - x.n_frames * (x.bias_dn + x.dark_dn)
    real["gain"] = x.gain_dn_per_electron
    real["variance"] = x.n_frames * (x.read_noise_dn**2 + x.dark_variance_dn2)
    real["used"] = 1.0
    return table


def plan_snr(x: Expectation, scene: Scene) -> list[Grid]:
    """One grid per pixel and per resolution element, around the closed form with its linearised spread."""
    background = x.n_frames * (x.read_noise_dn**2 + x.dark_variance_dn2)
    photon = x.gain_dn_per_electron * x.signal_dn
    grids = []
    for offset, signal, shot, dark, total in (
        (0, x.signal_dn, photon, background, x.variance_dn2),
        (
            len(scene.pixels),
            x.per_element(x.signal_dn),
            x.per_element(photon),
            x.per_element(background),
            x.per_element(x.variance_dn2),
        ),
    ):
        noise = np.sqrt(shot + dark)
        centre = signal / noise
        gain = np.divide(shot, signal, out=np.zeros_like(signal), where=signal > 0)
        slope = 1.0 / noise - signal * gain / (2.0 * noise**3)
        sigma = np.sqrt(total) * slope
        grids += [Grid(offset + i, float(c), float(s)) for i, (c, s) in enumerate(zip(centre, sigma, strict=True))]
    return grids


@dataclass(frozen=True, eq=False)
class SnrResult:
    """Distributions of the S/N over realisations.

    Attributes
    ----------
    expectation : Expectation
    tally : Tally
        First the pixels, then the resolution elements.
    """

    expectation: Expectation
    tally: Tally

    @property
    def pixel(self) -> QTable:
        """S/N per pixel: wavelength, closed form, simulated mean, standard deviation, quantiles."""
        x = self.expectation
        return self._table(x.wavelength_nm, x.snr(), 0)

    @property
    def element(self) -> QTable:
        """The same per resolution element of 10.5 nm."""
        x = self.expectation
        return self._table(x.element_wavelength_nm, x.snr_per_element(), x.wavelength_nm.size)

    def _table(self, wavelength_nm: NDArray[np.float64], expected: NDArray[np.float64], first: int) -> QTable:
        import astropy.units as u
        from astropy.table import QTable

        found = [self.tally.distribution(first + i) for i in range(wavelength_nm.size)]
        table = QTable()
        table["wavelength"] = wavelength_nm * u.nm
        table["expected"] = expected
        table["mean"] = [d.mean for d in found]
        table["std"] = [d.std for d in found]
        quantiles = np.array([d.quantile(np.array(PERCENTAGES) / 100) for d in found])
        for i, percentage in enumerate(PERCENTAGES):
            table[f"q{percentage:g}"] = quantiles[:, i]
        table["expected"].info.description = "closed-form S/N of the mean spectrum"
        table["mean"].info.description = "mean S/N of the realisations"
        table["std"].info.description = "standard deviation of the S/N of the realisations"
        table.meta["realisations"] = self.tally.n
        table.meta["exposure_s"] = self.expectation.exposure_s
        table.meta["name"] = self.expectation.name
        return table
