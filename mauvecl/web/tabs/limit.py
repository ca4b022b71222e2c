"""Limits: detection probability over magnitude, and over magnitude and amplitude."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from bokeh.models import FixedTicker, HoverTool, LinearColorMapper
from bokeh.models.annotations import ColorBar
from numpy.typing import NDArray
from scipy import special
from scipy.interpolate import PchipInterpolator

from mauvecl.charts.chart import Axis, Chart, ChartData, Contours, Custom, Dots, Line, Listed, Own, Rule
from mauvecl.web.closed_forms import LIMITS, Answers
from mauvecl.web.tabs.tab import Tab

if TYPE_CHECKING:
    from bokeh.models.sources import ColumnDataSource

    from mauvecl.detection.statistics import DetectionForms
    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.figures import Canvas

Float = NDArray[np.float64]

#: Ranges of the pictures: magnitudes, and amplitudes in per cent, fixed for all questions.
MAGNITUDES, PERCENTS = (2.0, 14.0), (0.1, 100.0)
#: Columns and rows of a map in closed form; smooth quantities are interpolated between them.
STEPS = 9, 5
#: Labelled contours, with the part of the line at which the label stands.
LABELLED = {0.1: 0.25, 0.5: 0.5, 0.9: 0.75}
#: Initial number of points of a curve, number of times that steps are halved, and change above which they are halved.
FIRST, HALVINGS, CHANGE = 9, 5, 0.25


#: Fields on which a map does not depend; an upload is identified by its content.
FREE = {"magnitude", "amplitude_percent", "realisations", "seed", "targets", "start", "days", "hours", "uploaded"}


def odds(closed: ClosedForms, magnitude: float, rises: Float) -> list[DetectionForms]:
    """Return `ClosedForms.at` a magnitude."""
    return closed.at(10 ** (-0.4 * (magnitude - closed.question.magnitude)), rises)


def _key(closed: ClosedForms) -> tuple[Any, ...]:
    """Return everything on which a map depends except its axes."""
    asked = closed.question.values.items()
    uploaded = closed.question.uploaded
    return (*(value for name, value in asked if name not in FREE), None if uploaded is None else uploaded.digest)


class _Kept:
    """Question identified by the values on which its map or curve depends."""

    def __init__(self, closed: ClosedForms, *more: float) -> None:
        self._closed: ClosedForms | None = closed
        self.key = (*_key(closed), *more)

    def take(self) -> ClosedForms:
        """Return the closed forms and forget them, since caches keep this key and they take tens of MB."""
        closed, self._closed = self._closed, None
        assert closed is not None
        return closed

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Kept) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


@lru_cache(maxsize=32)
def _curve(kept: _Kept) -> tuple[Float, Float]:
    """Return magnitudes and probabilities, with more points where these change."""

    closed = kept.take()

    def exact(magnitudes: Float) -> list[float]:
        each = (odds(closed, magnitude, np.ones(1)) for magnitude in magnitudes)
        return [forms[0].probability if forms else 0.0 for forms in each]

    x = np.linspace(*MAGNITUDES, FIRST)
    y = np.array(exact(x))
    for _ in range(HALVINGS):
        steep = np.nonzero(np.abs(np.diff(y)) > CHANGE)[0]
        new = (x[steep] + x[steep + 1]) / 2
        x, y = np.insert(x, steep + 1, new), np.insert(y, steep + 1, exact(new))
    fine = np.linspace(*MAGNITUDES, 241)
    # Probits are smooth; those of what rounds to 0 or 1 are not known.
    probits = special.ndtri(np.clip(y, 1e-15, 1 - 1e-15))
    return fine, np.asarray(special.ndtr(PchipInterpolator(x, probits)(fine)))


@lru_cache(maxsize=32)
def _map(kept: _Kept) -> tuple[Float, Float, Float]:
    """Return magnitudes, logarithms of amplitudes in per cent, and probabilities.

    The interpolated quantities are, in standard deviations without a flare: logarithms of the flare's part of the
    statistic and of its spread, the threshold and the skewness. A gamma distribution of these moments (Pearson's type
    III) is within 0.05 of the closed forms where they are steepest.
    """
    closed = kept.take()
    (columns, rows), (low, high) = STEPS, np.log10(PERCENTS)
    x, y = np.linspace(*MAGNITUDES, columns), np.linspace(low, high, rows)
    # A saturated star has no detectable flare.
    forms = np.zeros((4, rows, columns))
    forms[0], forms[2] = -30.0, 3.0
    for i, magnitude in enumerate(x):
        for j, outcome in enumerate(odds(closed, magnitude, 10**y / closed.question.amplitude_percent)):
            unit, seen = outcome.null.std, outcome.flaring
            part, cut = (
                max(seen.mean - outcome.null.mean, 1e-9 * unit) / unit,
                (outcome.threshold - outcome.null.mean) / unit,
            )
            forms[:, j, i] = np.log(part), np.log(seen.std / unit), cut, seen.third / seen.std**3
    fine = np.linspace(*MAGNITUDES, 97), np.linspace(low, high, 61)
    return *fine, _pearson(*PchipInterpolator(y, PchipInterpolator(x, forms, axis=2)(fine[0]), axis=1)(fine[1]))


def _pearson(part: Float, spread: Float, cut: Float, skewness: Float) -> Float:
    """Return the probability above a cut of a gamma distribution with these moments, or of a normal at low skewness."""
    off = (cut - np.exp(part)) / np.exp(spread)
    shape = 4 / np.maximum(skewness, 1e-4) ** 2
    gamma = special.gammaincc(shape, np.maximum(shape + np.sqrt(shape) * off, 0.0))
    return np.asarray(np.where(skewness > 1e-4, gamma, special.ndtr(-off)))


@Chart(
    "limit", "How faint a star: this flare is detected", Axis("magnitude", limits=MAGNITUDES),
    Axis("detection probability", limits=(-0.03, 1.05)),
    (
        Line("closed form", "flare", width=2, tips=("magnitude", "detected")),
        Rule("wanted: 90 %", "threshold", "power", along="y"),
        Dots("simulated", size=8),
        Own(),
    ),
    sets="magnitude=x", pins="closed form", alike=("band",),
).data()  # fmt: skip
def curve(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the detection probability against the star's magnitude."""
    q, power = closed.question, closed.study.limit.power
    series: dict[str, Any] = {"own": ([q.magnitude], [closed.chance]), "power": power}
    text = f"The closed form of {q.statistic} takes too long for a curve: simulate it."
    if not closed.slow:
        x, y = series["closed form"] = _curve(_Kept(closed, q.amplitude_percent))
        text = f"{100 * power:g} % of such flares are detected {_reach(x, y, power, q.band)}"
    if "limit" in answers:
        limits = [limit for limit in answers["limit"].limits if limit.statistic == q.statistic]
        words = LIMITS[closed.study.limit.of]
        for one in limits:
            # Points of another quantity than the axis's are reported in words only.
            if one.of == "magnitude":
                points = [(p.value, p.probability.value) for p in (*one.points, one.check)]
                series["simulated"] = np.array(points).T
            value, low, high = map(words.value, (one.value.value, one.value.low, one.value.high))
            limit = f"{words.before.format(band=q.band)} {value} [{low} to {high}]"
            text += f" Simulated: {100 * power:g} % are detected {limit}."
    return ChartData(text, series)


