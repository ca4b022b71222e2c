"""Pictures of measurements: a fit with its residuals, contours, pulls, errors against amplitude or time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.fits.flare_model import FlareModel, usable_variance
from mauvecl.pictures.registry import picture_of
from mauvecl.pictures.style import COLOURS, NULL, headline, styled_picture
from mauvecl.study.parts import First, note_of

if TYPE_CHECKING:
    from mauvecl.answers.measurements.along import JointFit, MeasuredStare
    from mauvecl.answers.measurements.measure import MeasureAnswer, MeasuredFlare

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
def fits(plt: Any, flares: Sequence[MeasuredFlare]) -> Any:
    """Plot the first exposure minus unknowns with the fitted flare, and the residuals, with a column per fit."""
    figure, axes = plt.subplots(
        2, len(flares), figsize=(3.6 * len(flares), 4.6), squeeze=False, sharex=True, height_ratios=(2, 1)
    )
    for (upper, lower), one in zip(axes.T, flares, strict=True):
        quiet, found = one.quiet, one.found
        mean, unknown = one.fitted_dn()
        kelvin = " and ".join(f"{x:.0f} K" for x in np.atleast_1d(np.exp(found.log_k[0])))
        variance, used = usable_variance(quiet, mean, one.skipped_nm)
        sums = [quiet.per_element(np.where(used, values, 0.0)) for values in (one.frame - unknown, mean, variance)]
        # Resolution elements of which some pixels are not used are not shown.
        whole = quiet.per_element(used.astype(np.float64)) == quiet.per_element(np.ones(used.size))
        data, fit, variance = (np.where(whole, values, np.nan) for values in sums)
        nm, noise = quiet.element_wavelength_nm, np.sqrt(variance)
        upper.errorbar(nm, data, noise, fmt=".", color=NULL, label="exposure less star and unknowns")
        upper.plot(nm, fit, color=COLOURS[0], label=f"fit: {kelvin}")
        lower.plot(nm, (data - fit) / noise, ".", color=COLOURS[0])
        lower.axhline(0.0, color=NULL, linewidth=0.8)
        lower.set(xlabel="wavelength (nm)", ylabel="residual / noise")
        upper.set(title=one.name, ylabel="DN per resolution element")
        upper.legend(loc="best")
    headline(figure, note_of(flares))
    return figure


def _single(answer: MeasureAnswer) -> tuple[Any, ...]:
    single = [one for one in answer.flares if isinstance(one.fitted, FlareModel)]
    return (First(single, MOST_FLARES, "flares"),)


@picture_of("MeasureAnswer", "contours", given=_single, when=lambda answer: bool(_single(answer)[0]))
@styled_picture
def contours(plt: Any, flares: Sequence[MeasuredFlare]) -> Any:
    """Plot expected confidence regions of temperature and amplitude, with unknowns marginalised."""
    figure, axes = plt.subplots(1, len(flares), figsize=(3.4 * len(flares), 3.2), squeeze=False)
    for axis, one in zip(axes[0], flares, strict=True):
        for rise, line in zip(RISES, ("-", "--"), strict=True):
            kelvin, low, high = one.region(rise)
            around = np.concatenate([kelvin, kelvin[::-1], kelvin[:1]]), np.concatenate([low, high[::-1], low[:1]])
            axis.plot(*around, line, color=COLOURS[0])
        axis.plot(one.perfect.estimates[0, 0], one.perfect.estimates[0, 1], "+", color=COLOURS[4])
        if np.isfinite(one.truth[:2]).all():
            axis.plot(*one.truth[:2], "x", color="black")
        axis.set(xlabel="temperature (K)", ylabel="amplitude", title=one.name)
    headline(figure, note_of(flares))
    return figure


@picture_of("MeasureAnswer", "pulls", given=_few)
@styled_picture
def pulls(plt: Any, flares: Sequence[MeasuredFlare]) -> Any:
    """Plot the pulls of estimates, (estimate - truth) / standard error, and the standard normal."""
    figure, axes = plt.subplots(1, len(flares), figsize=(3.4 * len(flares), 3.0), squeeze=False)
    x = np.linspace(-5.0, 5.0, 201)
    for axis, one in zip(axes[0], flares, strict=True):
        # Temperature, amplitude and the next one; an observed flare has only fluxes.
        for colour, q in zip(COLOURS, np.flatnonzero(np.isfinite(one.truth))[:3], strict=False):
            with np.errstate(invalid="ignore", divide="ignore"):
                pull = (one.found.estimates[:, q] - one.truth[q]) / one.found.errors[:, q]
            pull = pull[np.isfinite(pull)]
            axis.hist(np.clip(pull, -5, 5), bins=40, range=(-5, 5), density=True, histtype="step", color=colour,
                      label=one.found.names[q])  # fmt: skip
        axis.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color=NULL, linestyle="--", label="normal")
        axis.set(xlabel="(estimate - truth) / error", ylabel="density", title=one.name)
        axis.legend(loc="best")
    headline(figure, note_of(flares))
    return figure


@picture_of("MeasureAnswer", "errors", given=_few)
@styled_picture
def errors(plt: Any, flares: Sequence[MeasuredFlare]) -> Any:
    """Plot forecast errors of temperature and amplitude against the amplitude, with and without unknowns."""
    figure, axes = plt.subplots(1, len(flares), figsize=(3.4 * len(flares), 3.0), squeeze=False)
    for axis, one in zip(axes[0], flares, strict=True):
        for unknown, line in {None: "--", one.unknown: "-"}.items():
            ahead = one.forecasts(FACTORS, unknown)
            for colour, q in zip(COLOURS, range(2), strict=False):
                whose = "all known" if unknown is None else "unknowns free"
                relative = [f.errors[q] / f.values[q] for f in ahead]
                axis.plot(
                    FACTORS * one.perfect.estimates[0, 1],
                    relative,
                    line,
                    color=colour,
                    label=f"{one.fitted.names[q]}, {whose}",
                )
        axis.set(xscale="log", yscale="log", xlabel="amplitude", ylabel="relative error", title=one.name)
        axis.legend(loc="best")
    headline(figure, note_of(flares))
    return figure


@picture_of("MeasureAnswer", "temperatures", each=lambda answer: [(one,) for one in answer.stares if one.perfect])
@styled_picture
def temperatures(plt: Any, one: MeasuredStare) -> Any:
    """Plot temperature, size and light of the flares of a stare against time, with 95 % intervals.

    Lines are the fits to the same frames without noise.
    """
    drawn, perfect = one.drawn, one.perfect
    assert drawn is not None
    assert not isinstance(drawn, str)
    assert perfect is not None
    found = drawn.found
    size = "area" if "area" in found.names else "amplitude"
    light = "luminosity bolometric" if "area" in found.names else "flux bolometric"
    middle, reach = (drawn.start_s + drawn.end_s) / 2, (drawn.end_s - drawn.start_s) / 2
    figure, axes = plt.subplots(3, 1, figsize=(7.2, 6.4), sharex=True)
    for axis, name, colour in zip(axes, ("temperature", size, light), COLOURS, strict=False):
        q = found.column(name)
        estimate, low, high = found.estimates[:, q], found.low[-1, :, q], found.high[-1, :, q]
        ends = np.where(np.isfinite([low, high]), np.abs([estimate - low, high - estimate]), 0.0)
        axis.errorbar(middle, estimate, ends, reach, fmt=".", color=colour)
        limits = ~np.isfinite(high)
        axis.plot(middle[limits], low[limits], "^", color=colour)
        axis.step(middle, perfect.found.estimates[:, q], where="mid", color=NULL, linewidth=1)
        shown = np.append(estimate, perfect.found.estimates[:, q])
        axis.set(ylabel=f"{name} ({found.units[q]})" if found.units[q] else name, yscale="log")
        axis.set_ylim(0.5 * shown[shown > 0].min(), 2 * shown[shown > 0].max())
    axes[-1].set_xlabel("time from the start of the stare (s)")
    headline(figure, f"{one.title}: one simulated stare; nominal throughput")
    return figure


@picture_of("MeasureAnswer", "joint", each=lambda answer: [(one, one.joint) for one in answer.stares if one.joint])
@styled_picture
def joint(plt: Any, one: MeasuredStare, fit: JointFit) -> Any:
    """Plot the light of a flare in each frame, the joint fit of its shape and spectrum, residuals and temperature."""
    stare, (event,), (drawn, mean) = one.staring.stare, one.events, (fit.fitted.drawn_dn, fit.fitted.mean_dn)
    time = stare.start_s + stare.frame_s / 2
    near = (time > event.peak_s - BEFORE * event.half_width_s) & (time < event.peak_s + AFTER * event.half_width_s)
    figure, axes = plt.subplots(3, 1, figsize=(7.2, 6.4), sharex=True, height_ratios=(2, 1, 1.5))
    axes[0].plot(time[near], drawn[near], ".", color=NULL, label="frames less star, sky and dark")
    axes[0].plot(time[near], mean[near], color=COLOURS[0], label="joint fit")
    axes[0].set(ylabel="DN per frame")
    axes[1].plot(time[near], (drawn - mean)[near], ".", color=COLOURS[0])
    axes[1].axhline(0.0, color=NULL, linewidth=0.8)
    axes[1].set(ylabel="residual (DN)")
    axes[2].plot(time[near], fit.true.kelvin[near], "--", color=NULL, label="simulated flare")
    axes[2].plot(time[near], fit.fitted.kelvin[near], color=COLOURS[0], label="joint fit")
    axes[2].set(ylabel="temperature (K)", xlabel="time from the start of the stare (s)")
    for axis in axes[::2]:
        axis.legend(loc="best")
    headline(figure, f"{one.title}: one simulated stare; nominal throughput")
    return figure
