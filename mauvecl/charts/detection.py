"""Charts of detections and of the instrument's unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.charts.chart import WAVELENGTH, Area, Axis, Dots, Line, Panel, Picture, Rule, Series
from mauvecl.charts.matplotlib import COLOURS, COLUMN, MAX_COLUMNS, UNBROKEN, in_rows, picture_of, written
from mauvecl.detection import NoThresholdError
from mauvecl.detection.requests import statistic_label
from mauvecl.detection.statistics import LinearStatistic
from mauvecl.schema.columns import First, note_of, part_note
from mauvecl.study.questions import QUANTITIES

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.answers.detect import DetectAnswer, UnknownAnswer
    from mauvecl.detection.detection import Detection, Roc
    from mauvecl.detection.snr import SnrResult
    from mauvecl.host.exposure.expectation import Expectation

#: Flares of a star in one picture.
MOST_FLARES = 16
#: A star: title, findings, and its flares' names.
Shown = tuple[str, "Detection", Sequence[str]]
#: Largest number of stars in a picture.
MOST_STARS = 6
#: Share of the axis of a statistic that stays empty on either side.
MARGIN = 0.04
#: Length of the axis of a weighted sum, in the inverse hyperbolic sine, above which few of its ticks have a number.
WIDE = 5.0


def _few(answer: DetectAnswer) -> First[Shown]:
    """Limit the number of stars so that each panel stays readable."""
    stars = [
        (star.title, star.detection, [f"flare {100 * amplitude:g} %" for amplitude in star.amplitudes])
        for star in answer.stars
    ]
    return First(stars, MOST_STARS, "stars")


@picture_of("DetectAnswer", "detection", given=lambda answer: (_few(answer), answer.study.run.fap))
@picture_of(
    "Detection",
    "detection",
    given=lambda outcome: ([(outcome.quiet.name, outcome, [f"flare {k + 1}" for k in range(len(outcome.flares))])],),
)
def detection(stars: Sequence[Shown], fap: float = 1e-3) -> Picture:
    """Plot null and flare distributions, with a row per star and a column per statistic."""
    first, rows = stars[0][1], list[Sequence[Panel]]()
    columns = min(len(first.statistics), MAX_COLUMNS)
    for star in stars:
        rows += in_rows([_distributions(*star, statistic, fap) for statistic in first.statistics], columns)
    exposures = " and ".join(sorted({f"{outcome.quiet.exposure_s:g}{UNBROKEN}s" for _, outcome, _ in stars}))
    title = (
        f"Detection statistics without and with a flare, {exposures}, {first.realisations:,} realisations each; "
        f"thresholds at a false-alarm probability of {fap:g} per test; nominal throughput"
    )
    return Picture(rows, (COLUMN * columns, 2.6 * len(rows) + 0.4), title, _notes(stars), below=True)


def _drawn_flares(names: Sequence[str]) -> list[int]:
    """Return the indices of the flares that a picture shows: all, or evenly spread from the first to the last."""
    return [round(k) for k in np.linspace(0, len(names) - 1, min(len(names), MOST_FLARES))]


def _notes(stars: Sequence[Shown]) -> tuple[str, str]:
    """Return the notes on the numbers of drawn stars and flares; empty if all are drawn."""
    most = max(len(names) for *_, names in stars)
    return note_of(stars), part_note(min(MOST_FLARES, most), most, "flares")


def _distributions(title: str, outcome: Detection, flares: Sequence[str], statistic: str, fap: float) -> Panel:
    """Return the histograms of a statistic without and with each flare, and its thresholds."""
    kind = outcome.statistic(statistic)
    linear, chosen = isinstance(kind, LinearStatistic), _drawn_flares(flares)
    shapes: list[tuple[int | None, str, str]] = [(None, "drawn", "no flare")]
    shapes += [(k, colour, flares[k]) for k, colour in zip(chosen, cycle(COLOURS), strict=False)]
    series, ends = list[Series](), list[float]()
    for flare, colour, name in shapes:
        edges, counts = outcome.histogram(statistic, flare, bins=120)
        middle, height = (edges[1:] + edges[:-1]) / 2, counts / counts.max()
        ends += [edges[0], edges[-1]]
        series.append(Area("", colour, alpha=0.3, step=True, at=(middle, 0 * height, height)))
        series.append(Line(name, colour, step=True, at=(middle, height)))
    # Statistics that are scaled by the flare have a threshold per flare.
    own, cuts = chosen if kind.shaped and not linear else [0], list[float]()
    for k, colour in zip(own, cycle(COLOURS if len(own) > 1 else ["text"]), strict=False):
        try:
            cut = outcome.threshold(fap, statistic, template=k).value
        except NoThresholdError:
            continue
        cuts.append(cut)
        series.append(Rule("threshold", colour, listed=len(own) == 1, at=cut))
    above = f"{title}: a threshold per flare" if len(own) > 1 else title
    if len(own) == len(cuts) == 1:
        above = f"{title}: threshold {written(float(f'{cuts[0]:.3g}'))}"
    low, high = min(ends + cuts), max(ends + cuts)
    x, y = Axis(statistic_label(statistic)), Axis("realisations / peak", limits=(0, 1.05))
    if linear:
        return Panel(x, y, series, above, finish=partial(_asinh, ends=(low, high)))
    margin = (high / low) ** MARGIN
    return Panel(replace(x, log=True, limits=(low / margin, high * margin)), y, series, above)


def _asinh(axis: Any, ends: tuple[float, float]) -> None:
    """Scale the axis of a weighted sum, whose means differ by decades, and show the values between two ends."""
    axis.set_xscale("asinh", linear_width=2)
    low, high = np.arcsinh(np.array(ends) / 2)
    axis.set_xlim(*2 * np.sinh([low - MARGIN * (high - low), high + MARGIN * (high - low)]))
    shown = [*range(-10, 8, 2)] if high - low < WIDE else [-10, -4, 0, 4]
    decades = [10.0**power for power in range(1, 10)]
    major = [*shown, *(digit * decade for decade in decades for digit in ((1, 3) if decade < 100 else (1,)))]
    minor = [*range(-10, 10), *(digit * decade for decade in decades for digit in range(1, 10))]
    low, high = axis.get_xlim()
    axis.set_xticks([tick for tick in major if low <= tick <= high])
    axis.set_xticks([tick for tick in minor if low <= tick <= high], minor=True)
    axis.xaxis.set_major_formatter(lambda value, _: written(value))
    axis.tick_params(axis="x", which="minor", labelbottom=False)


def roc_columns(curve: Roc) -> tuple[Any, ...]:
    """Return false-alarm and detection probabilities with the ends of their intervals, where there are alarms."""
    points = curve.points()
    return tuple(
        points[name][points["fap"] > 0] for name in ("fap", "probability", "probability_low", "probability_high")
    )


@picture_of("Roc", "roc")
def roc(curves: Roc | Sequence[tuple[str, Roc]], *, name: str = "") -> Panel:
    """Plot receiver operating characteristics with their areas: one with its name, or several with theirs."""
    from mauvecl.detection.detection import Roc

    series: list[Series] = []
    named = [(name, curves)] if isinstance(curves, Roc) else curves
    for colour, (title, curve) in zip(cycle(COLOURS), named, strict=False):
        fap, probability, low, high = roc_columns(curve)
        text = f"{title}: area {curve.area.value:.4f}".removeprefix(": ")
        series += [Line(text, colour, at=(fap, probability)), Area("", colour, alpha=0.3, at=(fap, low, high))]
    x, y = Axis("false-alarm probability per test", log=True), Axis("detection probability", limits=(0, 1.02))
    return Panel(x, y, series)


@picture_of("DetectAnswer", "spectra", given=lambda answer: (_few(answer),))
def spectra(stars: Sequence[Shown]) -> Picture:
    """Plot mean spectra per second with pixel noise and, below, the flares in sigma of an element's noise."""

    def finish(axis: Any) -> None:
        axis.set_ylim(bottom=max(axis.get_ylim()[0], 0.03))

    above, below = list[Panel](), list[Panel]()
    for title, outcome, names in stars:
        quiet, whole, nm = outcome.quiet, _whole(outcome.quiet), outcome.quiet.wavelength_nm
        sigma = np.sqrt(quiet.per_element(quiet.variance_dn2))
        drawn = [(names[k], outcome.flares[k], COLOURS[i % len(COLOURS)]) for i, k in enumerate(_drawn_flares(names))]
        mean, noise = quiet.signal_dn / quiet.exposure_s, np.sqrt(quiet.variance_dn2) / quiet.exposure_s
        spectra = [Line(name, colour, at=(nm, x.signal_dn / x.exposure_s)) for name, x, colour in drawn[::-1]]
        band = Area("1 sigma of a pixel", alpha=0.35, at=(nm, mean - noise, mean + noise))
        series = [*spectra, band, Line("no flare", "text", dash="dashed", at=(nm, mean))]
        y = Axis("net signal (DN s$^{-1}$ pixel$^{-1}$)")
        above.append(Panel(WAVELENGTH, y, series, f"{title}, {quiet.exposure_s:g} s"))
        risen = [(x.per_element(x.signal_dn - quiet.signal_dn) / sigma, colour) for _, x, colour in drawn[::-1]]
        lines = [Line("", colour, at=(quiet.element_wavelength_nm[whole], rise[whole])) for rise, colour in risen]
        y = Axis("flare less quiet\n(sigma per 10.5 nm)", log=True)
        below.append(Panel(WAVELENGTH, y, [*lines, Rule(along="y", at=1.0)], finish=finish))
    title = "Mean spectra as Mauve would see them; nominal throughput, not a flight calibration"
    size = COLUMN * len(stars), 5.0
    return Picture([above, below], size, title, _notes(stars), below=True, share_x=True, heights=(3, 2))


