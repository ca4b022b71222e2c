"""Pictures of stares: light curves in bands, and dynamic spectra."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.pictures.registry import picture_of
from mauvecl.pictures.style import COLOURS, NULL, headline, styled_picture

if TYPE_CHECKING:
    from mauvecl.answers.stares.star_stare import StarStare
    from mauvecl.answers.stares.stare import StareAnswer
    from mauvecl.flares.stare import Stare

Float = NDArray[np.float64]
#: Largest number of points of a light curve, and of rows of a dynamic spectrum; longer stares are averaged.
MOST_POINTS, MOST_ROWS = 4000, 600
#: Longest durations that are shown in seconds, and in minutes, s.
IN_SECONDS_S, IN_MINUTES_S = 600.0, 4 * 3600.0


@picture_of("StareAnswer", "light-curve", each=lambda answer: [(one,) for one in answer.stares])
@styled_picture
def light_curves(plt: Any, one: StarStare) -> Any:
    """Plot light curves in all bands, relative to the quiescent star.

    Dotted lines are injected flares, triangles detections. Shaded frames lose light in pointing drifts.
    """
    from mauvecl.answers.stares.star_stare import SearchResult

    stare, light = one.staring.stare, one.light
    scale, unit = time_unit(stare.duration_s)
    level = np.median(light.mean, axis=0)
    figure, axes = plt.subplots(
        len(light.bands), 1, figsize=(7.2, 1.5 * len(light.bands) + 0.7), sharex=True, squeeze=False
    )
    for k, axis in enumerate(axes[:, 0]):
        colour = "black" if k == 0 else COLOURS[(k - 1) % len(COLOURS)]
        for part in _runs(stare.numbers):
            step = -(-part.size // max(1, MOST_POINTS * part.size // stare.n_frames))
            time, flux, mean = (
                _binned(values[part], step) for values in (stare.middle_s, light.flux[:, k], light.mean[:, k])
            )
            axis.plot(time / scale, flux / level[k], ".", markersize=2, color=colour, alpha=0.6)
            axis.plot(time / scale, mean / level[k], color=NULL, linewidth=0.8)
        lost = stare.numbers[:0] if one.pointing_loss is None else stare.numbers[one.pointing_loss > 0]
        for part in _runs(lost) if lost.size else ():
            first, last = lost[part[0]] * stare.frame_s, (lost[part[-1]] + 1) * stare.frame_s
            axis.axvspan(first / scale, last / scale, color=NULL, alpha=0.2, linewidth=0)
        for flare in one.flares:
            axis.axvline(flare.event.peak_s / scale, color=NULL, linewidth=0.5, linestyle=":")
        if isinstance(one.search, SearchResult):
            peaks = [float(alarm.recovered.peak_s[0]) / scale for alarm in one.search.alarms if alarm.measured]
            top = [1.0] * len(peaks)
            axis.plot(peaks, top, "v", color=COLOURS[4], markersize=4, transform=axis.get_xaxis_transform())
        axis.set_title(light.bands[k])
        axis.set_ylabel("relative light")
    axes[-1, 0].set_xlabel(f"time from the start of the stare ({unit})")
    headline(figure, f"{one.title}: one simulated stare; nominal throughput")
    return figure


@styled_picture
def compare_light_curves(plt: Any, answers: Sequence[tuple[str, StareAnswer]], band: int = 0) -> Any:
    """Plot a band's light curves of several answers, with a row per star and a column per answer.

    Parameters
    ----------
    answers : sequence of (str, StareAnswer)
        Title and answer of each column.
    band : int
        Number of the band, 0 the whole range.
    """
    rows = len(answers[0][1].stares)
    figure, axes = plt.subplots(
        rows, len(answers), figsize=(3.7 * len(answers), 1.5 * rows + 0.8), squeeze=False, sharex=True, sharey="row"
    )
    for column, (title, answer) in zip(axes.T, answers, strict=True):
        for axis, one in zip(column, answer.stares, strict=True):
            light, stare = one.light, one.staring.stare
            scale, unit = time_unit(stare.duration_s)
            level = np.median(light.mean[:, band])
            axis.plot(stare.middle_s / scale, light.flux[:, band] / level, ".", markersize=1.5, color=COLOURS[0])
            axis.plot(stare.middle_s / scale, light.mean[:, band] / level, color=NULL, linewidth=0.8)
            axis.set_title(f"{one.title}, {light.bands[band]}")
        column[0].set_title(f"{title}\n{column[0].get_title(loc='left')}")
        column[-1].set_xlabel(f"time ({unit})")
    for axis in axes[:, 0]:
        axis.set_ylabel("relative light")
    return figure


@picture_of("StareAnswer", "dynamic-spectrum", each=lambda answer: [(one,) for one in answer.stares])
@styled_picture
def dynamic_spectrum(plt: Any, one: StarStare) -> Any:
    """Plot each resolution element and frame, in standard deviations from the median over the stare."""
    light = one.light
    figure, axis = plt.subplots(figsize=(7.2, 3.6))
    column_s = show_spectra(axis, one.staring.stare, light.spectrum, light.spectrum_sd, light.element_nm)
    axis.set_title(f"{one.title}: dynamic spectrum, {column_s:g} s to a column")
    return figure


def show_spectra(axis: Any, stare: Stare, spectra: NDArray[Any], sd: NDArray[Any], wavelength_nm: Float) -> float:
    """Show spectra against time, in standard deviations from their median, and return the time of a column in s.

    Parameters
    ----------
    stare : Stare
        Times of the frames.
    spectra, sd : ndarray, shape (n_frame, n_pixel)
    wavelength_nm : ndarray, shape (n_pixel,)
    """
    scale, unit = time_unit(stare.duration_s)
    # The stare is shown on a regular grid with empty gaps.
    numbers = stare.numbers - stare.numbers[0]
    step = -(-(int(numbers[-1]) + 1) // MOST_ROWS)
    rows = numbers // step
    n_rows = int(rows[-1]) + 1
    counts = np.bincount(rows, minlength=n_rows)[:, None].astype(np.float64)

    def summed(values: NDArray[Any]) -> Float:
        return np.array([np.bincount(rows, column, minlength=n_rows) for column in values.T]).T

    centred = spectra - np.median(spectra, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        image = summed(centred) / np.sqrt(summed(sd.astype(np.float64) ** 2))
    image[counts[:, 0] == 0] = np.nan
    reach = max(3.0, float(np.nanpercentile(np.abs(image), 99.5)))
    half = (wavelength_nm[1] - wavelength_nm[0]) / 2 if wavelength_nm.size > 1 else 5.0
    extent = (0.0, n_rows * step * stare.frame_s / scale, wavelength_nm[0] - half, wavelength_nm[-1] + half)
    shown = axis.imshow(
        image.T, origin="lower", aspect="auto", extent=extent, cmap="RdBu_r", vmin=-reach, vmax=reach,
        interpolation="nearest",
    )  # fmt: skip
    axis.set_facecolor("#dddddd")
    axis.figure.colorbar(shown, label="standard deviations from the median")
    axis.set(xlabel=f"time from the start of the stare ({unit})", ylabel="wavelength (nm)")
    return step * stare.frame_s


def time_unit(duration_s: float) -> tuple[float, str]:
    if duration_s <= IN_SECONDS_S:
        return 1.0, "s"
    return (
        (60.0, "min")
        if duration_s <= IN_MINUTES_S
        else (3600.0, "h")
        if duration_s <= 3 * 86_400.0
        else (86_400.0, "d")
    )


def _runs(numbers: NDArray[np.int64]) -> list[NDArray[np.intp]]:
    """Return the runs of frames between gaps."""
    return np.split(np.arange(numbers.size), np.flatnonzero(np.diff(numbers) > 1) + 1)


def _binned(values: Float, step: int) -> Float:
    """Average groups of `step` values; the last group may be smaller."""
    edges = np.arange(0, values.size, max(1, step))
    return np.asarray(np.add.reduceat(values, edges) / np.diff(np.append(edges, values.size)))
