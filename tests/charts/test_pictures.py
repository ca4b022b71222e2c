"""Pictures through public functions: parts are told, texts are apart, files equal figures, backends are not loaded."""

import io
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from scenes import paper

pytest.importorskip("matplotlib")

import matplotlib as mpl
import numpy as np
from marks import long_but
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

import mauvecl
from mauvecl import Engine, Study, detect, snr

#: Width of one column of a journal, inches.
COLUMN = 3.5
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
    "limit": (mauvecl.limit, (*FEW, BARE, TWO), True),
    "limit of exposure": (mauvecl.limit, (*FEW, ONE, TWO, ONLY, 'limit.of="exposure"'), True),
    "map": (mauvecl.map, (*FEW, BARE, *GRID), False),
    "map, one statistic": (mauvecl.map, (*FEW, BARE, *GRID, ONLY), False),
    "gaussian": (mauvecl.gaussian, (*FEW, BARE, SWEEP), False),
    "snr": (snr, FEW, False),
    "snr, swept": (snr, (*FEW, ONE, SWEEP), False),
    "exposure": (mauvecl.exposure, ("signal.snr=10", "signal.wavelength_nm=300"), True),
    "visible": (mauvecl.visible, ('orbit.targets=["eps Eri", "AU Mic"]', "orbit.days=31", "orbit.step_s=600"), False),
    "visible, many": (mauvecl.visible, (f"orbit.targets={[f'{10 * k} 0' for k in range(8)]}", "orbit.days=5"), False),
    "simulate": (mauvecl.simulate, (), False),
}