def _whole(x: Expectation) -> NDArray[np.bool_]:
    """Return the complete elements; the last one of the spectrum may have fewer pixels."""
    pixels = np.bincount(x.element, minlength=x.element_wavelength_nm.size)
    return np.asarray(pixels >= np.median(pixels) - 1)


#: Components of a raw spectrum, as in the paper's figure.
COMPONENTS = {
    "raw": "raw spectrum",
    "source": "star",
    "sky": "zodiacal light",
    "photon_noise": "photon noise",
    "dark": "dark current",
    "bias": "bias",
    "read_noise": "read noise",
}


@picture_of(
    "SimulateAnswer", "observation", each=lambda answer: [(title, table) for title, _, table in answer.observations]
)
def observation(title: str, table: QTable) -> Picture:
    """Plot a raw spectrum and its components, as the paper's figure of components."""
    nm, rows = table["wavelength"].to_value("nm"), list[list[Panel]]()
    for letter, (name, text), colour in zip("abcdefg", COMPONENTS.items(), COLOURS, strict=True):
        line = Line("", colour, width=0.9, at=(nm, table[name].value))
        rows.append([Panel(WAVELENGTH, Axis("DN"), [line], f"({letter}) {text}")])
    title = f"{title}: one observation of {table.meta['exposure_s']:g} s; nominal throughput"
    return Picture(rows, (7.2, 9.5), title, share_x=True)


