"""Charts of spectra: inputs of an expectation, fitted instruments, changes between visits, and fits of flares."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.charts import chart
from mauvecl.charts.chart import WAVELENGTH, Area, Chart, Dots, Line, Panel, Picture, PlotAxis, Rule, Series, Strips
from mauvecl.charts.matplotlib import COLOURS, RANGE_NM, picture_of, unit_label
from mauvecl.schema.columns import first_items, with_error

if TYPE_CHECKING:
    from mauvecl.answers.calibrate import CalibrateAnswer
    from mauvecl.answers.change import ChangeAnswer
    from mauvecl.answers.measure import JointFit, MeasureAnswer, MeasuredFlare, MeasuredStare
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.stars.source import Source

MOST_CHANGES, MOST_FLARES = 3, 4  # largest numbers of changes whose periods are drawn, and of flares, in a picture
BIN, GROUPS = 16, 60  # numbers of pixels for a point of the residuals, and of values for one of the photon transfer
AROUND_NM = 15.0  # range that is drawn on both sides of an index
RISES = {"68 %": 2.30, "95 %": 5.99}  # increases of chi-squared that enclose these shares in two dimensions
FACTORS = np.geomspace(0.1, 10.0, 25)  # factors on the amplitude over which errors are plotted
BEFORE, AFTER = 3.0, 15.0  # half-widths before and after the peak of a flare that are plotted
MANY_FITS = 1000  # number of fits from which histograms of pulls have narrow bins


@picture_of("Source", "source")
def source(star: Source) -> Panel:
    """Plot a spectrum in Mauve's wavelength range."""
    inside = (star.wavelength_nm >= RANGE_NM[0]) & (star.wavelength_nm <= RANGE_NM[1])
    flux = Line("", "star", width=1.1, at=(star.wavelength_nm[inside], star.flux_flam[inside]))
    y = PlotAxis("flux (erg s$^{-1}$ cm$^{-2}$ Å$^{-1}$)")
    return Panel(WAVELENGTH, y, [flux], ", ".join([star.name, *star.history]))


@picture_of("Expectation", "expectation")
def expectation(x: Expectation) -> Panel:
    """Plot the mean signal of an exposure with its noise."""
    w, mean, noise = (x.table[name].value for name in ("wavelength", "signal", "noise"))
    band = Area("1 sigma of a pixel", alpha=0.35, at=(w, mean - noise, mean + noise))
    line = Line("mean signal", "star", width=1.2, at=(w, mean))
    return Panel(PlotAxis("wavelength (nm)", limits=(w[0], w[-1])), PlotAxis("DN per pixel"), [band, line],
                 f"{x.name}, {x.exposure_s:g} s")  # fmt: skip


NO_OBSERVATIONS = "Choose an archive of observations; Calibrate then fits the instrument."