def drawn(answer: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield name, figure and renderer of each picture."""
    with mpl.rc_context():
        for name, draw in answer.pictures.items():
            figure = draw()
            canvas = FigureCanvasAgg(figure)
            canvas.draw()
            yield name, figure, canvas.get_renderer()  # type: ignore[no-untyped-call]


def shown_ticks(axis: Any) -> list[Text]:
    low, high = sorted(axis.get_view_interval())
    margin = 1e-9 * (high - low)
    ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
    inside = [tick for tick in ticks if low - margin <= tick.get_loc() <= high + margin]
    return [tick.label1 for tick in inside if tick.label1.get_visible() and tick.label1.get_text()]


#: What `make test` looks at.
SHORT = ("detect, one statistic", "limit of exposure", "map", "snr", "exposure", "visible, many")


@pytest.mark.long
@pytest.mark.parametrize("case", long_but(CASES, *SHORT))
def test_texts_are_inside_figure_and_do_not_overlap(case: str, engine: Engine) -> None:
    ask, settings, column = CASES[case]
    answer = ask(paper(*settings), engine)
    assert answer.pictures
    exposures = {f"{x.exposure_s:g}" for x in answer.inputs}
    for place, (name, figure, renderer) in enumerate(drawn(answer)):
        width, height = figure.bbox.width, figure.bbox.height
        sides = [side for axis in figure.axes for side in (axis.xaxis, axis.yaxis)]
        ticks = {side: shown_ticks(side) for side in sides}
        beyond = {label for side in sides for label in side.get_ticklabels(which="both") if label not in ticks[side]}
        texts = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()]
        for text in texts:
            x0, y0, x1, y1 = text.get_window_extent(renderer).extents
            assert text in beyond or min(x0, y0, width - x1, height - y1) > -1, (name, text.get_text())
        for legend in figure.legends:
            box = legend.get_window_extent(renderer)
            assert min(box.x0, width - box.x1) > -1, name
            assert not any(box.overlaps(axis.bbox) for axis in figure.axes), name
        for side in sides:
            low = 0 if side.axis_name == "x" else 1
            boxes = sorted((label.get_window_extent(renderer).extents for label in ticks[side]), key=lambda b: b[low])
            for before, after in pairwise(boxes):
                assert before[low + 2] <= after[low] + 0.5, (name, "ticks overlap")
        if place == 0 and column:
            assert figure.get_figwidth() <= COLUMN, name
        words = " ".join(text.get_text() for text in texts).replace("\N{NO-BREAK SPACE}", " ")
        if exposures and not case.startswith("limit of") and name != "exposure":
            assert any(f"{value} s" in words or "exposure (s)" in words for value in exposures), (name, words)


def test_detected_flare_is_visible(engine: Engine) -> None:
    """Check that the 5 % flare, hidden in pixel noise, reaches four sigma of an element in the lower panel."""
    answer = detect(paper(*FEW, ONE, "flare.amplitudes=[0.05]", ONLY), engine)
    figure = answer.pictures["spectra"]()
    (line,) = [line for line in figure.axes[1].lines if len(line.get_ydata()) > 2]
    assert 3.0 < max(line.get_ydata()) < 6.0
    # The last element of the spectrum is a part of one, and is left out.
    assert line.get_xdata()[-1] < answer.stars[0].detection.quiet.element_wavelength_nm[-1]


def stars(number: int) -> str:
    each = (f'{{library="G2V", magnitude={7 + k / 10}}}' for k in range(number))
    return f"star=[{', '.join(each)}]"


INJECTED = ("stare.duration_s=1500", "injections.count=10", "injections.sizes=3", "injections.widths=8",
            "injections.fitted=2", "injections.positions=2", "search.nulls=0")  # fmt: skip
#: Questions with more stars, flares and half-widths than a picture shows, the note, and the pictures that need none.
PARTS: dict[str, tuple[Any, tuple[str, ...], str, set[str]]] = {
    "detect": (detect, (*FEW, stars(7), "flare.amplitudes=[0.5]"), "6 of 7 stars shown", set()),
    "detect, all": (detect, (*FEW, stars(6), "flare.amplitudes=[0.5]"), " shown", {"detection", "roc", "spectra"}),
    "snr": (snr, (stars(7), "flare.amplitudes=[0.5]"), "6 of 7 stars shown", {"noise-budget"}),
    "measure": (
        mauvecl.measure, (ONE, "flare.amplitudes=[0.5, 0.6, 0.7, 0.8, 0.9]", "measure.fits=20"), "4 of 5 flares shown",
        set(),
    ),
    "inject": (
        lambda study, _: mauvecl.inject(study, mauvecl.Stares()), (ONE, *INJECTED), "6 of 8 half-widths shown",
        {"completeness", "energies"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", long_but(PARTS, "detect", "detect, all"))
def test_pictures_of_a_part_say_so(case: str, engine: Engine) -> None:
    ask, settings, note, whole = PARTS[case]
    for name, draw in ask(paper(*settings), engine).pictures.items():
        title = draw()._suptitle
        written = title.get_text().replace("\n", " ") if title else ""
        assert (note in written) == (name not in whole), (name, written)


def test_saved_picture_equals_savefig(engine: Engine, tmp_path: Path) -> None:
    """Compare all bytes with those of savefig, which draws the picture twice."""
    for name, draw in detect(paper(*FEW), engine).pictures.items():
        twice = io.BytesIO()
        draw().savefig(twice, format="png", dpi=160)
        assert draw(tmp_path / f"{name}.png").read_bytes() == twice.getvalue()


@pytest.mark.long
def test_report_has_every_table_remark_and_picture() -> None:
    time, rng = np.arange(300) * 60.0, np.random.default_rng(1)
    light = rng.normal(100.0, 1.0, 300) + np.where(time > 9000, 30 * np.exp((9000 - time) / 600), 0.0)
    answer = mauvecl.analyse(Study().paper(), frames=mauvecl.Frames.of(time, light, np.ones(300), name="<A & B>"))
    (page,) = (make().decode() for make in answer.documents.values())
    assert "<A & B>" not in page
    assert "&lt;A &amp; B&gt;: 300 frames" in page
    assert all(view.title.split(";")[0] in page.replace("&lt;A &amp; B&gt;", "<A & B>") for view in answer.views)
    assert page.count("<img") == len(answer.pictures)
    paper = replace(answer, study=Study(data={"report": "pdf"}))  # type: ignore[arg-type]
    (name,) = paper.documents
    assert name == "analyse.pdf"
    content = paper.documents[name]()
    assert content.startswith(b"%PDF")
    assert content == paper.documents[name]()


def test_a_curve_is_listed_by_its_name(engine: Engine) -> None:
    curve = detect(paper(*FEW, ONE, ONLY), engine).stars[0].detection.roc("matched")
    for name, start in (("", "area "), ("own words", "own words: area ")):
        (entry,) = curve.plot(name=name).axes[0].get_legend().get_texts()
        assert entry.get_text().startswith(start)


COMMAND = ("-m", "mauvecl", "exposure", "--star", "G2V", "-m", "7.4", "--snr", "10", "--at", "300", "--output", "out")
LOADED = """
import sys
from mauvecl import Source
star = Source.from_library("G2V")
assert list(star.pictures) == ["source"] and "matplotlib" not in sys.modules
assert "mauvecl.answers.answer" not in sys.modules
figure = star.plot()
assert figure._repr_png_()[:8] == b"\\x89PNG\\r\\n\\x1a\\n"
assert "matplotlib" in sys.modules and "matplotlib.pyplot" not in sys.modules
"""


@pytest.mark.long
@pytest.mark.parametrize("backend", ["module://no.such.backend", "TkAgg"])
def test_pictures_load_matplotlib_when_drawn_and_no_backend(backend: str, tmp_path: Path) -> None:
    """Notebooks name backends that are not installed, and others need a display."""
    for words in (COMMAND, ("-c", LOADED)):
        environment = os.environ | {"MPLBACKEND": backend}
        done = subprocess.run([sys.executable, *words], cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "exposure.png").stat().st_size > 1000
