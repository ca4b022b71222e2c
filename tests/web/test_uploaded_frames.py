"""Frames that a visitor uploads: read apart from the server, analysed as the command line does, and exported."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from marks import long_but

pytest.importorskip("bokeh")

from mauvecl.answers.observations.analyse import analyse
from mauvecl.observations.reading import read_frames
from mauvecl.schema.errors import InputError
from mauvecl.study.cases import Case
from mauvecl.study.study import Study
from mauvecl.web.closed_forms import ClosedForms
from mauvecl.web.downloads import as_file, commands_and_programs, study_file
from mauvecl.web.fields import UPLOADED_FILE
from mauvecl.web.shelf import RESULTS
from mauvecl.web.state import State
from mauvecl.web.tabs import TABS
from mauvecl.web.upload import MOST_KEPT_BYTES, VisitorFile
from mauvecl.web.visitor import Visitor, shown

TAB = TABS["analyse"]
MAPPING = b'time = "minute"\ntime_unit = "min"\nflux = "rate"\nerror = "sd"\n'


def light_curve() -> bytes:
    """Return a CSV file of 200 frames with a flare of 20 standard deviations."""
    time = np.arange(200) / 6
    flux = 100 + np.random.default_rng(29).normal(size=200) + 20 * np.exp(-(((time - 15) / 0.8) ** 2))
    return ("minute,rate,sd\n" + "".join(f"{t},{y},1\n" for t, y in zip(time, flux, strict=True))).encode()


def asked(frames: bytes, mapping: bytes | None = MAPPING, name: str = "my curve.csv") -> State:
    kept = {"frames": VisitorFile.of(name, frames)}
    if mapping is not None:
        kept["mapping"] = VisitorFile.of("curve.toml", mapping)
    state = State(kept)
    state.enter({**dict.fromkeys(kept, UPLOADED_FILE), "false_alarms": "1", "per": "day"})
    return state


def closed(state: State, folder: Path) -> ClosedForms:
    question = state.question(TAB.reads)
    return ClosedForms.of(question, folder, headline=False, given=TAB.given(question))


@pytest.mark.long
def test_uploaded_frames_are_analysed_as_on_the_command_line(tmp_path: Path) -> None:
    state = asked(light_curve())
    page = closed(state, tmp_path)
    answer = analyse(page.study, **page.given)
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "curve.csv").write_bytes(light_curve())
    (tmp_path / "here" / "curve.toml").write_bytes(MAPPING)
    study = Study().with_settings(["search.per=day"])
    frames = read_frames(tmp_path / "here" / "curve.csv", tmp_path / "here" / "curve.toml")
    expected = analyse(study, frames=frames)
    assert [row.verdict for row in answer.rows] == ["detected"]
    for name in ("value", "ed_rec", "probability"):
        assert list(answer.events[name]) == list(expected.events[name]), name
    drawn = shown("analyse", page, {"analyse": answer})
    assert drawn["rows"][1][0] == answer.rows[0].date[:22]
    assert "1 detected" in drawn["pictures"]["frames"]["text"]
    assert "A light curve has no spectra." in drawn["pictures"]["dynamic"]["text"]
    for name in TAB.files:
        if name != "measured":
            file, content = as_file(TAB, name, "ecsv", page, {"analyse": answer})
            assert content.startswith(b"# %ECSV"), file
            assert str(tmp_path).encode() not in content, "nothing names a folder of the server"
    assert b"<!doctype html>" in as_file(TAB, "analyse.html", "", page, {"analyse": answer})[1]
    with pytest.raises(InputError):
        as_file(TAB, "measured", "ecsv", page, {"analyse": answer})


def test_exports_name_the_file(tmp_path: Path) -> None:
    question = asked(light_curve()).question(TAB.reads)
    (taken,) = commands_and_programs(TAB, question, tmp_path)
    assert taken["command"].startswith("mauvecl analyse my_curve.csv ")
    assert "--mapping curve.toml" in taken["command"]
    assert "--alarms-per day" in taken["command"]
    name, content = study_file(question.study(tmp_path), "study")
    assert name == "study.zip"
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert sorted(archive.namelist()) == ["curve.toml", "my_curve.csv", "study.toml"]
        assert archive.read("my_curve.csv") == light_curve()
        archive.extractall(tmp_path / "taken")
    study = Study.read(tmp_path / "taken" / "study.toml")
    assert study.data.file == tmp_path / "taken" / "my_curve.csv"
    assert [row.verdict for row in analyse(study).rows] == ["detected"]


@pytest.mark.parametrize(("bits", "left_out"), [("", 3), ("all", 3), ("none", 0), ("4", 1), ("1,2", 2)])
def test_quality_bits_are_chosen_as_on_the_command_line(bits: str, left_out: int, tmp_path: Path) -> None:
    """Three frames with the flags 1, 2 and 4."""
    first, *lines = light_curve().decode().splitlines()
    flags = {50: 1, 60: 2, 70: 4}
    frames = "\n".join([f"{first},flag", *(f"{line},{flags.get(k, 0)}" for k, line in enumerate(lines))]).encode()
    state = asked(frames, MAPPING + b'quality = "flag"\n')
    state.enter({"quality_bits": bits})
    page = closed(state, tmp_path)
    assert np.count_nonzero(page.given["frames"].faults) == left_out
    (taken,) = commands_and_programs(TAB, state.question(TAB.reads), tmp_path)
    assert ("--quality-bits" in taken["command"]) == bool(bits)
    assert page.study.data.quality_bits == (bits or None)


def test_frames_are_read_again_for_other_quality_bits() -> None:
    """The last frames are cached by everything that decides how they are read."""
    first, *lines = light_curve().decode().splitlines()
    frames = "\n".join([f"{first},flag", *(f"{line},{int(k == 50)}" for k, line in enumerate(lines))]).encode()
    state = asked(frames, MAPPING + b'quality = "flag"\n')
    visitor = Visitor.__new__(Visitor)
    visitor._digests, visitor._given = {}, None
    for bits, left_out in (("", 1), ("none", 0), ("all", 1)):
        state.enter({"quality_bits": bits})
        assert np.count_nonzero(visitor.given(state, TAB)["frames"].faults) == left_out
    RESULTS.leave(visitor)


def test_unknown_quality_bits_are_refused_with_their_name(tmp_path: Path) -> None:
    state = asked(light_curve(), MAPPING + b'quality = "rate"\n')
    state.enter({"quality_bits": "NoSuchBit"})
    with pytest.raises(InputError, match="NoSuchBit"):
        closed(state, tmp_path)


@pytest.mark.parametrize(
    ("frames", "mapping", "words"),
    long_but(
        [
            (b"minute,rate\n1,2\n", MAPPING, "sd"),
            (light_curve(), None, "mapping"),
            (light_curve(), b"time = [", "TOML"),
            (b"\x89PNG\r\n", None, "text in UTF-8"),
            (light_curve(), b'time = "minute"\nflux = "/etc/passwd"\n', "rate"),
            (light_curve(), MAPPING + b'wavelength_file = "/etc/passwd"\n', "passwd"),
        ],
        (light_curve(), None, "mapping"),
    ),
)
def test_unusable_files_end_in_a_sentence(frames: bytes, mapping: bytes | None, words: str, tmp_path: Path) -> None:
    state = asked(frames, mapping)
    with pytest.raises(InputError) as error:
        closed(state, tmp_path)
    assert error.value.key == "frames"
    assert words in str(error.value)
    assert str(tmp_path) not in str(error.value)
    assert "\n" not in str(error.value)


def test_file_is_needed_again_after_a_link() -> None:
    state = State()
    state.enter({"frames": UPLOADED_FILE})
    assert "its file again" in state.faults_of(TAB.reads)["frames"]


def test_names_of_files_are_plain(tmp_path: Path) -> None:
    for name in ("../../etc/passwd", "C:\\Users\\me\\passwd", "", "..", "a\nb;$(x) ü.csv", "-rf", "x" * 300):
        kept = VisitorFile.of(name, b"1")
        path = kept.written(tmp_path)
        assert path.parent.parent == tmp_path
        assert path.read_bytes() == b"1"
        assert set(kept.name) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789._+-")
        assert kept.name
        assert kept.name[0] not in "-."
        assert len(kept.name) <= 80
    with pytest.raises(InputError):
        VisitorFile.of("large", bytes(MOST_KEPT_BYTES + 1))


def test_neighbours_of_the_page_are_those_of_the_command_line(tmp_path: Path) -> None:
    """A Gaia table whose first row is the star itself dilutes the page's chance as it does that of `detect`."""
    table = 'designation,ra,dec,phot_g_mean_mag,bp_rp\n"Gaia DR3 1",150.0,60.0,9,2.1\n"Gaia DR3 2",150.0,60.003,8,0.8\n'
    entered = {"star": "M3V", "magnitude": "9", "amplitude_percent": "2"}
    chances: dict[str, Any] = {}
    for name, more in {
        "alone": {}, "blended": {"neighbours": table, "neighbours_of": "Gaia DR3 1"},
        "none of it": {"neighbours": table, "neighbours_of": "Gaia DR3 1", "neighbour_share": "0"},
    }.items():  # fmt: skip
        state = State()
        state.enter(entered | more)
        chances[name] = ClosedForms.of(state.question(), tmp_path)
    assert chances["alone"].chance == chances["none of it"].chance
    assert chances["blended"].chance < chances["alone"].chance - 0.004
    state.enter({"neighbour_share": "1"})
    (taken, *_) = commands_and_programs(TABS["detection"], state.question(TABS["detection"].reads), tmp_path)
    assert "--neighbours neighbours.csv --neighbours-of 'Gaia DR3 1'" in taken["command"]
    _, content = study_file(state.question().study(tmp_path), "study")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(tmp_path / "study")
    study = Study.read(tmp_path / "study" / "study.toml")
    near = study.star[0].near()
    assert near is not None
    assert [round(star.separation_arcsec, 3) for star in near.stars] == [10.8]
    np.testing.assert_array_equal(Case(study).quiet.variance_dn2, chances["blended"].quiet.variance_dn2)


