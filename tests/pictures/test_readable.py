"""Every picture at its own size: what is written lies inside the frame, and labels lie apart."""

from __future__ import annotations

import io
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest
from marks import long_but
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

from mauvecl.answers.answer import Answer
from mauvecl.answers.campaigns.visible import visible
from mauvecl.answers.detection.detect import detect
from mauvecl.answers.detection.gaussian import gaussian_report
from mauvecl.answers.detection.maps import detection_map
from mauvecl.answers.limits.limits import limiting_magnitude
from mauvecl.answers.signal.exposures import exposure_for
from mauvecl.answers.signal.simulate import simulate
from mauvecl.answers.signal.snr import snr
from mauvecl.device.engine import Engine
from mauvecl.pictures.style import COLUMN, STYLE, canvas, headline, legend_below, save_or_return
from mauvecl.study.study import Study

FEW = ("run.realisations=2000", "run.fap=0.1")
ONE = 'star=[{library="G2V", magnitude=7.4}]'
BARE = 'star=[{library="G2V"}]'
TWO = "flare.amplitudes=[0.05, 0.24]"
ONLY = 'run.statistics=["matched"]'
GRID = (
    'map.x={quantity="magnitude", start=6, stop=10, steps=5}',
    'map.y={quantity="amplitude", start=0.01, stop=1, steps=5, log=true}',
)
SWEEP = 'sweep.axes=[{quantity="exposure", values=[5, 50, 600]}, {quantity="magnitude", values=[4, 8]}]'
#: Answers, and whether their first picture is one of a column's width.
CASES: dict[str, tuple[Any, tuple[str, ...], bool]] = {
    "detect, the paper's question": (detect, FEW, False),
    "detect, one statistic": (detect, (*FEW, ONE, TWO, 'run.statistics=["chi2"]'), True),
    "detect, every statistic": (detect, (*FEW, ONE, TWO, 'run.statistics=["all"]'), False),
    "limit": (limiting_magnitude, (*FEW, BARE, TWO), True),
    "limit of exposure": (limiting_magnitude, (*FEW, ONE, TWO, ONLY, 'limit.of="exposure"'), True),
    "map": (detection_map, (*FEW, BARE, *GRID), False),
    "map, one statistic": (detection_map, (*FEW, BARE, *GRID, ONLY), False),
    "gaussian": (gaussian_report, (*FEW, BARE, SWEEP), False),
    "snr": (snr, FEW, False),
    "snr, swept": (snr, (*FEW, ONE, SWEEP), False),
    "exposure": (lambda study, _: exposure_for(study), ("signal.snr=10", "signal.wavelength_nm=300"), True),
    "visible": (
        lambda study, _: visible(study),
        ('orbit.targets=["eps Eri"]', "orbit.days=31", "orbit.step_s=600"),
        False,
    ),
    "simulate": (lambda study, _: simulate(study, realisation=0, flaring=False), (), False),
}


def drawn(answer: Answer) -> Iterator[tuple[str, Any, Any]]:
    """Yield name, figure and renderer of each picture."""
    with mpl.rc_context():
        for name, draw in answer.pictures.items():
            figure = draw()
            canvas = FigureCanvasAgg(figure)
            canvas.draw()
            yield name, figure, canvas.get_renderer()  # type: ignore[no-untyped-call]


def shown_ticks(axis: Any) -> list[Text]:
    """Return the tick labels that lie within the view."""
    low, high = sorted(axis.get_view_interval())
    margin = 1e-9 * (high - low)
    ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
    inside = [tick for tick in ticks if low - margin <= tick.get_loc() <= high + margin]
    return [tick.label1 for tick in inside if tick.label1.get_visible() and tick.label1.get_text()]


#: What `make test` looks at.
SHORT = ("detect, one statistic", "limit of exposure", "map", "snr", "exposure")


@pytest.mark.long
@pytest.mark.parametrize("case", long_but(CASES, *SHORT))
def test_texts_are_inside_figure_and_do_not_overlap(case: str, engine: Engine) -> None:
    ask, settings, column = CASES[case]
    answer = ask(Study().with_settings(list(settings)), engine)
    exposures = {f"{x.exposure_s:g}" for x in answer.inputs}
    for place, (name, figure, renderer) in enumerate(drawn(answer)):
        width, height = figure.bbox.width, figure.bbox.height
        beyond = [
            label
            for axis in figure.axes
            for one in (axis.xaxis, axis.yaxis)
            for label in one.get_ticklabels(which="both")
        ]
        ticks = [label for axis in figure.axes for one in (axis.xaxis, axis.yaxis) for label in shown_ticks(one)]
        texts = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()]
        for text in texts:
            if text in beyond and text not in ticks:
                continue
            x0, y0, x1, y1 = text.get_window_extent(renderer).extents
            assert min(x0, y0, width - x1, height - y1) > -1, (name, text.get_text())
        for legend in figure.legends:
            box = legend.get_window_extent(renderer)
            assert min(box.x0, width - box.x1) > -1, name
            for axis in figure.axes:
                assert not box.overlaps(axis.bbox), name
        for axis in figure.axes:
            for one, (low, high) in ((axis.xaxis, (0, 2)), (axis.yaxis, (1, 3))):
                boxes = sorted(
                    (label.get_window_extent(renderer).extents for label in shown_ticks(one)), key=lambda b: b[low]
                )
                for before, after in pairwise(boxes):
                    assert before[high] <= after[low] + 0.5, (name, "ticks overlap")
        if place == 0 and column:
            assert figure.get_figwidth() <= COLUMN, name
        words = " ".join(text.get_text() for text in texts).replace("\N{NO-BREAK SPACE}", " ")
        if exposures and not case.startswith("limit of") and name != "exposure":
            assert any(f"{value} s" in words or "exposure (s)" in words for value in exposures), (name, words)


def test_detected_flare_is_visible(engine: Engine) -> None:
    """Check that the 5 % flare, hidden in pixel noise, reaches four sigma of an element in the lower panel."""
    answer = detect(Study().with_settings([*FEW, ONE, "flare.amplitudes=[0.05]", ONLY]), engine)
    figure = answer.pictures["spectra"]()
    (line,) = [line for line in figure.axes[1].lines if len(line.get_ydata()) > 2]
    assert 3.0 < max(line.get_ydata()) < 6.0
    # The last element of the spectrum is a part of one, and is left out.
    assert line.get_xdata()[-1] < answer.stars[0].detection.quiet.element_wavelength_nm[-1]


def test_saved_picture_equals_savefig(tmp_path: Path) -> None:
    """Compare all bytes with those of savefig, which draws the picture twice."""
    plt = canvas()

    def made() -> Any:
        figure, axes = plt.subplots(1, 2, figsize=(5, 2.5))
        axes[0].loglog([1, 20, 3000], [3, 0.1, 70], label="one")
        axes[1].plot([0, 1], [1e5, 2e5], label="other")
        axes[1].set(xlabel="tau", ylabel=r"$10^{-3}$ DN")
        legend_below(figure, *axes[0].get_legend_handles_labels())
        headline(figure, "A title that is so long that it takes two lines above both of these panels, as some do")
        return figure

    twice = io.BytesIO()
    with plt.rc_context(STYLE):
        made().savefig(twice, format="png")
        once = save_or_return(made(), tmp_path / "once.png")
    assert once.read_bytes() == twice.getvalue()