def _reach(x: Float, y: Float, power: float, band: str) -> str:
    """Return the words for the faintest magnitude at which a probability is reached."""
    seen = np.nonzero(y >= power)[0]
    if not seen.size:
        return f"at no magnitude from {MAGNITUDES[0]:g} to {MAGNITUDES[1]:g}."
    last = int(seen[-1])
    if last == x.size - 1:
        return f"at least to {band} = {MAGNITUDES[1]:g}."
    part = (y[last] - power) / (y[last] - y[last + 1])
    return f"to {band} = {x[last] + part * (x[last + 1] - x[last]):.2f}, in closed form."


def _draw_map(canvas: Canvas, source: ColumnDataSource) -> None:
    plot, mapper = canvas.plot, _mapper()
    image = plot.image("image", "x", "y", "dw", "dh", source=source, color_mapper=mapper)
    shown = [("detected", "@image{0.000}"), ("magnitude", "$x{0.00}"), ("amplitude", "@percent{0.[00]} %")]
    plot.add_tools(HoverTool(renderers=[image], tooltips=shown))
    plot.yaxis.ticker = FixedTicker(ticks=[-1, 0, 1, 2])
    plot.yaxis.major_label_overrides = {-1: "0.1 %", 0: "1 %", 1: "10 %", 2: "100 %"}
    plot.add_layout(ColorBar(color_mapper=mapper, width=10, title="detected", **canvas.bar_text), "right")


def _draw_cells(canvas: Canvas, source: ColumnDataSource) -> None:
    colour = {"field": "p", "transform": _mapper()}
    cells = canvas.plot.scatter("x", "y", source=source, size=10, marker="square", fill_color=colour,
                                line_color="#ffffff")  # fmt: skip
    cells.name = "simulated"