@pytest.mark.parametrize(
    ("entered", "field"),
    [
        ({"neighbours": "name,separation,magnitude,file\nB,8,9,/etc/passwd\n"}, "neighbours"),
        ({"neighbours": "# %ECSV 1.0\n# ---\nname separation\nB 8\n"}, "neighbours"),
        ({"neighbours": "name,separation,magnitude\nB,8\n"}, "neighbours"),
        ({"neighbour_share": "1.2"}, "neighbour_share"),
        ({"pointing_rate": "-1"}, "pointing_rate"),
        ({"pointing_rate": "1", "pointing_depth": "120"}, "pointing_depth"),
    ],
)
def test_bad_neighbours_and_drifts_are_refused_at_their_field(entered: dict[str, str], field: str) -> None:
    state = State()
    state.enter(entered)
    assert set(state.faults) == {field}


def test_pointing_losses_are_those_of_the_study(tmp_path: Path) -> None:
    tab = TABS["completeness"]
    state = State()
    state.enter({"pointing_rate": "2", "pointing_duration": "200", "pointing_depth": "10"})
    study = state.question(tab.reads).study(tmp_path)
    found = study.stare.pointing
    assert found is not None
    assert (found.rate_per_h, found.duration_s, found.depth) == (2.0, 200.0, 0.1)
    (taken,) = commands_and_programs(tab, state.question(tab.reads), tmp_path)
    assert "stare.pointing" in taken["command"]
    assert State().question(tab.reads).study(tmp_path).stare.pointing is None
