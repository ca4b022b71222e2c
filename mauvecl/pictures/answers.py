"""Pictures of detections, receiver operating characteristics, spectra, observations and S/N."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection.fap_checks import NoThresholdError
from mauvecl.detection.requests import label
from mauvecl.detection.statistics import LinearStatistic
from mauvecl.pictures.registry import picture_of
from mauvecl.pictures.style import (
    COLOURS,
    COLUMN,
    MAX_COLUMNS,
    NULL,
    UNBROKEN,
    headline,
    legend_below,
    plain_numbers,
    styled_picture,
)
from mauvecl.study.parts import First, note_of, part_note

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.answers.detection.detect import DetectAnswer
    from mauvecl.detection.detection import Detection, Roc
    from mauvecl.detection.snr import SnrResult
    from mauvecl.host.exposure.expectation import Expectation

#: Flares of a star in one picture.
MOST_FLARES = 16
#: A star: title, findings, and its flares' names.
Shown = tuple[str, "Detection", Sequence[str]]
#: Largest number of stars in a picture.
MOST_STARS = 6


def _few(answer: DetectAnswer) -> First[Shown]:
    """Limit the number of stars so that each panel stays readable."""
    return First([star.shown for star in answer.stars], MOST_STARS, "stars")


def _alone(found: Detection) -> list[Shown]:
    return [(found.quiet.name, found, [f"flare {k + 1}" for k in range(len(found.flares))])]


@picture_of("DetectAnswer", "detection", given=lambda answer: (_few(answer), answer.study.run.fap))
@picture_of("Detection", "detection", given=lambda found: (_alone(found),))
@styled_picture
def detection(plt: Any, stars: Sequence[Shown], fap: float = 1e-3) -> Any:
    """Plot null and flare distributions, with a row per star and a column per statistic."""
    first = stars[0][1]
    statistics = first.statistics
    columns = min(len(statistics), MAX_COLUMNS)
    rows = -(-len(statistics) // columns)
    figure, axes = plt.subplots(
        rows * len(stars), columns, figsize=(COLUMN * columns, 2.6 * rows * len(stars) + 0.4), squeeze=False
    )
    for k, (title, outcome, flares) in enumerate(stars):
        panels = axes[k * rows : (k + 1) * rows]
        for axis, statistic in zip(panels.ravel(), statistics, strict=False):
            _distributions(axis, outcome, flares, statistic, fap)
        for axis in panels.ravel()[len(statistics) :]:
            axis.set_visible(False)
        for axis in panels[:, 0]:
            axis.set_ylabel(f"{title}\nrealisations, each peak = 1")
    handles, names = axes[0][0].get_legend_handles_labels()
    legend_below(figure, handles, names)
    exposures = " and ".join(sorted({f"{outcome.quiet.exposure_s:g}{UNBROKEN}s" for _, outcome, _ in stars}))
    headline(
        figure,
        f"Detection statistics without a flare and with one, {exposures}, "
        f"{first.realisations:,} realisations each; nominal throughput",
        note_of(stars),
        _flare_note(stars),
    )
    return figure


def _drawn_flares(names: Sequence[str]) -> list[int]:
    """Return the indices of the flares that a picture shows: all, or evenly spread from the first to the last."""
    return [round(k) for k in np.linspace(0, len(names) - 1, min(len(names), MOST_FLARES))]


def _flare_note(stars: Sequence[Shown]) -> str:
    """Return the note on the number of drawn flares; empty if all are drawn."""
    most = max(len(names) for *_, names in stars)
    return part_note(min(MOST_FLARES, most), most, "flares")


def _distributions(axis: Any, outcome: Detection, flares: Sequence[str], statistic: str, fap: float) -> None:
    one = outcome.statistic(statistic)
    linear = isinstance(one, LinearStatistic)
    shapes: list[tuple[int | None, str, str]] = [(None, NULL, "no flare")]
    chosen = _drawn_flares(flares)
    shapes += [(k, COLOURS[i % len(COLOURS)], flares[k]) for i, k in enumerate(chosen)]
    for flare, colour, name in shapes:
        edges, counts = outcome.histogram(statistic, flare, bins=120)
        middle, height = (edges[1:] + edges[:-1]) / 2, counts / counts.max()
        axis.fill_between(middle, height, step="mid", color=colour, alpha=0.3, linewidth=0)
        axis.step(middle, height, where="mid", color=colour, label=name)
    # Statistics that are scaled by the flare have a threshold per flare.
    own = chosen if one.shaped and not linear else [0]
    for i, k in enumerate(own):
        try:
            cut = outcome.threshold(fap, statistic, template=k).value
        except NoThresholdError:
            continue
        colour = COLOURS[i % len(COLOURS)] if len(own) > 1 else "black"
        name = f"threshold, fap {fap:g} per test"
        axis.axvline(cut, color=colour, linewidth=0.9, linestyle="--", label=None if len(own) > 1 else name)
    # Means differ by decades.
    if linear:
        axis.set_xscale("function", functions=(lambda x: np.arcsinh(x / 2), lambda y: 2 * np.sinh(y)))
        low, high = axis.get_xlim()
        ticks: list[float] = [t for t in (-4, 0, 4, 10, 30, 100, 1000, 10000) if low <= t <= high]
        axis.set_xticks(ticks, [str(t) for t in ticks])
    else:
        axis.set_xscale("log")
        low, high = axis.get_xlim()
        # Below two decades, powers of ten alone are too sparse.
        digits = (
            (1,)
            if high / low > 100
            else (1, 2, 5)
            if high / low > 3
            else (1, 1.2, 1.4, 1.6, 1.8, 2, 2.5, 3, 4, 5, 6, 8)
        )
        ticks = [d * 10.0**e for e in range(9) for d in digits]
        ticks = [t for t in ticks if low <= t <= high]
        axis.set_xticks(ticks, [f"{t:g}" if t < 1e5 else f"$10^{{{np.log10(t):.0f}}}$" for t in ticks])
        axis.tick_params(axis="x", which="minor", labelbottom=False)
    axis.set_ylim(bottom=0)
    axis.set_xlabel(label(statistic))


@picture_of("Roc", "roc")
def named_roc(curve: Roc, name: str = "", **how: Any) -> Any:
    """Plot a receiver operating characteristic with its area."""
    return roc([(name, curve)], **how)


@styled_picture
def roc(plt: Any, curves: Sequence[tuple[str, Roc]]) -> Any:
    """Plot receiver operating characteristics with their areas."""
    figure, axis = plt.subplots(figsize=(3.6, 2.9))
    for colour, (name, curve) in zip(cycle(COLOURS), curves, strict=False):
        table = curve.table()
        seen = np.asarray(table["fap"]) > 0
        text = f"{name}: area {curve.area.value:.4f}"
        axis.semilogx(table["fap"][seen], table["probability"][seen], color=colour, label=text)
        axis.fill_between(
            table["fap"][seen], table["probability_low"][seen], table["probability_high"][seen], color=colour,
            alpha=0.3, linewidth=0,
        )  # fmt: skip
    axis.set(xlabel="false-alarm probability per test", ylabel="detection probability", ylim=(0, 1.02))
    axis.legend(loc="lower right")
    return figure


@picture_of("DetectAnswer", "spectra", given=lambda answer: (_few(answer),))
@styled_picture
def spectra(plt: Any, stars: Sequence[Shown]) -> Any:
    """Plot mean spectra per second with pixel noise and, below, the flares in sigma of an element's noise."""
    figure, axes = plt.subplots(
        2, len(stars), figsize=(COLUMN * max(len(stars), 1), 5.0), squeeze=False, sharex=True, height_ratios=(3, 2)
    )
    for (above, below), (title, outcome, names) in zip(axes.T, stars, strict=True):
        quiet, flares = outcome.quiet, outcome.flares
        element, whole = quiet.element_wavelength_nm, _whole(quiet)
        sigma = np.sqrt(quiet.per_element(quiet.variance_dn2))
        for i, k in reversed(list(enumerate(_drawn_flares(names)))):
            x, colour = flares[k], COLOURS[i % len(COLOURS)]
            above.plot(x.wavelength_nm, x.signal_dn / x.exposure_s, color=colour, label=names[k])
            risen = x.per_element(x.signal_dn - quiet.signal_dn) / sigma
            below.plot(element[whole], risen[whole], color=colour)
        mean, noise = quiet.signal_dn / quiet.exposure_s, np.sqrt(quiet.variance_dn2) / quiet.exposure_s
        above.fill_between(
            quiet.wavelength_nm, mean - noise, mean + noise, color=NULL, alpha=0.35, linewidth=0,
            label="1 sigma of a pixel",
        )  # fmt: skip
        above.plot(quiet.wavelength_nm, mean, color="black", linestyle="--", label="no flare")
        above.set_title(f"{title}, {quiet.exposure_s:g} s")
        below.axhline(1.0, color=NULL, linewidth=0.8, linestyle="--")
        # The axis omits values below 0.01 sigma.
        below.set_yscale("log")
        below.set_ylim(bottom=max(below.get_ylim()[0], 0.03))
        plain_numbers(below)
        below.set_xlabel("wavelength (nm)")
        below.set_xlim(200, 700)
    axes[0][0].set_ylabel("net signal (DN s$^{-1}$ pixel$^{-1}$)")
    axes[1][0].set_ylabel("flare less quiet\n(sigma per 10.5 nm)")
    handles, shown = axes[0][0].get_legend_handles_labels()
    legend_below(figure, handles, shown)
    headline(
        figure,
        "Mean spectra as Mauve would see them; nominal throughput, not a flight calibration",
        note_of(stars),
        _flare_note(stars),
    )
    return figure