def _draw_labels(canvas: Canvas, source: ColumnDataSource) -> None:
    canvas.plot.text(
        "x", "y", "text", source=source, text_align="center", text_baseline="middle",
        text_font={"value": "system-ui"}, text_font_size="11px", text_color="#1b2733", level="annotation",
        background_fill_color="#ffffff", background_fill_alpha=0.85, padding=2,
    ).name = "labels"  # fmt: skip


def _mapper() -> LinearColorMapper:
    return LinearColorMapper(palette="Cividis256", low=0, high=1)


@Chart(
    "map", "How faint a star, how small a flare", Axis("magnitude", limits=MAGNITUDES),
    Axis("flare amplitude", limits=tuple(np.log10(PERCENTS))),
    (
        Custom("map", columns=("image", "percent", "x", "y", "dw", "dh"), draw=_draw_map),
        Contours("contours", "#ffffff", width=1.2, listed=False),
        Contours("half", "#ffffff", width=2.2, listed=False),
        Custom("simulated", columns=("x", "y", "p"), draw=_draw_cells),
        Custom("labels", columns=("x", "y", "text"), draw=_draw_labels),
        Listed("10, 50 (bold) and 90 % in closed form", "#b8c0c8"),
        Listed("simulated", "#8a8678", show="if any", form="dot", name="entry"),
        Own(),
    ),
    sets="magnitude=x,amplitude_percent=10^y", pins="half", alike=("band",),
).data()  # fmt: skip
def detection_map(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the detection probability over magnitude and amplitude."""
    q = closed.question
    series: dict[str, Any] = {"own": ([q.magnitude], [np.log10(q.amplitude_percent)])}
    text = f"The closed form of {q.statistic} takes too long for a map: simulate it."
    if not closed.slow:
        x, y, p = _map(_Kept(closed))
        series |= {
            "map": _image(x, y, p),
            "contours": _contours(x, y, p, 0.1, 0.9),
            "half": _contours(x, y, p, 0.5),
            "labels": _labels(x, y, p),
        }
        share = 100 * float(np.mean(p >= 0.5))
        text = (
            f"At least half of the flares are detected in {share:.0f} % of the map, which spans {q.band} = "
            f"{MAGNITUDES[0]:g} to {MAGNITUDES[1]:g} and amplitudes of {PERCENTS[0]:g} to {PERCENTS[1]:g} %."
        )
    if "map" in answers:
        got = answers["map"]
        at_x, at_y = np.meshgrid(np.array(got.x, float), np.log10(100 * np.array(got.y, float)))
        series["simulated"] = at_x.ravel(), at_y.ravel(), got.probability[0].ravel()
        text += f" {at_x.size} cells are simulated."
    return ChartData(text, series)


def _image(x: Float, y: Float, p: Float) -> tuple[Any, ...]:
    """Return the image of a map, and the edges of cells around its points."""
    half_x, half_y = 0.5 * (x[1] - x[0]), 0.5 * (y[1] - y[0])
    wide, high = x[-1] - x[0] + 2 * half_x, y[-1] - y[0] + 2 * half_y
    percent = np.repeat(10 ** y[:, None], x.size, axis=1)
    return [p], [percent], [x[0] - half_x], [y[0] - half_y], [wide], [high]


def _contours(x: Float, y: Float, p: Float, *levels: float) -> tuple[Any, Any]:
    from contourpy import contour_generator

    lines: list[Any] = [line for level in levels for line in contour_generator(x, y, p).lines(level)]
    return [line[:, 0].tolist() for line in lines], [line[:, 1].tolist() for line in lines]


def _labels(x: Float, y: Float, p: Float) -> tuple[Any, ...]:
    """Return the names of contours, each at another part of its line: the lines are close to each other."""
    from contourpy import contour_generator

    labels = []
    for level, part in LABELLED.items():
        lines: list[Any] = list(contour_generator(x, y, p).lines(level))
        if lines:
            longest = max(lines, key=len)
            at = longest[np.argsort(longest[:, 0])][int(part * (len(longest) - 1))]
            labels.append((float(at[0]), float(at[1]), f"{100 * level:g} %"))
    return tuple(zip(*labels, strict=True)) or ([], [], [])


class Limit(Tab):
    """Tab of limits."""

    verb, title = "limit", "Limit and map"
    about = "How faint a star and how small a flare one would still see."
    pictures = (curve, detection_map)
    simulations = {"limit": "Simulate the limit", "map": "Simulate the map"}  # noqa: RUF012
    files = {"limit": "limit", "map": "map"}  # noqa: RUF012
