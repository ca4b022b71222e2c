"""Pictures through public functions: parts are told, texts are apart, files equal figures, backends are not loaded."""

import io
import warnings
from collections.abc import Iterator
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import astropy.units as u
import pytest
from astropy.table import Table
from commands import started
from processes import python
from scenes import paper

pytest.importorskip("matplotlib")

import matplotlib as mpl
import numpy as np
from marks import long_but
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from tables import toml

import mauvecl
from mauvecl import Engine, Study, detect

#: Questions by the names of the tests that ask them.
QUESTIONS = toml("pictures.toml")
FEW, ONE, ONLY = (QUESTIONS["settings"][name] for name in ("few", "one", "only"))


def answer_to(question: dict[str, Any], engine: Engine) -> Any:
    settings = [one for name in question["settings"] for one in QUESTIONS["settings"].get(name, [name])]
    drawing = mauvecl.Stares() if question["verb"] in ("inject", "stare") else engine
    return getattr(mauvecl, question["verb"])(paper(*settings), drawing)


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


@pytest.mark.long
@pytest.mark.parametrize("case", QUESTIONS["texts"])
def test_texts_are_inside_figure_and_do_not_overlap(case: str, engine: Engine) -> None:
    answer = answer_to(QUESTIONS["texts"][case], engine)
    assert answer.pictures
    # What is undefined has an empty cell.
    assert not [view.title for view in answer.views if view.table is not None and "nan" in str(view.texts()[1])]
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
        of_panels = {axis.get_title("left") for axis in figure.axes}
        titles = [text.get_window_extent(renderer) for text in texts if text.get_text() in of_panels]
        assert not any(one.overlaps(other) for one, other in combinations(titles, 2)), (name, "titles overlap")
        if place == 0 and QUESTIONS["texts"][case].get("column"):
            assert figure.get_figwidth() <= 3.5, name  # inches, one column of a journal
        words = " ".join(text.get_text() for text in texts).replace("\N{NO-BREAK SPACE}", " ")
        if exposures and not case.startswith(("limit of", "measure", "stare")) and name != "exposure":
            assert any(f"{value} s" in words or "exposure (s)" in words for value in exposures), (name, words)


@pytest.mark.long
def test_detected_flare_is_visible_a_curve_is_listed_by_its_name_and_files_equal_savefig(
    engine: Engine, tmp_path: Path
) -> None:
    """Compare all bytes of the files with those of savefig, which draws the picture twice."""
    answer = detect(paper(*FEW, *ONE, "flare.amplitudes=[0.05]", *ONLY), engine)
    for name, draw in detect(paper(*FEW), engine).pictures.items():
        twice = io.BytesIO()
        draw().savefig(twice, format="png", dpi=160)
        assert draw(tmp_path / f"{name}.png").read_bytes() == twice.getvalue()
    detection = answer.stars[0].detection
    # The 5 % flare, hidden in pixel noise, reaches four sigma of an element in the lower panel.
    figure = answer.pictures["spectra"]()
    (line,) = [line for line in figure.axes[1].lines if len(line.get_ydata()) > 2]
    assert 3.0 < max(line.get_ydata()) < 6.0
    # The last element of the spectrum is a part of one, and is left out.
    assert line.get_xdata()[-1] < detection.quiet.element_wavelength_nm[-1]
    for name, start in (("", "area "), ("own words", "own words: area ")):
        (entry,) = detection.roc("matched").plot(name=name).axes[0].get_legend().get_texts()
        assert entry.get_text().startswith(start)


@pytest.mark.parametrize("case", long_but(QUESTIONS["parts"], "detect", "detect, all"))
def test_pictures_of_a_part_say_so(case: str, engine: Engine) -> None:
    question = QUESTIONS["parts"][case]
    for name, draw in answer_to(question, engine).pictures.items():
        title = draw()._suptitle
        written = title.get_text().replace("\n", " ") if title else ""
        assert (question["note"] in written) == (name not in question["whole"]), (name, written)


def labelled(figure: Any, label: str) -> list[np.ndarray]:
    """Return the values of the lines with a label along y."""
    return [np.asarray(line.get_ydata()) for axis in figure.axes for line in axis.lines if line.get_label() == label]