@Chart(
    "throughput", "Throughput: fitted and nominal", WAVELENGTH, PlotAxis("electrons per photon (%)"),
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
    below = Panel(WAVELENGTH, PlotAxis("fitted / nominal"), ratio)
    return Picture([[above], [below]], (5.2, 4.6), f"Throughput {answer.source}", share_x=True)


@Chart(
    "residuals", "Observed less fitted spectra", WAVELENGTH, PlotAxis(f"residual of {BIN} pixels (sigma)"),
    (
        chart.Targets("residual", tips=("residual (sigma)",)),
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
    rows = [[Panel(WAVELENGTH, PlotAxis("residual (sigma)"), [two, Dots("", "star", at=(nm, row))], name)]
            for name, nm, row in residuals_of_stars.series_of(answer)["residual"]]  # fmt: skip
    title, notes = f"Observed less fitted spectra, means of {BIN} pixels", f"p-value {answer.throughput.p_value:.2g}"
    return Picture(rows, (5.2, 1.0 + 1.1 * len(rows)), title, ("grey: 2 sigma", notes), share_x=True, share_y=True)


@Chart(
    "transfer", "Photon transfer: variance of frames against their mean", PlotAxis("fitted variance (DN²)", log=True),
    PlotAxis("measured variance (DN²)", log=True),
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
    below = Panel(variances_of_frames.x, PlotAxis("difference (%)"), [Rule(along="y", dash="-", at=0), off])
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
    pixel_panel = Panel(WAVELENGTH, PlotAxis("dark current (DN/s)"), [pixels], f"pixels at {d.reference_c:.1f} °C")
    mean_panel = Panel(PlotAxis("detector temperature (°C)"), PlotAxis("mean dark current (DN/s)"), mean)
    title = f"Dark current: slope {with_error(d.slope_per_c, d.slope_error)} per °C"
    return Picture([[pixel_panel, mean_panel]], (7.2, 2.9), title)


def along_magnitude(answer: ChangeAnswer, scales: Mapping[str, float]) -> list[tuple[str, Any, Any]]:
    """Return name, magnitudes and smallest changes of the first star, times the factor of their unit, where known."""
    from mauvecl.answers.change import MAGNITUDES

    lines = list[tuple[str, Any, Any]]()
    for name, unit in dict.fromkeys((row.change.name, row.change.unit) for row in answer.along):
        if unit in scales:
            changes = [row for row in answer.along if row.change.name == name][: MAGNITUDES.size]
            x, y = np.array([(row.magnitude, row.smallest.one) for row in changes]).T
            lines.append((shown_name(name), x[np.isfinite(y)], scales[unit] * y[np.isfinite(y)]))
    return lines


def shown_name(change: str) -> str:
    """Return the name of a change with its unit if it is a wavelength or a band, and with its capital letter."""
    return f"{change} nm" if change[0].isdigit() else change.replace("balmer", "Balmer")


@picture_of("ChangeAnswer", "change", when=lambda answer: bool(answer.along))
def change_against_magnitude(answer: ChangeAnswer) -> Picture:
    """Plot the smallest detectable changes against the magnitude of the star, one panel for each unit."""
    (title,), note = first_items(dict.fromkeys(row.title for row in answer.changes), 1, "stars")
    magnitude, row = answer.changes[0].magnitude, []
    for unit in dict.fromkeys(row.change.unit for row in answer.along):
        lines = [line for line in along_magnitude(answer, {unit: 1 if unit else 100}) if line[1].size]
        rules = [] if magnitude is None else [Rule("this star", dash="dotted", at=magnitude)]
        # Without a pixel that does not saturate there is nothing to show.
        values, limits = [value for _, _, column in lines for value in column], None
        if lines:
            # A decade at least, since errors beyond a few per cent do not matter, and room for the legend.
            limits = min(*values, max(values) / 5) / 1.2, 2 * max(*values, 5 * min(values))
        y = PlotAxis(f"smallest change ({unit_label(unit) if unit else '%'})", log=bool(lines), limits=limits)
        row.append(Panel(PlotAxis(f"magnitude ({answer.study.star[0].band})"), y, [chart.Targets(at=lines), *rules]))
    title = f"{title}: smallest change between {answer.visits}"
    return Picture([row], (1.0 + 3.3 * len(row), 3.6), title, (note,))


@picture_of("ChangeAnswer", "periods", when=lambda answer: bool(answer.periods))
def recovered_periods(answer: ChangeAnswer) -> Picture:
    """Plot the share of recovered periods over period and semi-amplitude, for the first changes."""
    (first, note), row = first_items(answer.periods, MOST_CHANGES, "changes"), []
    for row_of_change in first:
        r, scale = row_of_change.recovery, row_of_change.error * (1 if row_of_change.change.unit else 100)
        shares = 100 * row_of_change.shares("value")
        mesh = chart.Mesh("recovered (%)", high=100, at=(r.periods_d, scale * r.amplitudes, shares))
        unit = row_of_change.change.unit
        y = PlotAxis(f"semi-amplitude ({unit_label(unit) if unit else '%'})", log=True)
        row.append(Panel(PlotAxis("period (d)", log=True), y, [mesh], shown_name(row_of_change.change.name)))
    time = first[0].recovery.time_d
    title = f"{first[0].title}: periods that {time.size} visits within {np.ptp(time):.0f} days recover"
    return Picture([row], (1.0 + 2.9 * len(row), 3.2), title, (note,))


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
        y = PlotAxis(f"flux ({unit_label('erg / (s cm2 nm)')})")
        row.append(Panel(PlotAxis("wavelength (nm)"), y, series, index.name))
    title = f"{title}: bands and continua of the line indices in the mean spectrum"
    return Picture([row], (1.0 + 2.3 * len(row), 3.1), title, below=True)


@picture_of("MeasureAnswer", "fit")
def fits(answer: MeasureAnswer) -> Picture:
    """Plot the first exposure minus unknowns with the fitted flare, and the residuals, with a column per fit."""
    from mauvecl.fits.flare_model import usable_variance

    (flares, note), above, below = first_items(answer.flares, MOST_FLARES, "flares"), list[Panel](), list[Panel]()
    for flare in flares:
        quiet, measurement = flare.quiet, flare.found
        mean, unknown = flare.fitted_dn()
        kelvin = " and ".join(f"{x:.0f} K" for x in np.atleast_1d(np.exp(measurement.log_k[0])))
        variance, used = usable_variance(quiet, mean, flare.skipped_nm)
        sums = [quiet.per_element(np.where(used, values, 0.0)) for values in (flare.frame - unknown, mean, variance)]
        # Resolution elements of which some pixels are not used are not shown.
        pixels = quiet.per_element(np.ones(used.size))
        complete = quiet.per_element(used.astype(np.float64)) == pixels
        data, fit, variance = (np.where(complete, values, np.nan) for values in sums)
        nm, noise = quiet.element_wavelength_nm, np.sqrt(variance)
        x = PlotAxis("wavelength (nm)")
        # Means are shown, since elements differ in their number of pixels.
        dots = Dots("exposure less star and fitted unknowns", size=4, at=(nm, data / pixels, noise / pixels))
        line = Line(f"fit: {kelvin}", "star", at=(nm, fit / pixels))
        above.append(Panel(x, PlotAxis("mean of an element (DN per pixel)"), [dots, line], flare.name))
        residuals = Dots("", "star", size=4, at=(nm, (data - fit) / noise))
        below.append(Panel(x, PlotAxis("residual / noise"), [residuals, Rule(along="y", dash="-", at=0.0)]))
    size = 3.6 * len(flares), 4.6
    return Picture([above, below], size, notes=(note,), share_x=True, heights=(2, 1))


def _panel_per_flare(flares: Sequence[MeasuredFlare], panel: Callable[[MeasuredFlare], Panel]) -> Picture:
    """Return a picture with a panel for each of the first flares."""
    first, note = first_items(flares, MOST_FLARES, "flares")
    row = [panel(flare) for flare in first]
    return Picture([row], (3.4 * len(first), 3.6), notes=(note,), below=True)


def _of_single_temperature(answer: MeasureAnswer) -> list[MeasuredFlare]:
    """Return the flares whose model has a single temperature."""
    return [flare for flare in answer.flares if flare.model != "two-temperatures"]


@picture_of("MeasureAnswer", "contours", when=_of_single_temperature)
def contours(answer: MeasureAnswer) -> Picture:
    """Plot expected confidence regions of temperature and amplitude, with unknowns marginalised."""

    def panel(flare: MeasuredFlare) -> Panel:
        series: list[Series] = []
        for (share, rise), dash in zip(RISES.items(), ("-", "dashed"), strict=True):
            kelvin, low, high = flare.region(rise)
            around = np.concatenate([kelvin, kelvin[::-1], kelvin[:1]]), np.concatenate([low, high[::-1], low[:1]])
            series.append(Line(f"{share} of estimates", "star", dash=dash, at=around))
        series.append(Dots("estimate without noise", "flare", marker="+", size=14, at=flare.perfect.estimates[0, :2]))
        if np.isfinite(flare.truth[:2]).all():
            series.append(Dots("simulated flare", "text", marker="x", size=8, at=flare.truth[:2]))
        return Panel(PlotAxis("flare temperature (K)"), PlotAxis("flare amplitude"), series, flare.name)

    return _panel_per_flare(_of_single_temperature(answer), panel)


@picture_of("MeasureAnswer", "pulls")
def pulls(answer: MeasureAnswer) -> Picture:
    """Plot the pulls of estimates, (estimate - truth) / standard error, and the standard normal."""
    # Few fits need wide bins.
    bins = 40 if answer.study.measure.fits >= MANY_FITS else 20
    x, edges = np.linspace(-5.0, 5.0, 201), np.linspace(-5.0, 5.0, bins + 1)

    def panel(flare: MeasuredFlare) -> Panel:
        series: list[Series] = []
        # Temperature, amplitude and the next one; an observed flare has only fluxes.
        for colour, q in zip(COLOURS, np.flatnonzero(np.isfinite(flare.truth))[:3], strict=False):
            with np.errstate(invalid="ignore", divide="ignore"):
                pull = (flare.found.estimates[:, q] - flare.truth[q]) / flare.found.errors[:, q]
            density, _ = np.histogram(np.clip(pull[np.isfinite(pull)], -5, 5), edges, density=True)
            series.append(Line(flare.found.names[q], colour, step=True, at=((edges[1:] + edges[:-1]) / 2, density)))
        normal = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
        series.append(Line("standard normal", "text", dash="dashed", at=(x, normal)))
        x_axis = PlotAxis("(estimate \N{MINUS SIGN} truth) / standard error")
        return Panel(x_axis, PlotAxis("probability density"), series, flare.name)

    return _panel_per_flare(answer.flares, panel)


@picture_of("MeasureAnswer", "errors")
def errors(answer: MeasureAnswer) -> Picture:
    """Plot forecast errors of temperature and amplitude against the amplitude, with and without unknowns."""

    def panel(flare: MeasuredFlare) -> Panel:
        amplitudes, series = FACTORS * flare.perfect.estimates[0, 1], list[Series]()
        for unknown, dash in {None: "dashed", flare.unknown: "-"}.items():
            ahead = flare.forecasts(FACTORS, unknown)
            whose = "everything else known" if unknown is None else "with unknowns"
            for colour, q in zip(COLOURS, range(2), strict=False):
                relative = [f.errors[q] / f.values[q] for f in ahead]
                series.append(Line(f"{flare.fitted.names[q]}, {whose}", colour, dash=dash, at=(amplitudes, relative)))
        x, y = PlotAxis("flare amplitude", log=True), PlotAxis("relative standard error", log=True)
        return Panel(x, y, series, flare.name)

    return _panel_per_flare(answer.flares, panel)


@picture_of("MeasureAnswer", "temperatures", each=lambda answer: [(star,) for star in answer.stares if star.perfect])
def temperatures(star: MeasuredStare) -> Picture:
    """Plot temperature, size and light of the flares of a stare against time, with 95 % intervals.

    Lines are the fits to the same frames without noise.
    """
    drawn, perfect, rows = star.drawn, star.perfect, list[list[Panel]]()
    assert drawn is not None
    assert perfect is not None
    measurement = drawn.found
    sized = "area" in measurement.names
    size, light = ("area", "luminosity bolometric") if sized else ("amplitude", "flux bolometric")
    middle, reach = (drawn.start_s + drawn.end_s) / 2, (drawn.end_s - drawn.start_s) / 2
    for name in ("temperature", size, light):
        q = measurement.column(name)
        estimate, low, high = measurement.estimates[:, q], measurement.low[-1, :, q], measurement.high[-1, :, q]
        ends = np.where(np.isfinite([low, high]), np.abs([estimate - low, high - estimate]), 0.0)
        limits, true = ~np.isfinite(high), perfect.found.estimates[:, q]
        series = [
            Dots("fit, 95 %", "star", size=4, at=(middle, estimate, ends, reach)),
            Line("fit to the same frames without noise", step=True, at=(middle, true)),
        ]
        if limits.any():
            series.append(Dots("lower limit", "star", size=10, marker="^", at=(middle[limits], low[limits])))
        positive = [value for value in (*estimate, *true) if value > 0]
        unit = f" ({unit_label(measurement.units[q])})" if measurement.units[q] else ""
        label = " ".join(name.split(" ")[::-1]) + unit
        y = PlotAxis(label, log=True, limits=(0.5 * min(positive), 2 * max(positive)))
        rows.append([Panel(PlotAxis("time from the start of the stare (s)"), y, series)])
    title, notes = f"{star.title}: one simulated stare", (chart.throughput_of([star.staring.quiet]),)
    return Picture(rows, (7.2, 6.7), title, notes, below=True, share_x=True)


@picture_of("MeasureAnswer", "joint", each=lambda answer: [(star, star.joint) for star in answer.stares if star.joint])
def joint(star: MeasuredStare, fit: JointFit) -> Picture:
    """Plot the light of a flare in each frame, the joint fit of its shape and spectrum, residuals and temperature."""
    stare, (event,), (drawn, mean) = star.staring.stare, star.events, (fit.fitted.drawn_dn, fit.fitted.mean_dn)
    since = (stare.middle_s - event.peak_s) / event.half_width_s
    near = (since > -BEFORE) & (since < AFTER)
    x, time = PlotAxis("time from the start of the stare (s)"), stare.middle_s[near]
    dots = Dots("frames less star, sky, dark and unknowns", size=4, at=(time, drawn[near]))
    off = Dots("", "star", size=4, at=(time, (drawn - mean)[near]))
    true, fitted = fit.true.kelvin[near], fit.fitted.kelvin[near]
    simulated = Line("simulated flare", "text", dash="dashed", at=(time, true))
    limits = 0.8 * min(true.min(), fitted.min()), 1.2 * max(true.max(), fitted.max())
    kelvin = PlotAxis("temperature (K)", limits=limits)
    rows = [
        [Panel(x, PlotAxis("light (DN per frame)"), [dots, Line("joint fit", "star", at=(time, mean[near]))])],
        [Panel(x, PlotAxis("residual (DN)"), [off, Rule(along="y", dash="-", at=0.0)])],
        [Panel(x, kelvin, [Line("joint fit", "star", at=(time, fitted)), simulated])],
    ]
    title, notes = f"{star.title}: one simulated stare", (chart.throughput_of([star.staring.quiet]),)
    return Picture(rows, (7.2, 6.7), title, notes, below=True, share_x=True, heights=(2, 1, 1.5))
