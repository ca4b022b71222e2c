"""Tabs of calibrations, of changes between visits, and of periods."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from bokeh.models import FixedTicker, HoverTool, LinearColorMapper
from bokeh.models.annotations import ColorBar

from mauvecl.charts.calibrations import (
    BIN,
    THROUGHPUT,
    TRANSFER,
    along_magnitude,
    residual_series,
    throughput_series,
    transfer_series,
)
from mauvecl.charts.chart import WAVELENGTH, Axis, Chart, ChartData, Custom, Own, Rule, Targets
from mauvecl.host.stars.source import Source
from mauvecl.schema.errors import InputError
from mauvecl.web.sandboxed_reader import read_limited
from mauvecl.web.tabs.tab import Tab
from mauvecl.web.uploads import MOST_VALUES, VisitorFile, read_frames_of, reported_for

if TYPE_CHECKING:
    from bokeh.models.sources import ColumnDataSource

    from mauvecl.answers.calibrate import CalibrateAnswer
    from mauvecl.answers.change import ChangeAnswer
    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.figures import Canvas
    from mauvecl.web.question import Question
    from mauvecl.web.uploads import Observations

NO_FILES = "Choose an archive of observations; Calibrate then fits the instrument."


@THROUGHPUT.data("calibrate", NO_FILES)
def throughput(closed: ClosedForms, answer: CalibrateAnswer) -> ChartData:
    """Return the fitted throughput with its 95 % band, and the nominal one."""
    ratio = answer.throughput_table["ratio"]
    text = f"{answer.notice} It is {ratio.min():.3g} to {ratio.max():.3g} times the nominal one."
    return ChartData(text, throughput_series(answer))


@Chart(
    "residuals", "Observed less fitted spectra", WAVELENGTH, Axis(f"residual of {BIN} pixels (sigma)"),
    (
        Targets("residual", tips=("residual (sigma)",)),
        Rule("2 sigma", "threshold", "above", along="y", at=2.0),
        Rule("2 sigma", "threshold", "below", along="y", listed=False, at=-2.0),
    ),
).data("calibrate", NO_FILES)  # fmt: skip
def residuals(closed: ClosedForms, answer: CalibrateAnswer) -> ChartData:
    """Return the residuals of each star."""
    rows = residual_series(answer)
    words = "; ".join(f"{name} {np.sqrt(np.mean(row**2)):.2f}" for name, _, row in rows)
    text = f"Root mean square, 1 for noise alone: {words}; p = {answer.throughput.p_value:.2g}."
    return ChartData(text, {"residual": rows})


@TRANSFER.data("calibrate", NO_FILES)
def photon_transfer(closed: ClosedForms, answer: CalibrateAnswer) -> ChartData:
    """Return the measured over the fitted variance."""
    t = answer.transfer
    text = f"Gain {t.noise.gain:.4g} +- {t.gain_error:.1g} DN per electron, read noise {t.read_noise_dn:.3g} DN."
    if "gain" in t.assumed:
        text = "The frames do not determine the gain: it is nominal."
    return ChartData(text, transfer_series(answer)[0])


class Calibrate(Tab):
    """Instrument fitted to observations of standard stars."""

    verb = "calibrate"
    about = (
        "The instrument from frames of standard stars and of no light: throughput with its errors, dark current, gain "
        "and line width, next to the nominal values."
    )
    headline = False
    pictures = (throughput, residuals, photon_transfer)
    files = dict.fromkeys(("calibrate", "fits", "throughput", "dark"), "calibrate")
    documents = {"instrument.zip": "calibrate"}  # noqa: RUF012

    def given(self, question: Question) -> dict[str, Any]:
        """Read frames and spectra; raises InputError if a file cannot be read."""
        if "observations" not in question.uploads:
            return {}
        archive: Observations = question.uploads["observations"]
        files = {name: VisitorFile(name, content) for name, content in archive.files.items()}
        frames, stars = [], []
        for row in archive.rows:
            mapping = files[str(row.mapping)] if row.mapping else None
            frames.append(read_frames_of(files[str(row.frames)], mapping, "observations"))
            if sum(some.flux.size for some in frames) > MOST_VALUES:
                raise InputError(
                    "the archive holds more raw values than are read here",
                    f"{MOST_VALUES}, or the command line",
                    key="observations",
                )
            if row.spectrum is None:
                stars.append(row.source())
                continue
            with reported_for("observations", str(row.spectrum)):
                star = read_limited(files[str(row.spectrum)].content, Source)
            stars.append(star if row.magnitude is None else star.at_magnitude(row.magnitude, row.band))
        return {"frames": tuple(frames), "stars": tuple(stars)}

    def words(self, question: Question) -> str:
        """Return the name of the archive."""
        return question.uploads["observations"].name if "observations" in question.uploads else "no observations yet"


def _against_magnitude(name: str, title: str, label: str, units: Mapping[str, float]) -> Chart:
    """Return the chart of the smallest changes of some units, with the factor from each to that of the axis."""

    def along(closed: ClosedForms, answer: ChangeAnswer) -> ChartData:
        here = [row for row in answer.changes if row.change.unit in units]
        lines, words, own = [], list[str](), list[float]()
        for row in here:
            change, scale = row.change.name, units[row.change.unit]
            lines += along_magnitude(answer, [change], scale)
            hidden = np.isinf(row.smallest.one)
            words.append(f"{change} {'hidden' if hidden else f'{scale * row.smallest.one:.3g}'}")
            own += [] if hidden else [scale * row.smallest.one]
        text = (
            f"Smallest changes between {answer.study.change.visits} visits, in {label}: "
            f"{'; '.join(words) or 'none of this kind'}."
        )
        return ChartData(text, {name: lines, "own": ([closed.question.magnitude] * len(own), own)})

    axis, lines = Axis(f"smallest change ({label})", log=True), (Targets(name, tips=(label,)), Own("this star"))
    chart = Chart(name, title, Axis("magnitude"), axis, lines, sets="magnitude=x")
    return chart.data("change", "Change computes which differences between visits are detected.")(along)


class Change(Tab):
    """Changes between visits."""

    verb = "change"
    about = "How small a difference between visits is seen: of lines, bands, the Balmer jump and the colour."
    pictures = (
        _against_magnitude(
            "changes", "Smallest change of the star's own light", "% or 0.01 mag", {"": 100, "mag": 100}
        ),
        _against_magnitude("fluxes", "Smallest change of the flux of lines", "erg/s/cm²", {"erg / (s cm2)": 1.0}),
    )
    headline = False
    # Visits are evenly spaced, without an orbit, and the seed is that of periods.
    never = ("targets", "start", "days", "shortest_d", "longest_d", "seed")
    files = {"change": "change", "indices": "change"}  # noqa: RUF012


def _cells(canvas: Canvas, source: ColumnDataSource) -> None:
    plot, mapper = canvas.plot, LinearColorMapper(palette="Cividis256", low=0, high=1)
    cells = plot.quad("left", "right", "bottom", "top", source=source, line_color=None,
                      fill_color={"field": "share", "transform": mapper})  # fmt: skip
    cells.name = "recovered"
    shown = [("recovered", "@share{0 %}"), ("period", "@period{0.[00]} d"), ("amplitude", "@amplitude{0.00}")]
    plot.add_tools(HoverTool(renderers=[cells], tooltips=shown))
    plot.xaxis.ticker = FixedTicker(ticks=[0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200])
    plot.yaxis.ticker = FixedTicker(ticks=[0.5, 1, 2, 4])
    plot.add_layout(ColorBar(color_mapper=mapper, width=10, title="recovered", **canvas.bar_text), "right")


@Chart(
    "periods", "Share of periods that visits recover", Axis("period (d)", log=True),
    Axis("semi-amplitude (errors of a visit)", log=True),
    (Custom("cells", columns=("left", "right", "bottom", "top", "period", "amplitude", "share"), draw=_cells),),
).data("periods", "For each period and amplitude, how often it is found in visits that the orbit allows.")  # fmt: skip
def recovered_periods(closed: ClosedForms, answer: ChangeAnswer) -> ChartData:
    """Return the share of recovered periods over period and semi-amplitude."""
    row, *_ = answer.periods
    r = row.recovery
    x, y = (values.ravel() for values in np.meshgrid(r.periods_d, r.amplitudes))
    wide, high = (np.sqrt(points[1] / points[0]) for points in (r.periods_d, r.amplitudes))
    share = row.shares("value").ravel()
    errors = "; ".join(
        f"{row.change.name} {(row.error if row.change.unit else 100 * row.error):.3g} {row.change.unit or '%'}"
        for row in answer.periods
    )
    text = (
        f"{r.time_d.size} visits within {np.ptp(r.time_d):.0f} days recover {100 * np.mean(share):.0f} % of the "
        f"map's periods. The error of a visit is {errors}."
    )
    return ChartData(text, {"cells": (x / wide, x * wide, y / high, y * high, x, y, share)})


class Periods(Tab):
    """Recovered periods."""

    verb, name, title = "change", "periods", "Periods"
    about = (
        "Which periods of the star are found in visits to the first target, at times that the orbit allows, by a "
        "Lomb-Scargle periodogram with a false-alarm probability of 1 %."
    )
    pictures = (recovered_periods,)
    headline = False
    simulations = {"periods": "Map periods"}  # noqa: RUF012
    answer, view = "periods", 2
    # The power is that of differences.
    never = ("power", "fap")
    files = {"periods": "periods"}  # noqa: RUF012