def edges(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    corners = np.asarray(mesh.get_coordinates())
    return corners[0, :, 0], corners[:, 0, 1]


def test_stare_without_found_flares_has_a_layout_and_gaps() -> None:
    study = paper(*ONE, "flare.amplitudes=[0.5]", "stare.duration_s=320", "stare.gaps=[[0, 20], [120, 170]]",
                  "stare.half_width_s=20", "stare.search=false")  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure, spectra = (figure for _, figure, _ in drawn(mauvecl.stare(study, mauvecl.Stares())))
    seconds = edges(spectra.axes[0].collections[0])[0]
    assert (seconds[0], seconds[-1]) == pytest.approx((20, 320))
    bands = labelled(figure, "star and flares alone")
    assert len(bands) == 5
    # Twenty frames before the gap and thirty after it.
    assert all(np.flatnonzero(np.isnan(band)).tolist() == [20, 21] and band.size == 52 for band in bands)
    # Light is relative to that before the flare, not to a median that the flare raises.
    assert [float(np.nanmin(band)) for band in bands] == pytest.approx([1.0] * 5, rel=1e-12)


def test_maps_and_sweeps_are_drawn_as_their_tables_have_them(engine: Engine) -> None:
    """Values are in any order, along few and along many decades, and magnitudes in another band than V."""
    axes = ["map.x={quantity='exposure', values=[50, 5, 20]}",
            "map.y={quantity='amplitude', start=1e-4, stop=1, steps=3, log=true}"]  # fmt: skip
    found = mauvecl.map(paper(*FEW, *ONE, *ONLY, *axes), engine)
    mesh = found.plot().axes[0].collections[0]
    x, y = edges(mesh)
    assert y == pytest.approx(np.geomspace(1e-5, 10, 4))
    for row in found.table:
        cell = np.searchsorted(y, row["amplitude"]) - 1, np.searchsorted(x, row["exposure"].value) - 1
        assert mesh.get_array().reshape(3, 3)[cell] == row["probability"]
    sweep = "sweep.axes=[{quantity='magnitude', values=[9, 7]}, {quantity='exposure', values=[50, 5]}]"
    swept = mauvecl.snr(paper(*FEW, "star=[{library='G2V', band='B'}]", "signal.wavelength_nm=400", sweep), engine)
    (axis,) = swept.pictures["snr-sweep"]().axes
    assert axis.get_xlabel() == "magnitude (B)"
    rows = swept.element[np.abs(swept.element["wavelength"].value - 400) < 5.3]
    for seconds in (50, 5):
        (line,) = (line for line in axis.lines if line.get_label() == f"G2V, exposure {seconds} s")
        wanted = np.sort(rows["expected"][rows["exposure"].value == seconds])[::-1]
        assert line.get_xydata() == pytest.approx(np.column_stack([[7, 9], wanted]))


def words(figure: Any) -> str:
    texts = [text.get_text() for text in figure.findobj(Text)]
    return " ".join(" | ".join(texts).split())


@pytest.mark.long
def test_pictures_are_of_the_cells_of_a_sweep_and_of_their_instrument(engine: Engine, tmp_path: Path) -> None:
    """Exposures and magnitudes of the study are not those of its cells, nor is a calibrated throughput nominal."""
    modes = {"wavelength": [200.0, 700.0] * u.nm, "mode_1": [0.05, 0.05]}
    Table(modes).write(tmp_path / "modes.ecsv")
    (tmp_path / "grey.toml").write_text("extends = 'mauvesim'\nname = 'grey'\nthroughput_errors = 'modes.ecsv'\n")
    grey = f"observation.instrument={tmp_path / 'grey.toml'}", "observation.changes.resolution_element_nm=20"
    exposures, magnitudes = "{quantity='exposure', values=[60, 5]}", "{quantity='magnitude', values=[8, 9]}"
    star = ("star=[{library='G2V'}]", *FEW, *ONLY, *grey)
    limits = mauvecl.limit(paper(*star, "flare.amplitudes=[0.24]", f"sweep.axes=[{exposures}]"), engine)
    text = words(limits.plot())
    assert "probability of 0.9, 5 s and 60 s, false-alarm" in text
    assert all(f"G2V, exposure {seconds} s, flare 24 %" in text for seconds in (5, 60))
    assert limits.headline.startswith("grey would see a flare of 24 % on G2V in 60 s with")
    changes = mauvecl.change(paper(*star, f"sweep.axes=[{exposures}, {magnitudes}]"))
    figure = changes.plot()
    assert "G2V V = 8, exposure 60 s: smallest change between two visits;" in words(figure)
    assert {
        float(line.get_xdata()[0]) for axis in figure.axes for line in axis.lines if line.get_label() == "this star"
    } == {8.0}
    sweep = "sweep.axes=[{quantity='flare_temperature', values=[8000, 12000]}]"
    injected = mauvecl.inject(paper(*star, *ONE, *QUESTIONS["settings"]["injected"], sweep), mauvecl.Stares())
    assert "Flares of swept temperature, " in words(injected.plot())
    spectra = words(mauvecl.snr(paper(*star, *ONE), engine).plot())
    for said in (text, spectra):
        assert "calibrated throughput" in said
        assert "nominal" not in said
    assert "S/N per resolution element" in spectra
    assert "10.5" not in spectra


@pytest.mark.long
def test_report_has_every_table_remark_and_picture_and_no_level_is_drawn_in_long_gaps() -> None:
    """Two days are missing, where the level has no line and its range no width, and single frames, where it has."""
    time, rng = np.arange(200) * 120.0, np.random.default_rng(1)
    time = np.delete(np.where(time < 12_000, time, time + 172_800.0), [50, 51])
    flare = np.where((time > 6000) & (time < 12_000), 30 * np.exp(10 - time / 600), 0)
    light = rng.normal(100.0, 1.0, time.size) + flare
    frames = mauvecl.Frames.of(time, light, np.ones(time.size), name="<A & B>")
    answer = mauvecl.analyse(Study().paper(), frames=frames)
    (page,) = (make().decode() for make in answer.documents.values())
    assert "<A & B>" not in page
    assert "&lt;A &amp; B&gt;: 198 frames" in page
    assert len(answer.events) == 1
    assert all(view.title.split(";")[0] in page.replace("&lt;A &amp; B&gt;", "<A & B>") for view in answer.views)
    assert page.count("<img") == len(answer.pictures)
    figure = answer.pictures["light-curve"]()
    (level,) = labelled(figure, "quiescent level")
    assert np.flatnonzero(np.isnan(level)).tolist() == [98, 99]
    (area,) = (part for part in figure.axes[0].collections if part.get_label() == "95 % of the level")
    path, hours = area.get_paths()[0].vertices, (time - time[0]) / 3600
    # Both ends of the range and, once more, the level between them.
    assert [np.unique(path[path[:, 0] == hour][:, 1]).size for hour in hours[96:100]] == [2, 3, 3, 2]


COMMAND = ("exposure", "--star", "G2V", "-m", "7.4", "--snr", "10", "--at", "300", "--output", "out")
LOADED = """
import sys
from mauvecl import Source
star = Source.from_library("G2V")
assert list(star.pictures) == ["source"] and "matplotlib" not in sys.modules
assert not [name for name in sys.modules if name.startswith("mauvecl.answers")]
figure = star.plot()
assert figure._repr_png_()[:8] == b"\\x89PNG\\r\\n\\x1a\\n"
assert "matplotlib" in sys.modules and "matplotlib.pyplot" not in sys.modules
"""


@pytest.mark.long
@pytest.mark.parametrize("backend", ["module://no.such.backend", "TkAgg"])
def test_pictures_load_matplotlib_when_drawn_and_no_backend(backend: str, tmp_path: Path) -> None:
    """Notebooks name backends that are not installed, and others need a display."""
    started(*COMMAND, folder=tmp_path, MPLBACKEND=backend)
    python(LOADED, MPLBACKEND=backend)
    assert (tmp_path / "out" / "exposure.png").stat().st_size > 1000
