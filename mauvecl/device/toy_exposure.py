"""Small exposure for self-tests, first builds and benches."""

from __future__ import annotations

from typing import Any

import numpy as np

from mauvecl.host.exposure.expectation import Expectation


def toy(
    pixels: int = 64,
    frames: int = 10,
    *,
    flare: float = 0.0,
    dark: float = 2225.0,
    read: float = 12.0,
    light: float = 40.0,
    unit: Any = "DN",
    photon_noise: Any = "gaussian",
) -> Expectation:
    """Return a small exposure of a smooth spectrum on a uniform detector; dark in DN, light in electrons per frame."""
    shape = light * (1.0 + 0.5 * np.sin(np.arange(pixels) / 9.0))
    ones = np.ones(pixels)
    element = np.arange(pixels, dtype=np.int32) // 10
    return Expectation(
        wavelength_nm=np.arange(200.0, 200.0 + pixels),
        source_electrons=shape * (1.0 + flare * np.linspace(1.0, 0.2, pixels)),
        sky_electrons=0.4 * ones,
        dark_dn=dark * ones,
        dark_unit=unit,
        bias_dn=600.0 * ones,
        read_noise_dn=read * ones,
        gain_dn_per_electron=0.6 * ones,
        n_frames=frames,
        frame_s=5.0,
        element=element,
        element_wavelength_nm=205.0 + 10.0 * np.arange(element[-1] + 1),
        adc_max_dn=65_535,
        saturation_dn=59_578.0,
        name="toy",
        instrument="toy",
        provenance={},
        photon_noise=photon_noise,
        conditions={"temperature_c": 21.0, "dark_slope_per_c": 0.0684, "light_loss": 0.34, "pointing_loss": 0.0},
    )
