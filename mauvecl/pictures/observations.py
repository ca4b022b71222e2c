"""Pictures of observed frames: the light curve with its events, and the noise."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import ndtri

from mauvecl.pictures.light_curves import show_spectra, time_unit
from mauvecl.pictures.registry import picture_of
from mauvecl.pictures.style import COLOURS, NULL, headline, styled_picture

if TYPE_CHECKING:
    from mauvecl.answers.observations.analyse import AnalyseAnswer
    from mauvecl.observations.analysis import Analysis
    from mauvecl.observations.events import ObservedEvent

#: Title of the light curve, which explains its colours.
KINDS = "events above {:.2f} (blue), candidates (grey), look-alikes (red)"
#: Flux in standard deviations above which the light curve has a second panel near the level.
BRIGHT = 30.0


@picture_of("AnalyseAnswer", "light-curve")
@styled_picture
def observed_light_curve(plt: Any, answer: AnalyseAnswer) -> Any:
    """Plot the observed light curve with its level and the level's band of 95 %, events, and frames not searched.

    If there are bright events, a second panel shows the part near the level.
    """
    one = answer.analysis
    time = (one.frames.time_s - one.frames.time_s[0]) / 60.0
    used = one.level.used
    finite = np.isfinite(one.flux)
    bright = bool((((one.flux - one.level.level) / one.level.error)[used] > BRIGHT).any())
    figure, axes = plt.subplots(1 + bright, 1, figsize=(7.2, 2.9 + 1.8 * bright), sharex=True, squeeze=False)
    for axis in axes[:, 0]:
        axis.plot(time[used], one.flux[used], ".", markersize=3, color="black", alpha=0.7)
        level, error = one.level.level, one.level.level_error
        axis.plot(time, level, color=COLOURS[2], linewidth=0.8)
        axis.fill_between(time, level - 2 * error, level + 2 * error, color=COLOURS[2], alpha=0.3, linewidth=0)
        left_out = ~used & finite
        axis.plot(time[left_out], one.flux[left_out], "x", markersize=5, color=COLOURS[1])
        for event in one.events:
            first, last = ((one.survey.time_s[k] - one.frames.time_s[0]) / 60.0 for k in (event.first, event.last))
            axis.axvspan(first, last, color=_colour(one, event), alpha=0.2, linewidth=0)
        axis.set_ylabel(f"flux ({one.frames.unit})" if one.frames.unit else "flux")
    if bright:
        axes[1, 0].set_ylim(
            float(np.min((one.level.level - 6 * one.level.error)[used])),
            float(np.max((one.level.level + BRIGHT / 2 * one.level.error)[used])),
        )
    else:
        axes[0, 0].set_ylim(
            float(np.min(one.flux[used] - one.level.error[used])), float(np.max(one.flux[used] + one.level.error[used]))
        )
    axes[-1, 0].set_xlabel(f"time (min) from {one.frames.date(float(one.frames.time_s[0]))[:19]}")
    headline(figure, f"{one.frames.name}: {KINDS.format(one.threshold)}")
    return figure


def _colour(one: Analysis, event: ObservedEvent) -> str:
    """Return the colour of an event."""
    if event.kind != "flare":
        return COLOURS[4]
    return COLOURS[0] if event.value >= one.threshold else NULL


@picture_of("AnalyseAnswer", "dynamic-spectrum", when=lambda answer: answer.analysis.spectra is not None)
@styled_picture
def observed_dynamic_spectrum(plt: Any, answer: AnalyseAnswer) -> Any:
    """Plot the searched spectra, in standard deviations from their median, and mark the events."""
    one, spectra = answer.analysis, answer.analysis.spectra
    assert spectra is not None
    stare, noise = one.survey.stare, spectra.series.noise
    figure, axis = plt.subplots(figsize=(7.2, 3.6))
    sd = np.broadcast_to(noise.used, spectra.series.excess.shape)
    show_spectra(axis, stare, spectra.series.excess, sd, noise.wavelength_nm)
    scale = time_unit(stare.duration_s)[0]
    for event in one.events:
        first, last = (stare.start_s[k] - stare.start_s[0] for k in (event.first, event.last))
        ends = np.array([first, last + stare.frame_s]) / scale
        axis.plot(ends, [1.02, 1.02], transform=axis.get_xaxis_transform(), color=_colour(one, event), linewidth=3,
                  clip_on=False, solid_capstyle="butt")  # fmt: skip
    headline(figure, f"{one.frames.name}: {KINDS.format(one.threshold)}")
    return figure


@picture_of("AnalyseAnswer", "noise-per-pixel", when=lambda answer: answer.analysis.spectra is not None)
@styled_picture
def observed_pixel_noise(plt: Any, answer: AnalyseAnswer) -> Any:
    """Plot the measured over the stated noise of each pixel, with the range of 95 % of normal noise."""
    spectra = answer.analysis.spectra
    assert spectra is not None
    noise = spectra.series.noise
    figure, axis = plt.subplots(figsize=(4.6, 3.2))
    axis.fill_between(noise.wavelength_nm, noise.low / noise.stated, noise.high / noise.stated, color=NULL, alpha=0.4,
                      linewidth=0)  # fmt: skip
    for which, colour in ((~noise.departs, COLOURS[0]), (noise.departs, COLOURS[4])):
        axis.plot(noise.wavelength_nm[which], (noise.measured / noise.stated)[which], ".", color=colour, markersize=3)
    axis.set_xlabel("wavelength (nm)")
    axis.set_ylabel("measured over stated noise")
    headline(figure, f"{answer.analysis.frames.name}: quiescent frames; grey: 95 % of normal noise; red: departs")
    return figure


@picture_of("AnalyseAnswer", "residuals")
@styled_picture
def observed_residuals(plt: Any, answer: AnalyseAnswer) -> Any:
    """Plot the residuals of the fitted process against time, their autocorrelation, and their quantiles."""
    one = answer.analysis
    residual = one.residual[:, 0]
    figure, axes = plt.subplots(1, 3, figsize=(9.6, 2.9), width_ratios=(2, 1, 1))
    time = (one.survey.time_s - one.frames.time_s[0]) / 60.0
    axes[0].plot(time[one.quiet], residual, ".", markersize=2, color="black", alpha=0.7)
    axes[0].set_xlabel("time (min)")
    axes[0].set_ylabel("residual (standard deviations)")
    lags = np.arange(1, one.likeness.correlations.size + 1)
    axes[1].axhspan(-2 * one.likeness.error, 2 * one.likeness.error, color=NULL, alpha=0.4, linewidth=0)
    axes[1].plot(lags, one.likeness.correlations, "o-", color=COLOURS[0], markersize=3)
    axes[1].set_xlabel("lag (frames)")
    axes[1].set_ylabel("autocorrelation")
    normal = ndtri((np.arange(residual.size) + 0.5) / residual.size)
    axes[2].plot(normal[[0, -1]], normal[[0, -1]], color=NULL)
    axes[2].plot(normal, np.sort(residual), ".", color=COLOURS[0], markersize=2)
    axes[2].set_xlabel("normal quantile")
    axes[2].set_ylabel("quantile of the residuals")
    headline(
        figure, f"{one.frames.name}: residuals of {one.level.process.name}; grey: 95 % of independent, normal noise"
    )
    return figure


@picture_of("AnalyseAnswer", "noise", when=lambda answer: len(answer.analysis.scatter) > 1)
@styled_picture
def observed_noise(plt: Any, answer: AnalyseAnswer) -> Any:
    """Plot the scatter of means of quiescent frames against their number, and that of independent frames."""
    rows = answer.analysis.scatter
    figure, axis = plt.subplots(figsize=(4.6, 3.2))
    frames = np.array([row.frames for row in rows])
    axis.fill_between(frames, [row.low for row in rows], [row.high for row in rows], color=NULL, alpha=0.4, linewidth=0)
    axis.plot(frames, [row.white for row in rows], color=NULL)
    axis.plot(frames, [row.measured for row in rows], "o-", color=COLOURS[0], markersize=4)
    axis.set_xscale("log", base=2)
    axis.set_yscale("log")
    axis.set_xlabel("frames in a mean")
    axis.set_ylabel("scatter (noise of one frame)")
    headline(figure, f"{answer.analysis.frames.name}: quiescent frames; grey: independent, 95 %")
    return figure
