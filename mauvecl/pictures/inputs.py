"""Pictures of the inputs of an expectation: spectra, sky, line spread function and optics."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.pictures.registry import picture_of
from mauvecl.pictures.style import COLOURS, NULL, styled_picture

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.exposure.sky import Sky
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.stars.source import Source

FLUX = "flux (erg s$^{-1}$ cm$^{-2}$ Å$^{-1}$)"
WAVELENGTH = "wavelength (nm)"
RANGE_NM = (200.0, 700.0)
OPTICS = {
    "grating_efficiency": "grating",
    "fibre_efficiency": "fibre",
    "telescope_mirror_reflectivity": "telescope mirror",
    "spectrometer_mirror_reflectivity": "spectrometer mirror",
    "collection_lens_efficiency": "collection lens",
    "window_efficiency": "window",
}


@picture_of("Source", "source")
@styled_picture
def source(plt: Any, star: Source) -> Any:
    """Plot a spectrum in Mauve's wavelength range."""
    inside = (star.wavelength_nm >= RANGE_NM[0]) & (star.wavelength_nm <= RANGE_NM[1])
    figure, axis = plt.subplots(figsize=(3.6, 2.7))
    axis.plot(star.wavelength_nm[inside], star.flux_flam[inside], color=COLOURS[0], linewidth=0.8)
    axis.set(xlabel=WAVELENGTH, ylabel=FLUX, xlim=RANGE_NM, title=", ".join([star.name, *star.history]))
    return figure


@picture_of("Expectation", "expectation")
@styled_picture
def expectation(plt: Any, x: Expectation) -> Any:
    """Plot the mean signal of an exposure with its noise."""
    table = x.table
    w, mean, noise = (table[name].value for name in ("wavelength", "signal", "noise"))
    figure, axis = plt.subplots(figsize=(3.6, 2.7))
    axis.fill_between(w, mean - noise, mean + noise, color=NULL, alpha=0.35, linewidth=0, label="1 sigma of a pixel")
    axis.plot(w, mean, color=COLOURS[0], linewidth=0.9, label="mean signal")
    axis.set(xlabel=WAVELENGTH, ylabel="DN per pixel", xlim=(w[0], w[-1]), title=f"{x.name}, {x.exposure_s:g} s")
    axis.legend()
    return figure


@styled_picture
def magnitudes(plt: Any, source: Source, values: Sequence[float], band: str = "V") -> Any:
    """Plot a spectrum at several magnitudes, as the paper's figure of the rescaled HD 37202."""
    figure, axis = plt.subplots(figsize=(3.6, 2.7))
    for colour, value in zip(cycle(COLOURS), values, strict=False):
        star = source.at_magnitude(value, band)
        axis.semilogy(star.wavelength_nm, star.flux_flam, color=colour, label=f"{band} = {value:g}")
    axis.set(xlabel=WAVELENGTH, ylabel=FLUX, xlim=RANGE_NM, title=source.name)
    axis.legend()
    return figure


@styled_picture
def zodiacal(plt: Any, source: Source, sky: Sky, instrument: Instrument) -> Any:
    """Plot a spectrum with zodiacal light, and the zodiacal light, as the paper's figure of the residual."""
    light = sky.spectrum(instrument.field_of_view_arcsec2)
    figure, (above, below) = plt.subplots(2, 1, figsize=(3.6, 4.0), sharex=True)
    added = 0.0 if light is None else np.interp(source.wavelength_nm, light.wavelength_nm, light.flux_flam)
    above.plot(source.wavelength_nm, source.flux_flam + added, color=COLOURS[3], label="with zodiacal light")
    above.plot(source.wavelength_nm, source.flux_flam, color=COLOURS[0], linestyle="--", label="star alone")
    above.set(ylabel=FLUX, title=source.name)
    above.legend()
    if light is not None:
        below.plot(light.wavelength_nm, light.flux_flam, color=COLOURS[2])
    below.set(xlabel=WAVELENGTH, ylabel=FLUX, xlim=RANGE_NM, title=f"difference: {sky.description}")
    return figure


