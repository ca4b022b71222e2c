"""Charts of measurements: a fit with its residuals, contours, pulls, errors against amplitude or time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.charts.chart import Axis, Dots, Line, Panel, Picture, Rule, Series, picture_of
from mauvecl.charts.matplotlib import COLOURS, styled_picture
from mauvecl.fits.flare_model import FlareModel, usable_variance
from mauvecl.schema.columns import First, note_of

if TYPE_CHECKING:
    from mauvecl.answers.measure import MeasureAnswer, MeasuredFlare
    from mauvecl.answers.measurements import JointFit, MeasuredStare

#: Increases of chi-squared that enclose 68.27 and 95 % in two dimensions.
RISES = (2.30, 5.99)
#: Factors on the amplitude over which errors are plotted.
FACTORS = np.geomspace(0.1, 10.0, 25)
#: Half-widths before and after the peak of a flare that are plotted.
BEFORE, AFTER = 3.0, 15.0
#: Largest number of flares in a picture.
MOST_FLARES = 4


def _few(answer: MeasureAnswer) -> tuple[Any, ...]:
    return (First(answer.flares, MOST_FLARES, "flares"),)


@picture_of("MeasureAnswer", "fit", given=_few)
@styled_picture
def fits(flares: Sequence[MeasuredFlare]) -> Picture:
    """Plot the first exposure minus unknowns with the fitted flare, and the residuals, with a column per fit."""
    above, below = list[Panel](), list[Panel]()
    for flare in flares:
        quiet, measurement = flare.quiet, flare.found
        mean, unknown = flare.fitted_dn()
        kelvin = " and ".join(f"{x:.0f} K" for x in np.atleast_1d(np.exp(measurement.log_k[0])))
        variance, used = usable_variance(quiet, mean, flare.skipped_nm)
        sums = [quiet.per_element(np.where(used, values, 0.0)) for values in (flare.frame - unknown, mean, variance)]
        # Resolution elements of which some pixels are not used are not shown.
        whole = quiet.per_element(used.astype(np.float64)) == quiet.per_element(np.ones(used.size))
        data, fit, variance = (np.where(whole, values, np.nan) for values in sums)
        nm, noise = quiet.element_wavelength_nm, np.sqrt(variance)
        x = Axis("wavelength (nm)")
        dots = Dots("exposure less star and unknowns", size=4, at=(nm, data, noise))
        line = Line(f"fit: {kelvin}", "star", at=(nm, fit))
        above.append(Panel(x, Axis("DN per resolution element"), [dots, line], flare.name))
        residuals = Dots("", "star", size=4, at=(nm, (data - fit) / noise))
        below.append(Panel(x, Axis("residual / noise"), [residuals, Rule(along="y", dash="-", at=0.0)]))
    size = 3.6 * len(flares), 4.6
    return Picture([above, below], size, notes=(note_of(flares),), share_x=True, heights=(2, 1))


def _each(flares: Sequence[MeasuredFlare], panel: Callable[[MeasuredFlare], Panel]) -> Picture:
    """Return a picture with a panel per flare."""
    return Picture([[panel(flare) for flare in flares]], (3.4 * len(flares), 3.1), notes=(note_of(flares),))


def _single(answer: MeasureAnswer) -> tuple[Any, ...]:
    single = [flare for flare in answer.flares if isinstance(flare.fitted, FlareModel)]
    return (First(single, MOST_FLARES, "flares"),)


@picture_of("MeasureAnswer", "contours", given=_single, when=lambda answer: bool(_single(answer)[0]))
@styled_picture
def contours(flares: Sequence[MeasuredFlare]) -> Picture:
    """Plot expected confidence regions of temperature and amplitude, with unknowns marginalised."""

    def panel(flare: MeasuredFlare) -> Panel:
        series: list[Series] = []
        for rise, dash in zip(RISES, ("-", "dashed"), strict=True):
            kelvin, low, high = flare.region(rise)
            around = np.concatenate([kelvin, kelvin[::-1], kelvin[:1]]), np.concatenate([low, high[::-1], low[:1]])
            series.append(Line("", "star", dash=dash, at=around))
        series.append(Dots("", "flare", marker="+", size=10, at=flare.perfect.estimates[0, :2]))
        if np.isfinite(flare.truth[:2]).all():
            series.append(Dots("", "text", marker="x", size=10, at=flare.truth[:2]))
        return Panel(Axis("temperature (K)"), Axis("amplitude"), series, flare.name)

    return _each(flares, panel)


@picture_of("MeasureAnswer", "pulls", given=_few)
@styled_picture
def pulls(flares: Sequence[MeasuredFlare]) -> Picture:
    """Plot the pulls of estimates, (estimate - truth) / standard error, and the standard normal."""
    x, edges = np.linspace(-5.0, 5.0, 201), np.linspace(-5.0, 5.0, 41)

    def panel(flare: MeasuredFlare) -> Panel:
        series: list[Series] = []
        # Temperature, amplitude and the next one; an observed flare has only fluxes.
        for colour, q in zip(COLOURS, np.flatnonzero(np.isfinite(flare.truth))[:3], strict=False):
            with np.errstate(invalid="ignore", divide="ignore"):
                pull = (flare.found.estimates[:, q] - flare.truth[q]) / flare.found.errors[:, q]
            density, _ = np.histogram(np.clip(pull[np.isfinite(pull)], -5, 5), edges, density=True)
            series.append(Line(flare.found.names[q], colour, step=True, at=((edges[1:] + edges[:-1]) / 2, density)))
        normal = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
        series.append(Line("normal", dash="dashed", at=(x, normal)))
        return Panel(Axis("(estimate - truth) / error"), Axis("density"), series, flare.name)

    return _each(flares, panel)


@picture_of("MeasureAnswer", "errors", given=_few)
@styled_picture
def errors(flares: Sequence[MeasuredFlare]) -> Picture:
    """Plot forecast errors of temperature and amplitude against the amplitude, with and without unknowns."""

    def panel(flare: MeasuredFlare) -> Panel:
        amplitudes, series = FACTORS * flare.perfect.estimates[0, 1], list[Series]()
        for unknown, dash in {None: "dashed", flare.unknown: "-"}.items():
            ahead, whose = flare.forecasts(FACTORS, unknown), "all known" if unknown is None else "unknowns free"
            for colour, q in zip(COLOURS, range(2), strict=False):
                relative = [f.errors[q] / f.values[q] for f in ahead]
                series.append(Line(f"{flare.fitted.names[q]}, {whose}", colour, dash=dash, at=(amplitudes, relative)))
        return Panel(Axis("amplitude", log=True), Axis("relative error", log=True), series, flare.name)

    return _each(flares, panel)


@picture_of("MeasureAnswer", "temperatures", each=lambda answer: [(star,) for star in answer.stares if star.perfect])
@styled_picture
def temperatures(star: MeasuredStare) -> Picture:
    """Plot temperature, size and light of the flares of a stare against time, with 95 % intervals.

    Lines are the fits to the same frames without noise.
    """
    drawn, perfect, rows = star.drawn, star.perfect, list[list[Panel]]()
    assert drawn is not None
    assert not isinstance(drawn, str)
    assert perfect is not None
    measurement = drawn.found
    size = "area" if "area" in measurement.names else "amplitude"
    light = "luminosity bolometric" if "area" in measurement.names else "flux bolometric"
    middle, reach = (drawn.start_s + drawn.end_s) / 2, (drawn.end_s - drawn.start_s) / 2
    for name, colour in zip(("temperature", size, light), COLOURS, strict=False):
        q = measurement.column(name)
        estimate, low, high = measurement.estimates[:, q], measurement.low[-1, :, q], measurement.high[-1, :, q]
        ends = np.where(np.isfinite([low, high]), np.abs([estimate - low, high - estimate]), 0.0)
        limits, true = ~np.isfinite(high), perfect.found.estimates[:, q]
        series = [
            Dots("", colour, size=4, at=(middle, estimate, ends, reach)),
            Dots("", colour, size=10, marker="^", at=(middle[limits], low[limits])),
            Line("", step=True, at=(middle, true)),
        ]
        positive = [value for value in (*estimate, *true) if value > 0]
        label = f"{name} ({measurement.units[q]})" if measurement.units[q] else name
        y = Axis(label, log=True, limits=(0.5 * min(positive), 2 * max(positive)))
        rows.append([Panel(Axis("time from the start of the stare (s)"), y, series)])
    return Picture(rows, (7.2, 6.4), f"{star.title}: one simulated stare; nominal throughput", share_x=True)


@picture_of("MeasureAnswer", "joint", each=lambda answer: [(star, star.joint) for star in answer.stares if star.joint])
@styled_picture
def joint(star: MeasuredStare, fit: JointFit) -> Picture:
    """Plot the light of a flare in each frame, the joint fit of its shape and spectrum, residuals and temperature."""
    stare, (event,), (drawn, mean) = star.staring.stare, star.events, (fit.fitted.drawn_dn, fit.fitted.mean_dn)
    since = (stare.middle_s - event.peak_s) / event.half_width_s
    near = (since > -BEFORE) & (since < AFTER)
    x, time = Axis("time from the start of the stare (s)"), stare.middle_s[near]
    light: list[Series] = [
        Dots("frames less star, sky and dark", size=4, at=(time, drawn[near])),
        Line("joint fit", "star", at=(time, mean[near])),
    ]
    off = Dots("", "star", size=4, at=(time, (drawn - mean)[near]))
    kelvin: list[Series] = [
        Line("simulated flare", dash="dashed", at=(time, fit.true.kelvin[near])),
        Line("joint fit", "star", at=(time, fit.fitted.kelvin[near])),
    ]
    axes = {"DN per frame": light, "residual (DN)": [off, Rule(along="y", dash="-", at=0.0)], "temperature (K)": kelvin}
    rows = [[Panel(x, Axis(label), series)] for label, series in axes.items()]
    title = f"{star.title}: one simulated stare; nominal throughput"
    return Picture(rows, (7.2, 6.4), title, share_x=True, heights=(2, 1, 1.5))