def _whole(x: Expectation) -> NDArray[np.bool_]:
    """Return the complete elements; the last one of the spectrum may have fewer pixels."""
    pixels = np.bincount(x.element, minlength=x.element_wavelength_nm.size)
    return np.asarray(pixels >= np.median(pixels) - 1)


@picture_of(
    "SimulateAnswer", "observation", each=lambda answer: [(title, table) for title, _, table in answer.observations]
)
@styled_picture
def observation(plt: Any, title: str, table: QTable) -> Any:
    """Plot a raw spectrum and its components, as the paper's figure of components."""
    panels = (
        ("raw", "raw spectrum"),
        ("source", "star"),
        ("sky", "zodiacal light"),
        ("photon_noise", "photon noise"),
        ("dark", "dark"),
        ("bias", "bias"),
        ("read_noise", "read noise"),
    )
    wavelength = table["wavelength"].to_value("nm")
    figure, axes = plt.subplots(len(panels), 1, figsize=(7.2, 9.5), sharex=True)
    for i, (axis, (name, text)) in enumerate(zip(axes, panels, strict=True)):
        axis.plot(wavelength, table[name].value, color=COLOURS[i % len(COLOURS)], linewidth=0.7)
        axis.set_title(f"({'abcdefg'[i]}) {text}")
        axis.set_ylabel("DN")
    axes[-1].set_xlabel("wavelength (nm)")
    axes[-1].set_xlim(200, 700)
    headline(figure, f"{title}: one observation of {table.meta['exposure_s']:g} s; nominal throughput")
    return figure


