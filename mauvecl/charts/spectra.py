"""Charts of spectra: inputs of an expectation, fitted instruments, and changes between visits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.charts import chart
from mauvecl.charts.chart import WAVELENGTH, Area, Axis, Chart, Dots, Line, Mesh, Panel, Picture, Rule, Strips, Targets
from mauvecl.charts.matplotlib import COLOURS, RANGE_NM, in_figure, picture_of, styled_picture
from mauvecl.schema.columns import First, with_error

if TYPE_CHECKING:
    from mauvecl.answers.calibrate import CalibrateAnswer
    from mauvecl.answers.change import ChangeAnswer
    from mauvecl.host.exposure.background import Sky
    from mauvecl.host.exposure.expectation import Expectation
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
    band = Area("1 sigma of a pixel", alpha=0.35, at=(w, mean - noise, mean + noise))
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
    band, line = Area(label, alpha=0.25, at=(w, low * spread, high * spread)), Line("", "flare", at=(w, spread))
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


#: Pixels that are averaged for a point of the residuals, and values for one of the photon transfer.
BIN, GROUPS = 16, 60
NO_OBSERVATIONS = "Choose an archive of observations; Calibrate then fits the instrument."


@Chart(
    "throughput", "Throughput: fitted and nominal", WAVELENGTH, Axis("electrons per photon (%)"),
    (
        Area("95 % interval", "star", "band", alpha=0.35),
        Line("fitted", "star", width=2, tips=("nm", "fitted (%)")),
        Line("nominal", dash="dashed"),
    ),
).data("calibrate", NO_OBSERVATIONS)  # fmt: skip
def calibrated_throughput(closed: Any, answer: CalibrateAnswer) -> chart.ChartData:
    """Return the fitted throughput with its 95 % band, and the nominal one."""
    table = answer.throughput_table
    nm, wide = table["wavelength"].value, np.exp(1.96 * np.asarray(table["relative_error"]))
    fitted, nominal = (100 * np.asarray(table[name]) for name in ("throughput", "nominal"))
    text = f"{answer.notice} It is {table['ratio'].min():.3g} to {table['ratio'].max():.3g} times the nominal one."
    band = (nm, fitted / wide, fitted * wide)
    return chart.ChartData(text, {"band": band, "fitted": (nm, fitted), "nominal": (nm, nominal)})


@picture_of("CalibrateAnswer", "throughput")
def fitted_throughput(answer: CalibrateAnswer) -> Picture:
    """Plot the fitted throughput with its 95 % band next to the nominal one, and their ratio."""
    series, nominal = calibrated_throughput.series_of(answer), np.asarray(answer.throughput_table["nominal"])
    above = calibrated_throughput.panel(series, f"nominal: {answer.nominal.name}")
    series = {name: (nm, *np.divide(y, 100 * nominal)) for name, (nm, *y) in series.items()}
    ratio = [replace(item, listed=False) for item in calibrated_throughput.panel(series).series]
    below = Panel(WAVELENGTH, Axis("fitted / nominal"), ratio)
    return Picture([[above], [below]], (5.2, 4.6), f"Throughput {answer.source}", share_x=True)


@Chart(
    "residuals", "Observed less fitted spectra", WAVELENGTH, Axis(f"residual of {BIN} pixels (sigma)"),
    (
        Targets("residual", tips=("residual (sigma)",)),
        Rule("2 sigma", "threshold", "above", along="y", at=2.0),
        Rule("2 sigma", "threshold", "below", along="y", listed=False, at=-2.0),
    ),
).data("calibrate", NO_OBSERVATIONS)  # fmt: skip
def residuals_of_stars(closed: Any, answer: CalibrateAnswer) -> chart.ChartData:
    """Return the averaged residuals of each star, without groups of which no pixel was used."""
    fit, rows = answer.throughput, list[tuple[str, Any, Any]]()
    n = fit.wavelength_nm.size // BIN
    nm = fit.wavelength_nm[: n * BIN].reshape(n, BIN).mean(axis=1)
    for star, residual in zip(answer.stars, fit.residual[:, : n * BIN].reshape(-1, n, BIN), strict=True):
        count = np.isfinite(residual).sum(axis=1)
        used = count > 0
        rows.append((star.name, nm[used], np.nansum(residual[used], axis=1) / np.sqrt(count[used])))
    words = "; ".join(f"{name} {np.sqrt(np.mean(row**2)):.2f}" for name, _, row in rows)
    return chart.ChartData(f"Root mean square, 1 for noise alone: {words}; p = {fit.p_value:.2g}.", {"residual": rows})


@picture_of("CalibrateAnswer", "residuals")
def calibration_residuals(answer: CalibrateAnswer) -> Picture:
    """Plot the residuals of each star, averaged over some pixels, in their standard deviations."""
    two = Strips(along="y", alpha=0.2, at=([-2], [2]))
    rows = [[Panel(WAVELENGTH, Axis("residual (sigma)"), [two, Dots("", "star", at=(nm, row))], name)]
            for name, nm, row in residuals_of_stars.series_of(answer)["residual"]]  # fmt: skip
    title, notes = f"Observed less fitted spectra, means of {BIN} pixels", f"p-value {answer.throughput.p_value:.2g}"
    return Picture(rows, (5.2, 1.0 + 1.1 * len(rows)), title, ("grey: 2 sigma", notes), share_x=True, share_y=True)


@Chart(
    "transfer", "Photon transfer: variance of frames against their mean", Axis("fitted variance (DN²)", log=True),
    Axis("measured variance (DN²)", log=True),
    (Line("fitted"), Dots("measured", "star", size=6, tips=("fitted", "measured"))),
).data("calibrate", NO_OBSERVATIONS)  # fmt: skip
def variances_of_frames(closed: Any, answer: CalibrateAnswer) -> chart.ChartData:
    """Return the measured over the fitted variance."""
    t = answer.transfer
    # Dark counts have their own variance, which the fit includes.
    groups = np.array_split(np.argsort(t.model), GROUPS)
    model, measured = (np.array([values[group].mean() for group in groups]) for values in (t.model, t.variance))
    text = f"Gain {with_error(t.noise.gain, t.gain_error)} DN per electron, read noise {t.read_noise_dn:.3g} DN."
    if "gain" in t.assumed:
        text = "The frames do not determine the gain: it is nominal."
    return chart.ChartData(text, {"fitted": (model, model), "measured": (model, measured)})


@picture_of("CalibrateAnswer", "photon-transfer", when=lambda answer: "gain" not in answer.transfer.assumed)
def photon_transfer(answer: CalibrateAnswer) -> Picture:
    """Plot the variance of frames against their mean, binned, with the fit and its residuals."""
    t, series = answer.transfer, variances_of_frames.series_of(answer)
    model, measured = series["measured"]
    groups = np.array_split(np.argsort(t.model), GROUPS)
    error = np.array([(t.variance - t.model)[group].std() / np.sqrt(group.size) for group in groups])
    off = Dots("", "star", size=6, at=(model, 100 * (measured / model - 1), 100 * error / model))
    below = Panel(variances_of_frames.x, Axis("difference (%)"), [Rule(along="y", dash="-", at=0), off])
    title = (
        f"Photon transfer: gain {with_error(t.noise.gain, t.gain_error)} DN per electron, read noise "
        f"{with_error(t.read_noise_dn, t.read_noise_error)} DN; dark counts in {t.dark_unit}"
    )
    return Picture([[variances_of_frames.panel(series)], [below]], (4.6, 4.6), title, share_x=True)


@picture_of("CalibrateAnswer", "dark", when=lambda answer: answer.dark.dof > 0)
def dark_current(answer: CalibrateAnswer) -> Picture:
    """Plot the dark current of each pixel, and its mean against temperature with the fit."""
    d, n = answer.dark, answer.nominal
    pixels = Dots("", "star", size=2, at=(n.wavelength_nm, d.level_dn_per_s))
    dark = [observation for observation in answer.observations if observation.star is None]
    celsius = np.concatenate([np.atleast_1d(observation.temperature_c) for observation in dark])
    kelvin = np.linspace(celsius.min(), celsius.max(), 101)
    usual = n.dark_scale_dn_per_s * np.exp(n.dark_slope_per_c * kelvin)
    mean = list[Dots | Line]()
    for number, frames in enumerate(dark):
        at = frames.temperature_c, (frames.raw_dn - d.bias_dn).mean(axis=1) / frames.exposure_s
        mean.append(Dots("" if number else "means of frames", "star", at=at))
    mean.append(Line("fitted", "flare", at=(kelvin, d.level_dn_per_s.mean() * d.growth(kelvin))))
    mean.append(Line("nominal", dash="dashed", at=(kelvin, usual)))
    left = Panel(WAVELENGTH, Axis("dark current (DN/s)"), [pixels], f"pixels at {d.reference_c:.1f} °C")
    right = Panel(Axis("detector temperature (°C)"), Axis("mean dark current (DN/s)"), mean)
    title = f"Dark current: slope {with_error(d.slope_per_c, d.slope_error)} per °C"
    return Picture([[left, right]], (7.2, 2.9), title)


#: Changes whose periods are drawn, at most.
MOST = 3
#: Nanometres on both sides of an index that are drawn.
AROUND_NM = 15.0


def along_magnitude(answer: ChangeAnswer, scales: Mapping[str, float]) -> list[tuple[str, Any, Any]]:
    """Return name, magnitudes and smallest changes of the first star, times the factor of their unit, where known."""
    from mauvecl.answers.change import MAGNITUDES

    lines = list[tuple[str, Any, Any]]()
    for name, unit in dict.fromkeys((row.change.name, row.change.unit) for row in answer.along):
        if unit in scales:
            own = [row for row in answer.along if row.change.name == name][: MAGNITUDES.size]
            x, y = np.array([(row.magnitude, row.smallest.one) for row in own]).T
            lines.append((shown_name(name), x[np.isfinite(y)], scales[unit] * y[np.isfinite(y)]))
    return lines


def shown_name(change: str) -> str:
    """Return the name of a change with its unit if it is a wavelength or a band, and with its capital letter."""
    return f"{change} nm" if change[0].isdigit() else change.replace("balmer", "Balmer")


@picture_of("ChangeAnswer", "change", when=lambda answer: bool(answer.along))
def change_against_magnitude(answer: ChangeAnswer) -> Picture:
    """Plot the smallest detectable changes against the magnitude of the star, one panel for each unit."""
    titles = First(list(dict.fromkeys(row.title for row in answer.changes)), 1, "stars")
    (title,), star, row = titles, answer.study.star[0], []
    for unit in dict.fromkeys(row.change.unit for row in answer.along):
        lines = [line for line in along_magnitude(answer, {unit: 1 if unit else 100}) if line[1].size]
        here = [] if star.magnitude is None else [Rule("this star", dash="dotted", at=star.magnitude)]
        # Without a pixel that does not saturate there is nothing to show.
        values, limits = [value for _, _, column in lines for value in column], None
        if lines:
            # A decade at least, since errors beyond a few per cent do not matter, and room for the legend.
            limits = min(*values, max(values) / 5) / 1.2, 2 * max(*values, 5 * min(values))
        y = Axis(f"smallest change ({in_figure(unit) if unit else '%'})", log=bool(lines), limits=limits)
        row.append(Panel(Axis(f"magnitude ({star.band})"), y, [Targets(at=lines), *here]))
    visits, exposure = answer.study.change.visits, answer.study.observation.exposure_s
    title = f"{title}: smallest change between {visits} visits of {exposure:g} s"
    return Picture([row], (1.0 + 3.3 * len(row), 3.6), title, (titles.note,))


@picture_of("ChangeAnswer", "periods", when=lambda answer: bool(answer.periods))
def recovered_periods(answer: ChangeAnswer) -> Picture:
    """Plot the share of recovered periods over period and semi-amplitude, for the first changes."""
    first, row = First(answer.periods, MOST, "changes"), []
    for row_of_change in first:
        r, scale = row_of_change.recovery, row_of_change.error * (1 if row_of_change.change.unit else 100)
        shares = 100 * row_of_change.shares("value")
        mesh = Mesh("recovered (%)", high=100, at=(r.periods_d, scale * r.amplitudes, shares))
        unit = row_of_change.change.unit
        y = Axis(f"semi-amplitude ({in_figure(unit) if unit else '%'})", log=True)
        row.append(Panel(Axis("period (d)", log=True), y, [mesh], shown_name(row_of_change.change.name)))
    time = first[0].recovery.time_d
    title = f"{first[0].title}: periods that {time.size} visits within {np.ptp(time):.0f} days recover"
    return Picture([row], (1.0 + 2.9 * len(row), 3.2), title, (first.note,))


@picture_of("ChangeAnswer", "indices", when=lambda answer: bool(answer.indices))
def line_indices(answer: ChangeAnswer) -> Picture:
    """Plot the mean calibrated spectrum around each line index, with its band and continuum."""
    title, row = answer.indices[0].title, []
    for index_row in answer.indices:
        if index_row.title != title:
            continue
        index, nm = index_row.index, index_row.wavelength_nm
        near = (nm > index.continuum_nm[0][0] - AROUND_NM) & (nm < index.continuum_nm[-1][1] + AROUND_NM)
        line = Line("mean spectrum", "star", at=(nm[near], index_row.flux[near]))
        band, continua = np.array([index.band_nm]).T, np.array(index.continuum_nm).T
        series = [line, Strips("band", "read", at=band), Strips("continuum", alpha=0.2, at=continua)]
        y = Axis(f"flux ({in_figure('erg / (s cm2 nm)')})")
        row.append(Panel(Axis("wavelength (nm)"), y, series, index.name))
    title = f"{title}: bands and continua of the line indices in the mean spectrum"
    return Picture([row], (1.0 + 2.3 * len(row), 3.1), title, below=True)