@picture_of(
    "SnrAnswer",
    "snr",
    given=lambda answer: (First([(star.title, star.result) for star in answer.stars], MOST_STARS, "stars"),),
)
@picture_of("SnrResult", "snr", given=lambda result: ([(result.expectation.name, result)],))
def signal_to_noise(stars: Sequence[tuple[str, SnrResult]]) -> Picture:
    """Plot the closed-form S/N per pixel and resolution element, and the spread of realisations."""
    rows = list[list[Panel]]()
    for title, result in stars:
        x, whole = result.expectation, _whole(result.expectation)
        title = title if f"{x.exposure_s:g} s" in title else f"{title}, {x.exposure_s:g} s"
        nm, snr = x.element_wavelength_nm[whole], x.snr_per_element()[whole]
        rows.append([_snr_panel(title, "per pixel", x.wavelength_nm, x.snr(), result.pixel),
                     _snr_panel(title, "per 10.5 nm element", nm, snr, result.element[whole])])  # fmt: skip
    title = "S/N of one exposure; nominal throughput, not a flight calibration"
    return Picture(rows, (7.6, 2.6 * len(rows) + 0.4), title, (note_of(stars),), below=True, share_x=True)


def _snr_panel(title: str, what: str, nm: Any, expected: Any, table: QTable) -> Panel:
    """Return the S/N in closed form, over the ranges of realisations."""
    series: list[Series] = [
        Area("95 % of realisations", "star", alpha=0.25, at=(nm, table["q2.5"], table["q97.5"])),
        Area("68 % of realisations", "star", alpha=0.45, at=(nm, table["q16"], table["q84"])),
        Line("closed form", "text", width=1.2, at=(nm, expected)),
    ]
    return Panel(WAVELENGTH, Axis(f"S/N {what}"), series, title)


@picture_of("UnknownAnswer", "unknowns")
def unknowns(answer: UnknownAnswer) -> Picture:
    """Plot closed-form power per star (dashed plain, solid marginalised), and the smallest amplitudes."""
    from scipy.special import ndtri

    from mauvecl.answers.detect import power

    stars, fap = list(dict.fromkeys(row["star"] for row in answer.rows)), answer.study.run.fap
    needed, above, below = ndtri(answer.study.limit.power) - ndtri(fap), list[Panel](), list[Panel]()
    for star in stars:
        # Those of its first flare.
        own = [row for row in answer.rows if row["star"] == star]
        known, amplitude = own[0]["known"], own[0]["amplitude"]
        least = amplitude * needed / known if known > 0 else float("inf")
        relative = np.geomspace(0.03, 300.0, 200) * least
        at = relative, power(known * relative / amplitude, fap)
        series: list[Series] = [Line("everything known", "text", width=4, at=at)]
        smallest = [Dots("", "text", size=12, at=([0], [least]))]
        first = [row for row in own if row["amplitude"] == amplitude]
        for k, (colour, row) in enumerate(zip(cycle(COLOURS), first, strict=False), 1):
            marginal, plain = (power(row[name] * relative / amplitude, fap) for name in ("marginal", "plain"))
            series.append(Line(row["unknown"].replace("+-", "±"), colour, at=(relative, marginal)))
            series.append(Line("", colour, dash="dashed", at=(relative, plain)))
            smallest.append(Dots("", colour, size=12, at=([k], [row["smallest"]])))
        y = Axis("detection probability", limits=(-0.02, 1.02))
        above.append(Panel(Axis(QUANTITIES["amplitude"].label, log=True), y, series, star))
        below.append(Panel(Axis(ticks=((), ())), Axis("smallest flare amplitude", log=True), smallest))
    title = (
        f"Above: solid marginalised, dashed plain; below: detected with a probability of {answer.study.limit.power:g}, "
        f"marginalised over each unknown; false-alarm probability {fap:g} per test"
    )
    return Picture([above, below], (2.6 * len(stars) + 1.6, 5.6), title, below=True)