@picture_of(
    "SnrAnswer",
    "snr",
    given=lambda answer: (First([(star.title, star.result) for star in answer.stars], MOST_STARS, "stars"),),
)
@picture_of("SnrResult", "snr", given=lambda result: ([(result.expectation.name, result)],))
@styled_picture
def signal_to_noise(plt: Any, stars: Sequence[tuple[str, SnrResult | Expectation]]) -> Any:
    """Plot the closed-form S/N per pixel and resolution element, and the spread of realisations if simulated."""
    from mauvecl.detection.snr import SnrResult

    figure, axes = plt.subplots(len(stars), 2, figsize=(7.6, 2.6 * len(stars) + 0.4), squeeze=False, sharex=True)
    for row, (title, result) in zip(axes, stars, strict=True):
        x, pixel, element = (
            (result.expectation, result.pixel, result.element)
            if isinstance(result, SnrResult)
            else (result, None, None)
        )
        whole = _whole(x)
        for axis, what, wavelength, expected, table in (
            (row[0], "per pixel", x.wavelength_nm, x.snr(), pixel),
            (
                row[1],
                "per 10.5 nm element",
                x.element_wavelength_nm[whole],
                x.snr_per_element()[whole],
                None if element is None else element[whole],
            ),
        ):
            for low, high, alpha, text in (("q2.5", "q97.5", 0.25, "95 %"), ("q16", "q84", 0.45, "68 %")):
                if table is not None:
                    axis.fill_between(
                        wavelength, table[low], table[high], color=COLOURS[0], alpha=alpha, linewidth=0,
                        label=f"{text} of realisations",
                    )  # fmt: skip
            axis.plot(wavelength, expected, color="black", linewidth=0.9, label="closed form")
            axis.set_ylabel(f"S/N {what}")
            axis.set_title(title if f"{x.exposure_s:g} s" in title else f"{title}, {x.exposure_s:g} s")
            axis.set_xlim(200, 700)
    handles, names = axes[0][0].get_legend_handles_labels()
    legend_below(figure, handles, names)
    headline(figure, "S/N of one exposure; nominal throughput, not a flight calibration", note_of(stars))
    for axis in axes[-1]:
        axis.set_xlabel("wavelength (nm)")
    return figure