@styled_picture
def convolved(plt: Any, source: Source, instrument: Instrument) -> Any:
    """Plot a spectrum and its convolution with the line spread function, as the paper's figure.

    The efficiencies of optics and detector are not applied.
    """
    from mauvecl.host.exposure.response import electrons_per_second

    w = instrument.wavelength_nm
    seen = electrons_per_second(instrument, source.wavelength_nm, source.flux_flam)
    flat = electrons_per_second(instrument, source.wavelength_nm, np.ones_like(source.flux_flam))
    figure, axis = plt.subplots(figsize=(3.6, 2.7))
    axis.plot(source.wavelength_nm, source.flux_flam, color=COLOURS[1], linewidth=0.8, label="as given")
    # Division by a flat spectrum removes the efficiencies and leaves the effect of the line spread function.
    axis.plot(w, seen / flat, color=COLOURS[2], label="through Mauve's line function")
    top = 1.1 * float((seen / flat).max())
    axis.set(xlabel=WAVELENGTH, ylabel=FLUX, xlim=RANGE_NM, ylim=(0, top), title=source.name)
    axis.legend()
    return figure


@styled_picture
def efficiencies(plt: Any, instrument: Instrument) -> Any:
    """Plot each optical element's efficiency, as the paper's figure of the payload's components."""
    w = np.linspace(*RANGE_NM, 501)
    figure, axis = plt.subplots(figsize=(3.6, 2.9))
    for colour, (name, text) in zip(cycle(COLOURS), OPTICS.items(), strict=False):
        axis.plot(w, 100 * getattr(instrument, name).at(w), color=colour, label=text)
    axis.set(xlabel=WAVELENGTH, ylabel="efficiency (%)", xlim=RANGE_NM, ylim=(0, 105))
    axis.set_title(f"{instrument.name}: nominal, some of it assumed")
    axis.legend(ncols=2)
    return figure


@styled_picture
def throughput(plt: Any, instrument: Instrument) -> Any:
    """Plot the quantum efficiency and the end-to-end throughput, which includes it, as the paper's figure."""
    w = np.linspace(*RANGE_NM, 501)
    figure, (above, below) = plt.subplots(2, 1, figsize=(3.6, 4.0), sharex=True)
    above.plot(w, 100 * instrument.quantum_efficiency(w), color=COLOURS[0])
    errors = instrument.throughput_errors
    known = "nominal, not a flight calibration" if errors is None else "calibrated"
    above.set(ylabel="quantum efficiency (%)", title=f"{instrument.name}: {known}")
    below.plot(w, 100 * instrument.throughput(w), color=COLOURS[4])
    spread = 100 * instrument.throughput(w)
    ends = [np.where(w < 250, 1 - sign * 0.5, 1 - sign * 0.3) for sign in (1, -1)]
    if errors is not None:
        ends = [np.exp(sign * 1.96 * errors.sd(w)) for sign in (-1, 1)]
    label = "sensible uncertainty" if errors is None else "95 %"
    below.fill_between(w, ends[0] * spread, ends[1] * spread, color=NULL, alpha=0.25, linewidth=0, label=label)
    below.set(xlabel=WAVELENGTH, ylabel="throughput with it (%)", xlim=RANGE_NM)
    below.legend()
    return figure


@styled_picture
def flares(plt: Any, source: Source, amplitudes: Sequence[float]) -> Any:
    """Plot a star's spectrum at several stages of a flare, as the paper's figures of the inputs."""
    figure, axis = plt.subplots(figsize=(3.6, 2.7))
    for k in reversed(range(len(amplitudes))):
        star = source.flaring(amplitudes[k])
        text = f"flare {100 * amplitudes[k]:g} %"
        axis.plot(star.wavelength_nm, star.flux_flam, color=COLOURS[k % len(COLOURS)], linewidth=0.8, label=text)
    axis.plot(source.wavelength_nm, source.flux_flam, color="black", linestyle="--", linewidth=0.8, label="no flare")
    axis.set(xlabel=WAVELENGTH, ylabel=FLUX, xlim=RANGE_NM, title=source.name)
    axis.legend()
    return figure
