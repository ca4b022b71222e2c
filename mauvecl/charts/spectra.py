"""Pictures of the inputs of an expectation: spectra, sky, line spread function and optics."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from mauvecl.charts.chart import WAVELENGTH, Axis, Band, Line, Panel, Picture, Targets
from mauvecl.charts.matplotlib import COLOURS, RANGE_NM, picture_of, styled_picture

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.exposure.sky import Sky
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.stars.source import Source

FLUX = Axis("flux (erg s$^{-1}$ cm$^{-2}$ Å$^{-1}$)")
OPTICS = {
    "grating_efficiency": "grating",
    "fibre_efficiency": "fibre",
    "telescope_mirror_reflectivity": "telescope mirror",
    "spectrometer_mirror_reflectivity": "spectrometer mirror",
    "collection_lens_efficiency": "collection lens",
    "window_efficiency": "window",
}


@picture_of("Source", "source")
def source(star: Source) -> Panel:
    """Plot a spectrum in Mauve's wavelength range."""
    inside = (star.wavelength_nm >= RANGE_NM[0]) & (star.wavelength_nm <= RANGE_NM[1])
    flux = Line("", "star", width=1.1, at=(star.wavelength_nm[inside], star.flux_flam[inside]))
    return Panel(WAVELENGTH, FLUX, [flux], ", ".join([star.name, *star.history]))


@picture_of("Expectation", "expectation")
def expectation(x: Expectation) -> Panel:
    """Plot the mean signal of an exposure with its noise."""
    w, mean, noise = (x.table[name].value for name in ("wavelength", "signal", "noise"))
    band = Band("1 sigma of a pixel", alpha=0.35, at=(w, mean - noise, mean + noise))
    line = Line("mean signal", "star", width=1.2, at=(w, mean))
    return Panel(Axis("wavelength (nm)", limits=(w[0], w[-1])), Axis("DN per pixel"), [band, line],
                 f"{x.name}, {x.exposure_s:g} s")  # fmt: skip


@styled_picture
def magnitudes(source: Source, values: Sequence[float], band: str = "V") -> Panel:
    """Plot a spectrum at several magnitudes, as the paper's figure of the rescaled HD 37202."""
    stars = [(f"{band} = {value:g}", source.at_magnitude(value, band)) for value in values]
    lines = Targets(at=[(name, star.wavelength_nm, star.flux_flam) for name, star in stars])
    return Panel(WAVELENGTH, Axis(FLUX.label, log=True), [lines], source.name)


@styled_picture
def zodiacal(source: Source, sky: Sky, instrument: Instrument) -> Picture:
    """Plot a spectrum with zodiacal light, and the zodiacal light, as the paper's figure of the residual."""
    light, nm = sky.spectrum(instrument.field_of_view_arcsec2), source.wavelength_nm
    added = 0.0 if light is None else np.interp(nm, light.wavelength_nm, light.flux_flam)
    both = Line("with zodiacal light", "read", at=(nm, source.flux_flam + added))
    alone = Line("star alone", "star", dash="dashed", at=(nm, source.flux_flam))
    rest = [] if light is None else [Line("", "sky", at=(light.wavelength_nm, light.flux_flam))]
    above = Panel(WAVELENGTH, FLUX, [both, alone], source.name)
    below = Panel(WAVELENGTH, FLUX, rest, f"difference: {sky.description}")
    return Picture([[above], [below]], (3.6, 4.0), share_x=True)


@styled_picture
def convolved(source: Source, instrument: Instrument) -> Panel:
    """Plot a spectrum and its convolution with the line spread function, as the paper's figure.

    The efficiencies of optics and detector are not applied.
    """
    from mauvecl.host.exposure.response import electrons_per_second

    nm = source.wavelength_nm
    # Division by a flat spectrum removes the efficiencies and leaves the effect of the line spread function.
    flat = electrons_per_second(instrument, nm, np.ones_like(source.flux_flam))
    seen = electrons_per_second(instrument, nm, source.flux_flam) / flat
    given = Line("as given", COLOURS[3], width=1.1, at=(nm, source.flux_flam))
    through = Line("through Mauve's line function", "sky", at=(instrument.wavelength_nm, seen))
    return Panel(WAVELENGTH, Axis(FLUX.label, limits=(0, 1.1 * float(seen.max()))), [given, through], source.name)


@styled_picture
def efficiencies(instrument: Instrument) -> Picture:
    """Plot each optical element's efficiency, as the paper's figure of the payload's components."""
    w = np.linspace(*RANGE_NM, 501)
    lines = Targets(at=[(text, w, 100 * getattr(instrument, name).at(w)) for name, text in OPTICS.items()])
    title = f"{instrument.name}: nominal, some of it assumed"
    panel = Panel(WAVELENGTH, Axis("efficiency (%)", limits=(0, 105)), [lines], title)
    return Picture([[panel]], (3.6, 3.4), below=True)


@styled_picture
def throughput(instrument: Instrument) -> Picture:
    """Plot the quantum efficiency and the end-to-end throughput, which includes it, as the paper's figure."""
    w, errors = np.linspace(*RANGE_NM, 501), instrument.throughput_errors
    origin, label = ("nominal, not a flight calibration", "assumed uncertainty")
    share = np.where(w < 250, 0.5, 0.3)
    low, high, spread = 1 - share, 1 + share, 100 * instrument.throughput(w)
    if errors is not None:
        origin, label = "calibrated", "95 %"
        low, high = (np.exp(sign * 1.96 * errors.sd(w)) for sign in (-1, 1))
    quantum = Line("", "star", at=(w, 100 * instrument.quantum_efficiency(w)))
    band, line = Band(label, alpha=0.25, at=(w, low * spread, high * spread)), Line("", "flare", at=(w, spread))
    above = Panel(WAVELENGTH, Axis("quantum efficiency (%)"), [quantum], f"{instrument.name}: {origin}")
    below = Panel(WAVELENGTH, Axis("end-to-end throughput (%)"), [line, band])
    return Picture([[above], [below]], (3.6, 4.0), share_x=True)


@styled_picture
def flares(source: Source, amplitudes: Sequence[float]) -> Panel:
    """Plot a star's spectrum at several stages of a flare, as the paper's figures of the inputs."""
    stars = [(f"flare {100 * a:g} %", source.flaring(a)) for a in amplitudes]
    lines = [
        Line(name, colour, width=1.1, at=(star.wavelength_nm, star.flux_flam))
        for colour, (name, star) in zip(cycle(COLOURS), stars, strict=False)
    ]
    quiet = Line("no flare", "text", width=1.1, dash="dashed", at=(source.wavelength_nm, source.flux_flam))
    return Panel(WAVELENGTH, FLUX, [*lines[::-1], quiet], source.name)
