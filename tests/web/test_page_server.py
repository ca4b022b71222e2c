"""The page without a browser: its state, who is let in, and what its server makes of nonsense."""

from __future__ import annotations

import asyncio
import bz2
import contextlib
import gc
import gzip
import io
import json
import logging
import lzma
import math
import re
import resource
import socket
import tempfile
import threading
import time
import types
import weakref
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from commands import run
from marks import long_but
from refusals import refused

pytest.importorskip("bokeh")

from bokeh.models.annotations import ColorBar
from bokeh.models.sources import ColumnDataSource
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect
from typer.testing import CliRunner

from mauvecl.answers.campaigns.plan import plan
from mauvecl.answers.verbs import VERBS
from mauvecl.cli.app import app
from mauvecl.host.stars import catalogue
from mauvecl.noise.scene import prepare
from mauvecl.results.requests.hypotheses import Hypotheses
from mauvecl.runs.pool import LocalWorkers, Pool
from mauvecl.schema.errors import InputError
from mauvecl.statistics.registry import STATISTICS
from mauvecl.study.study import Study
from mauvecl.web import access, closed_forms, server, static_pages, tabs, visitor, work
from mauvecl.web.closed_forms import ClosedForms, percent
from mauvecl.web.fields import FIELDS, PRESETS, UPLOADED_UNKNOWN, Number, star_words
from mauvecl.web.figures import INKS
from mauvecl.web.plain_log import Plain
from mauvecl.web.sentences import remedies, sentence
from mauvecl.web.simulations import SIMULATIONS, asked, campaign_plan
from mauvecl.web.state import State
from mauvecl.web.tabs import TABS, limit
from mauvecl.web.tabs.measurements import RISE_95, Region, expected
from mauvecl.web.tabs.tab import FIXED
from mauvecl.web.upload import UPLOADS, Upload, read_pairs, read_upload
from mauvecl.web.work import Job

NUMBERS = [name for name, field in FIELDS.items() if isinstance(field.read, Number)]
HOSTILE = "![x](http://127.0.0.1:1/x.png) <img src=http://127.0.0.1:1/y.png>"


# What is entered


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize(
    "text", ["", " ", "7,4", "1e999", "nan", "inf", "-inf", "seven", "1_0", "0x10", "٣", "1e400000"]
)
def test_invalid_numbers_are_faults(name: str, text: str) -> None:
    state = State()
    state.enter({name: text})
    read: Any = FIELDS[name].read
    assert read.range.words(read.unit, whole=read.whole) in state.faults[name], "what it accepts"
    assert state.entered[name] == text, "what stands there stays"
    with refused(name, FIELDS[name].label):
        state.question()
    state.enter({name: FIELDS[name].first})
    assert not state.faults
    state.question()


@pytest.mark.parametrize("name", NUMBERS)
def test_ranges_include_their_ends(name: str) -> None:
    read: Any = FIELDS[name].read
    reach = read.range
    text = str if read.whole else "{:.17g}".format
    for end, is_open in ((reach.low, reach.open_low), (reach.high, reach.open_high)):
        if is_open and math.isfinite(end):
            with refused("number"):
                read(text(end))
        elif math.isfinite(end):
            assert read(text(end)) == end
    for beyond in (reach.low - 1, 2 * reach.high + 1):
        if math.isfinite(beyond):
            with refused("number"):
                read(text(beyond))


def test_stars_are_found_by_any_name() -> None:
    state = State()
    for given, library in (
        ("GJ 581", "M3V"),
        ("hd 40307", "K2.5V"),
        ("GJ581", "M3V"),
        ("  hd  40307 ", "K2.5V"),
        ("K3V", "K2.5V"),
        ("m3v", "M3V"),
        ("vega", "Vega"),
        ("M3", "M3V"),
        ("GX And", "M1V"),
    ):
        state.enter({"star": given})
        assert state.question().star == library
    for name in catalogue.names():
        state.enter({"star": name})
        assert not state.faults, name
    state.enter({"star": "Proxima"})
    assert "Proxima" in state.faults["star"]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("", []),
        ("  \n", []),
        ("eps Eri", ["eps Eri"]),
        ("AU Mic\n\n  Proxima ", ["AU Mic", "Proxima"]),
        ("53.23 -9.46", ["53.23 -9.46"]),
        ("53.23, -9.46\nHD 1835", ["53.23, -9.46", "HD 1835"]),
        ("19h22m00s -11d12m00s", ["19h22m00s -11d12m00s"]),
        ("name,V,ra,dec\nmine,9.5,10,-3\nAU Mic,,,", ["mine", "AU Mic"]),
    ],
)
def test_targets_are_names_coordinates_or_a_table(text: str, names: list[str]) -> None:
    state = State()
    state.enter({"targets": text})
    assert not state.faults
    assert [target["name"] for target in state.question().targets] == names
    if "mine" in names:
        mine = state.question().study().plan.targets[0]
        assert (mine.magnitude, mine.target(False).ra_deg) == (9.5, 10.0)


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("AU Mik", "AU Mic"),
        ("no such star", "expected a name such as"),
        ("AU Mic\n400 95", "(target 2) is unknown"),
        ("AU Mic\nAU Mic", "named twice"),
        ("name,rates_file\nAU Mic,/etc/passwd", "rates_file"),
        ("name,neighbours\nAU Mic,/etc/passwd", "neighbours"),
        ("name,V\nAU Mic,bright", "bright"),
        ("name,V\nAU Mic", "cells"),
        ("name\n", "holds 0 targets"),
        ("\n".join(f"10 {n}" for n in range(31)), "at most 30"),
        ("x" * 4000, "too long"),
    ],
)
def test_invalid_targets_are_a_fault(text: str, reported: str) -> None:
    state = State()
    state.enter({"targets": text})
    assert state.faults.keys() == {"targets"}
    assert reported in state.faults["targets"]


@pytest.mark.parametrize(
    ("name", "text"),
    [("lines", "Mg II"), ("lines", "Mg II=x"), ("lines", "spots=0.1"), ("lines", "Mg II=0.1, mg ii=0.2"),
     ("lines", "Mg II=-1"), ("balmer_jump", "0.5"), ("balmer_jump", "2,5"), ("second_temperature_k", "12"),
     ("second_area", "")],
)  # fmt: skip
def test_invalid_spectrum_is_a_fault(name: str, text: str) -> None:
    state = State()
    state.enter({name: text})
    assert state.faults.keys() == {name}
    assert "expected" in state.faults[name]
    state.enter({name: FIELDS[name].first})
    assert not state.faults


def test_flare_spectrum_equals_that_of_the_study() -> None:
    state = State()
    assert state.question().study().flare.is_blackbody
    state.enter({"balmer_jump": "2.5", "lines": " mg ii = 0.03, 280=0.01"})
    spectrum = state.question().study().flare.spectrum
    assert (spectrum.balmer_jump, spectrum.lines) == (2.5, {"Mg II": 0.03, "280": 0.01})
    state.enter({"second_temperature_k": "30000"})
    with refused("flare.spectrum.balmer_jump", "second_area", value=2.5):
        state.question().study()
    state.enter({"balmer_jump": ""})
    assert state.question().study().flare.spectrum.second_area == 0.05


def test_plan_needs_what_is_known_of_a_target() -> None:
    state = State()
    state.enter({"targets": "12 34", "hours": "50"})
    study = campaign_plan(state.question().study())
    assert study.plan.hours == 50.0
    with refused("plan.targets", "spectral_type", value="12 34"):
        plan(study)


def test_sky_of_a_target_needs_target_and_time() -> None:
    state = State()
    state.enter({"target": "bogus", "time": "tomorrow"})
    assert not state.faults, "nobody asks for them"
    state.enter({"sky": "target and time"})
    assert state.faults.keys() == {"target", "time"}
    assert state.faults["target"].startswith("Sky target = 'bogus', expected a name such as")
    assert state.faults["time"].startswith("Time, UTC = 'tomorrow', expected a UTC time")
    for target in ("Proxima", "HD 1835", "290.68 +11.12"):
        state.enter({"target": target})
        assert state.faults.keys() == {"time"}, target
    state.enter({"time": ""})
    assert state.faults["time"].startswith("Time, UTC is empty, expected a UTC time")
    state.enter({"time": "2026-09-01T12:00"})
    assert state.question().target == "290.68 +11.12"
    state.enter({"time": "x" * 10_000})
    assert "is too long" in state.faults["time"]
    state.enter({"sky": "none", "time": ""})
    assert not state.faults


def test_stars_are_described_in_words() -> None:
    assert [star_words(name) for name in ("G2V", "M3V", "A0V", "K2.5V", "Sun", "Vega")] == [
        "a G2V star",
        "an M3V star (spectrum of GJ 581)",
        "an A0V star",
        "a K2.5V star (spectrum of HD 40307)",
        "a star like the Sun",
        "a star like Vega",
    ]


def test_link_contains_what_was_entered() -> None:
    first, second = State(), State()
    first.enter(
        {
            "magnitude": "7,4", "star": HOSTILE, "tab": "noise", "simulated": "detection,map", "target": "1 & 2=3",
            "seed": "",
        }
    )  # fmt: skip
    second.follow(first.link)
    assert (second.entered, second.faults) == (first.entered, first.faults)
    assert second.entered["seed"] == "", "an emptied field is not filled"
    second.follow("?magnitude=8")
    assert second.entered == State().entered | {"magnitude": "8"}, "what it does not hold stands as at first"
    second.follow("?magnitud=8&tab=x")
    assert "magnitud" in second.stray
    assert "tab" in second.stray
    second.question()
    second.follow("?star=" + "G" * 10_000)
    assert "more than" in second.stray
    second.enter({"star": "G" * 10**6})
    assert len(second.link) < 10_000


def test_realisations_suffice_for_the_false_alarm_probability() -> None:
    state = State()
    state.enter({"fap": "0.0001", "realisations": "100000"})
    assert "expected at least 100" in state.faults["realisations"]
    state.enter({"realisations": "1000000"})
    assert not state.faults
    state.enter({"fap": "1e-6"})
    assert state.faults
    state.enter({"realisations": "100000 sampled"})
    assert not state.faults
    assert state.question().study().run.tails == "sampled"


def test_presets_are_valid_questions() -> None:
    for given in PRESETS.values():
        state = State()
        state.enter(given)
        assert not state.faults
    with tempfile.TemporaryDirectory() as folder:
        first = ClosedForms.of(State().question(), Path(folder))
    assert 0.4 < first.chance < 0.7, "at the edge of detection"


# Answers


def star_file(path: Path) -> bytes:
    wavelength = np.linspace(170.0, 1000.0, 400)
    np.savetxt(path, np.transpose([wavelength, 1e-12 * np.exp(-(((wavelength - 500) / 150) ** 2))]))
    return path.read_bytes()


@pytest.mark.parametrize(
    ("value", "reported"),
    [
        (1.0, "> 99.99 %"),
        (0.99995, "> 99.99 %"),
        (0.5, "50.0 %"),
        (0.001, "0.10 %"),
        (1e-9, "< 0.01 %"),
        (0.0, "< 0.01 %"),
    ],
)
def test_probabilities_are_never_shown_as_certain(value: float, reported: str) -> None:
    assert percent(value) == reported


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> ClosedForms:
    return ClosedForms.of(State().question(), tmp_path_factory.mktemp("closed"))


@pytest.mark.long
def test_regions_of_two_temperatures_surround_the_flare(tmp_path: Path) -> None:
    """Their ends are those of normal errors of the logarithms, and no region has errors of 100 %."""
    state = State()
    state.follow("?second_temperature_k=30000&flare_temperature_k=9000&magnitude=6&amplitude_percent=10")
    asked = ClosedForms.of(state.question(), tmp_path)
    known, _, free = expected(asked).values()
    drawn = Region().drawn(asked, {}).sources
    assert drawn["own"] == {"x": [9000.0], "y": [pytest.approx(10.0)]}
    for name, one in (("known", known), ("free", free)):
        kelvin, low, high = (np.asarray(drawn[name][column]) for column in ("x", "low", "high"))
        reach = np.sqrt(RISE_95) * one.ahead.errors[:2] / [9000.0, 0.1]
        np.testing.assert_allclose(kelvin[[0, -1]], 9000 * np.exp([-reach[0], reach[0]]), rtol=1e-9)
        np.testing.assert_allclose([low.min(), high.max()], 10 * np.exp([-reach[1], reach[1]]), rtol=1e-3)
        assert low[80] < 10 < high[80]
    state.enter({"amplitude_percent": "1"})
    faint = Region().drawn(ClosedForms.of(state.question(), tmp_path), {}).sources
    assert np.size(faint["known"]["x"]) > 0
    assert np.size(faint["free"]["x"]) == 0


@pytest.mark.parametrize("tab", TABS)
def test_every_picture_has_its_data(closed: ClosedForms, tab: str) -> None:
    """A figure's sources and the data that come are of the same names and columns, in both themes and on all axes."""
    for picture in TABS[tab].pictures:
        drawn = picture.drawn(closed, {})
        assert drawn.text.endswith(".")
        for ink in INKS.values():
            for logs in (frozenset[str](), frozenset(axis.lower() for axis in picture.logs)):
                canvas = picture.figure(ink, logs)
                models = list(canvas.plot.references())
                sources = {m.name: set(m.data) for m in models if isinstance(m, ColumnDataSource)}
                for name, columns in drawn.sources.items():
                    assert sources[name] == set(columns), (picture.name, name)
                assert drawn.props.keys() <= {m.name for m in models}
                # A map explains itself by its colour bar.
                assert canvas.legend or any(isinstance(m, ColorBar) for m in models)


@pytest.mark.parametrize("statistic", ["matched", "chi2", "uv_excess"])
def test_card_shows_the_closed_form(statistic: str, tmp_path: Path) -> None:
    """Compare with an answer of the command line, without a scene that is drawn."""
    state = State()
    state.enter({"statistic": statistic, "magnitude": "6", "unknown": "the usual"})
    closed = ClosedForms.of(state.question(), tmp_path)
    unknown = closed.study.nuisances.marginalised(closed.quiet)
    scene = prepare([closed.quiet, closed.flare], comparison=closed.study.run.comparison(), **closed.case.draw_options)
    theory = Hypotheses(closed.quiet, (closed.flare,), (statistic,), scene, nuisances=unknown)
    cut = closed.odds.threshold
    assert cut == theory.closed_form(statistic).isf(1e-3)
    assert closed.chance == theory.closed_form(statistic, 0).sf(cut)
    at = np.linspace(-3, 3, 7) * closed.null.std + closed.null.mean
    assert closed.null.sf(at) == pytest.approx([theory.closed_form(statistic).sf(x) for x in at], abs=2e-4)


def test_changed_light_changes_the_question(closed: ClosedForms) -> None:
    """Compare scaled light with a question at that magnitude and amplitude."""
    at = limit.odds(closed, 10.0, np.array([1.0, 3.0]))
    assert limit.odds(closed, 8.5, np.ones(1))[0].probability == pytest.approx(closed.chance, abs=1e-12)
    state = State()
    state.enter({"magnitude": "10", "amplitude_percent": "6"})
    with tempfile.TemporaryDirectory() as folder:
        assert at[1].probability == pytest.approx(ClosedForms.of(state.question(), Path(folder)).chance, abs=1e-9)


@pytest.mark.parametrize("statistic", long_but(STATISTICS, *(name for name in STATISTICS if name != "paper")))
def test_curve_and_map_show_the_closed_form(statistic: str, tmp_path: Path) -> None:
    """Compare also between computed points: the curve to 1 %, the map to 0.05 mag and its rows."""
    state = State()
    state.enter({"statistic": statistic, "amplitude_percent": "5"})
    closed = ClosedForms.of(state.question(), tmp_path)
    x, y = limit._curve(limit._Kept(closed))
    steep = np.nonzero((y > 0.02) & (y < 0.98))[0][::6]
    exact = [limit.odds(closed, magnitude, np.ones(1))[0].probability for magnitude in x[steep]]
    assert y[steep] == pytest.approx(exact, abs=0.01)
    columns, rows, p = limit._map(limit._Kept(closed))
    row = p[int(np.argmin(np.abs(rows - np.log10(5.0))))]
    shift = (rows[1] - rows[0]) / 0.4  # rows lie on both sides of the amplitude of the question
    for level in (0.1, 0.5, 0.9):
        assert np.interp(-level, -row, columns) == pytest.approx(np.interp(-level, -y, x), abs=0.05 + shift)


def test_excess_equals_that_of_the_matched_statistic(closed: ClosedForms) -> None:
    """Check that squares of the excess per pixel add up to the square of the matched S/N."""
    pixel, _ = closed.excess
    assert np.sqrt(np.sum(pixel**2)) == pytest.approx(closed.odds.flaring.mean, rel=1e-9)


def test_trade_reports_no_value_beyond_its_axis(closed: ClosedForms, tmp_path: Path) -> None:
    """Where more than half are detected at the least false-alarm probability shown, half of them are below it."""
    trade = next(picture for picture in TABS["detection"].pictures if picture.name == "roc")
    half = float(re.findall(r"half of them at (\S+)\.$", trade.drawn(closed, {}).text)[0])
    assert closed.seen.sf(closed.null.isf(np.array([half])))[0] == pytest.approx(0.5, abs=0.02)
    bright = State()
    bright.enter({"magnitude": "7.4"})
    assert "half of them still below 1e-06" in trade.drawn(ClosedForms.of(bright.question(), tmp_path), {}).text


WIDE = (
    "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: w, datatype: float64}\n# meta:\n#   a0: &a0 [x, x, x, x, x, x, x, x]\n"
)
ALIASES = "".join(f"#   a{i}: &a{i} [{', '.join(8 * [f'*a{i - 1}'])}]\n" for i in range(1, 9))


@pytest.mark.long
@pytest.mark.parametrize(
    "bomb",
    [
        pytest.param(lambda: bz2.compress(bytes(2**28)), id="bzip2 of zeros"),
        pytest.param(lambda: gzip.compress(gzip.compress(bytes(2**28))), id="gzip twice"),
        pytest.param(lambda: lzma.compress(bytes(2**27), preset=0), id="xz of zeros"),
        pytest.param(lambda: f"{WIDE}{ALIASES}w\n1\n".encode(), id="YAML aliases"),
        pytest.param(lambda: b"# %ECSV 1.0\n# ---\n# meta: " + b"[" * 200_000 + b"\n", id="deep YAML"),
        pytest.param(
            lambda: b'<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "b">]><VOTABLE>&a;</VOTABLE>', id="XML entities"
        ),
    ],
)
def test_decompression_bombs_are_refused_early(bomb: Callable[[], bytes]) -> None:
    content = bomb()

    def spent() -> tuple[float, int]:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime, used.ru_maxrss

    before, most = spent()
    with pytest.raises(InputError) as error:
        read_upload("star.fits", content)
    assert error.value.expected
    assert "\n" not in str(error.value)
    # The clock's limit is the reader's own; processor time is the same on a busy machine, 3 s with the start of Python.
    assert spent()[0] - before < 10.0
    # The largest of all processes that these tests have started, in KiB; others may have been larger, and a child is as
    # large as these tests themselves until it runs its own program.
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert spent()[1] <= max(most, own, 700 * 1024)


def test_uploaded_spectrum_answers_as_on_the_command_line() -> None:
    found = read_pairs("stray.txt", b"# nm DN\n200 1\n450 3.5\n700 1\n")
    assert found == ((200.0, 1.0), (450.0, 3.5), (700.0, 1.0))
    state = State({"own_unknown": found})
    state.enter({"own_unknown": UPLOADED_UNKNOWN})
    assert state.question().study().nuisances.own["own"].points == found
    state = State()
    state.enter({"own_unknown": UPLOADED_UNKNOWN})
    assert "its file again" in state.faults["own_unknown"]


@pytest.mark.parametrize("field", long_but(["star", "flare_file", "flare_quiescent", "change_file"], "star"))
def test_message_on_a_file_names_the_fields_of_this_file(field: str) -> None:
    upload = UPLOADS[field]
    text = "\n".join(f"{angstrom} 1e-12" for angstrom in range(1700, 10_001, 10))
    with pytest.raises(InputError) as error:
        upload.read("a.txt", text.encode())
    (option,) = (name for name in upload.options if name.endswith("wavelength_unit"))
    assert remedies(error.value, upload.keys) == [(option, "Angstrom")]
    assert f"{FIELDS[option].label} Angstrom" in sentence(error.value, upload.keys)
    assert upload.read("a.txt", text.encode(), **{option: "Angstrom"}).wavelength_nm[0] == pytest.approx(170.0)


# The connection


class Talk:
    """Connection of a visitor that sends what the page's script would."""

    def __init__(self, connection: Any) -> None:
        self._connection, self._n = connection, 0

    @classmethod
    async def begin(cls, host: str, **headers: str) -> Talk:
        found = cls(await opened(host, **({"Origin": f"http://{host}"} | headers)))
        assert "hello" in await found.next()
        return found

    async def next(self) -> dict[str, Any]:
        message = await asyncio.wait_for(self._connection.read_message(), 60)
        assert message is not None, "the connection has ended"
        return dict(json.loads(message))

    async def ask(self, what: str, until: str, **more: Any) -> dict[str, Any]:
        """Ask, and wait for a message of the answer that holds a word."""
        self._n += 1
        await self._connection.write_message(json.dumps({"ask": what, "n": self._n} | more))
        while True:
            reported = await self.next()
            if reported.get("n") == self._n and until in reported:
                return reported

    async def answer(self, link: str = "", tab: str = "detection") -> dict[str, Any]:
        reported = await self.ask("answer", "faults", link=link, tab=tab)
        if "answer" in reported:
            await self.pictures(tab)
        return reported

    async def pictures(self, tab: str) -> dict[str, Any]:
        while "pictures" not in (reported := await self.next()):
            pass
        assert reported["tab"] == tab
        return reported

    async def upload(
        self, content: bytes, field: str = "star", name: str = "star.txt", link: str = ""
    ) -> dict[str, Any]:
        self._n += 1
        await self._connection.write_message(
            json.dumps({"ask": "upload", "n": self._n, "field": field, "name": name, "link": link})
        )
        await self._connection.write_message(content, binary=True)
        while (reported := await self.next()).get("n") != self._n:
            pass
        return reported

    async def file(self, **which: str) -> tuple[str, bytes]:
        reported = await self.ask("file", "file", **which)
        assert reported["file"], reported
        return reported["file"], await asyncio.wait_for(self._connection.read_message(), 60)

    async def simulate(self, kind: str, link: str) -> dict[str, Any]:
        return await self.ask("simulate", "ended", kind=kind, link=link)

    def end(self) -> None:
        self._connection.close()


@pytest.mark.long
def test_failed_upload_leaves_no_answer(served: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    good = star_file(tmp_path / "star.txt")
    uploaded = "?star=uploaded+star"
    faults = InputError("no spectrum"), RuntimeError("odd"), MemoryError(), ValueError("unequal columns"), KeyError(1)

    async def work(host: str) -> None:
        talk = await Talk.begin(host)
        assert (await talk.upload(good))["entered"] == "uploaded star"
        assert "answer" in await talk.answer(uploaded)
        for fault in faults:

            def fail(name: str, content: bytes, fault: Exception = fault) -> None:
                raise fault

            with monkeypatch.context() as patch:
                patch.setitem(visitor.UPLOADS, "star", Upload(fail, "uploaded star"))
                assert (await talk.upload(good, name="my ![star](http://x/y.png).txt"))["lacks"]
            reported = await talk.answer(uploaded)
            assert "answer" not in reported, "no star, whatever was there before"
            assert "its file again" in reported["faults"]["star"]
            assert (
                "expected"
                in (await talk.ask("file", "refused", link=uploaded, tab="spectrum", name="observation"))["refused"]
            )
        for name, content in (("a.txt", b""), ("a.txt", b"200 1\n300 2 3\n"), ("a.fits", b"SIMPLE  = " * 300)):
            assert (await talk.upload(content, name=name))["lacks"], name
        assert "entered" in await talk.upload(gzip.compress(good), name="a.exe"), "what it is shows in its content"
        talk.end()

    served(work)


@pytest.mark.parametrize("continued", ["", "9000"])
def test_flare_that_is_its_star_is_refused_on_the_field_of_the_star(served: Any, continued: str) -> None:
    """One file as the flare and as the star without it: nothing is left, whether a blackbody continues it or not."""
    spectrum = "\n".join(f"{nm} {1e-12 * (1 + 0.1 * np.sin(nm)):.9e}" for nm in range(170, 1001)).encode()
    units = "&flare_wavelength_unit=nm&flare_flux_unit=erg+s-1+cm-2+Angstrom-1"
    link = f"?flare_file=uploaded+file&flare_quiescent=uploaded+file&continue_at_k={continued}{units}"

    async def work(host: str) -> None:
        talk = await Talk.begin(host)
        for field in ("flare_file", "flare_quiescent"):
            assert (await talk.upload(spectrum, field, "same.txt", link))["entered"] == "uploaded file"
        for tab in ("detection", "measure"):
            reported = await talk.answer(link, tab)
            assert "answer" not in reported
            assert reported["faults"] == {
                "flare_quiescent": "the spectrum uploaded flare is no brighter than uploaded star without the flare, "
                "which is subtracted from it, expected the star with its flare, and the same star without it"
            }
        talk.end()

    served(work)


def test_answers_continue_while_an_upload_is_read(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    wait = threading.Event()

    def slow(name: str, content: bytes) -> Any:
        assert wait.wait(60.0)
        raise InputError("no spectrum")

    monkeypatch.setitem(visitor.UPLOADS, "star", Upload(slow, "uploaded star"))

    async def work(host: str) -> None:
        first, other = await Talk.begin(host), await Talk.begin(host)
        coming = asyncio.create_task(first.upload(b""))
        # Would the event loop wait for the reader, it would wait for ever.
        assert "answer" in await other.answer("?magnitude=8")
        wait.set()
        assert (await coming)["lacks"] == "no spectrum"
        first.end()
        other.end()

    served(work)


def test_internal_error_leaves_no_answer(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    async def work(host: str) -> None:
        talk = await Talk.begin(host)
        with monkeypatch.context() as patch:
            patch.setattr(closed_forms, "STATISTICS", {})
            reported = await talk.answer("?magnitude=8")
            assert "answer" not in reported
            assert reported["refused"] == visitor.OWN_FAULT
        assert "answer" in await talk.answer("?magnitude=8")
        talk.end()

    served(work)


def test_last_of_several_questions_is_answered(served: Any) -> None:
    async def work(host: str) -> int:
        talk = await Talk.begin(host)
        last = 100
        for i in range(last):
            await talk._connection.write_message(
                json.dumps({"ask": "answer", "n": i + 1, "link": f"?magnitude={7 + i / 100}", "tab": "detection"})
            )
        answered = 0
        while True:
            reported = await talk.next()
            answered += "answer" in reported
            if reported["n"] == last and "pictures" in reported:
                talk.end()
                return answered

    assert served(work) < 50, "others have become pointless"


#: Tabs of a visitor's frames, whose tables are compared in `test_uploaded_frames` and `test_uploaded_standards`.
OF_FRAMES = ("analyse", "calibrate")


@pytest.mark.long
@pytest.mark.parametrize("kind", [kind for kind in SIMULATIONS if kind not in OF_FRAMES])
def test_cancel_ends_every_computation(served: Any, kind: str) -> None:
    """Cancel each computation once it has started, and compute the next one."""
    link = "?realisations=4000000&targets=eps+Eri"

    async def work(host: str) -> tuple[float, float]:
        talk = await Talk.begin(host)
        await talk.answer(link)
        await talk._connection.write_message(json.dumps({"ask": "simulate", "n": 99, "kind": kind, "link": link}))
        while "waiting" in (reported := await talk.next()).get("message", "waiting"):
            assert "ended" not in reported, reported
        used = resource.getrusage(resource.RUSAGE_SELF).ru_utime
        await talk._connection.write_message(json.dumps({"ask": "cancel", "n": 100}))
        while "ended" not in (reported := await talk.next()):
            pass
        assert reported["ended"] == "Cancelled."
        spent = resource.getrusage(resource.RUSAGE_SELF).ru_utime - used
        await asyncio.sleep(0.3)
        idle = resource.getrusage(resource.RUSAGE_SELF).ru_utime - used - spent
        small = "?realisations=10000&fap=0.05&targets=eps+Eri"
        assert (await talk.simulate("detection", small))["ended"].startswith("Done")
        talk.end()
        return spent, idle

    spent, idle = served(work)
    # Processor time, for others may be at work; a tile may be under way on both processors.
    assert spent < (2.0 if kind in ("completeness", "visible") else 8.0)
    assert idle < 0.25, "nothing goes on behind it"


def test_estimate_of_the_time_left_never_rises(monkeypatch: pytest.MonkeyPatch) -> None:
    job = Job(lambda pool, count: None, unit="steps")
    job.future.result(60.0)
    job._started, shown = 0.0, []
    for now, done in ((1.0, 10), (2.0, 15), (40.0, 20), (50.0, 90)):
        monkeypatch.setattr(work, "time", types.SimpleNamespace(monotonic=partial(float, now)))
        job._count(done, 100)
        (left,) = re.findall(rf"^{done} of 100 steps, about (\d+) s left$", job.words)
        shown.append(int(left))
    assert shown == [9, 9, 9, 6]


def test_short_simulations_release_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Collecting garbage stops all visitors, for as long as their answers take: drawing an exposure must not do so."""
    released: list[float] = []
    monkeypatch.setattr(work, "release_memory", lambda: released.append(work.LONG_S))
    monkeypatch.setattr(work, "LONG_S", 60.0)
    Job(lambda pool: None).future.result(60.0)
    assert not released
    monkeypatch.setattr(work, "LONG_S", 0.0)
    Job(lambda pool: time.sleep(0.01)).future.result(60.0)
    assert released == [0.0]


def test_work_that_ends_after_the_server_is_no_error(caplog: pytest.LogCaptureFixture) -> None:
    ended: Future[str] = Future()
    told: list[str] = []

    async def wait_for(work: Future[str]) -> None:
        visitor.Visitor._when_done(work, lambda work: told.append(work.result()))

    asyncio.run(wait_for(ended))
    ended.set_result("late")
    assert not told
    assert not caplog.records


def test_visitors_who_have_left_are_sent_nothing() -> None:
    sent: list[str] = []
    left = Mock(ws_connection=object(), here=set(), write_message=sent.append)
    visitor.Visitor.send(left, ended="Cancelled.")
    left.here.add(left)
    visitor.Visitor.send(left, ended="Cancelled.")
    assert sent == ['{"ended": "Cancelled."}']


@pytest.mark.long
def test_progress_of_the_limit_has_one_total(served: Any) -> None:
    """The bar moves within each of the three limits, and never back."""
    link = "?realisations=100000&fap=0.01"

    async def work(host: str) -> list[dict[str, Any]]:
        talk = await Talk.begin(host)
        await talk.answer(link, "limit")
        await talk._connection.write_message(json.dumps({"ask": "simulate", "n": 99, "kind": "limit", "link": link}))
        seen: list[dict[str, Any]] = []
        while "ended" not in (reported := await talk.next()):
            seen += [reported] if "progress" in reported else []
        talk.end()
        return [*seen, reported]

    *seen, last = served(work)
    assert re.fullmatch(r"Done: 300 of 300 steps, \d+ s\.", last["ended"])
    shares = [one["progress"] for one in seen]
    assert shares == sorted(shares)
    assert {one["message"].split()[2] for one in seen if " of " in one["message"]} <= {"300"}


#: For each table of a tab: verb, flags in addition to the study, file.
COMMANDS = {
    "detection": ("detect", [], "detection.ecsv"),
    "roc": ("detect", [], "roc.ecsv"),
    "observation": ("simulate", ["-a", "0.02"], "observation-2.ecsv"),
    "snr": ("snr", [], "snr-element.ecsv"),
    "noise-budget": ("snr", [], "noise-budget.ecsv"),
    "limit": ("limit", [], "limit.ecsv"),
    "map": ("map", [], "map.ecsv"),
    "measure": ("measure", [], "measure.ecsv"),
    "fits": ("measure", [], "fits.ecsv"),
    "temperatures": ("measure", [], "temperatures.ecsv"),
    "joint": ("measure", [], "joint.ecsv"),
    "change": ("change", [], "change.ecsv"),
    "indices": ("change", [], "indices.ecsv"),
    "periods": ("change", [], "periods.ecsv"),
    "completeness": ("inject", [], "completeness.ecsv"),
    "limits": ("inject", [], "limits.ecsv"),
    "visible": ("visible", [], "visible.ecsv"),
    "months": ("visible", [], "months.ecsv"),
    "days": ("visible", [], "days.ecsv"),
    "plan": ("plan", [], "plan.ecsv"),
    "stars": ("plan", [], "stars.ecsv"),
    "energies": ("plan", [], "energies.ecsv"),
    "assumptions": ("plan", [], "assumptions.ecsv"),
}
assert COMMANDS.keys() == {name for tab in TABS.values() if tab.name not in OF_FRAMES for name in tab.files}


@pytest.mark.long
@pytest.mark.usefixtures("short_simulations")
def test_downloads_equal_the_files_of_the_command_line(served: Any, tmp_path: Path) -> None:
    """With a study that is taken from the page, of an uploaded star and an uploaded unknown."""
    link = "?realisations=10000&fap=0.05&statistic=chi2&magnitude=7&star=uploaded+star&own_unknown=uploaded+spectrum"
    link += "&targets=eps+Eri"

    async def work(host: str) -> dict[str, tuple[bytes, bytes, str]]:
        talk = await Talk.begin(host)
        assert "entered" in await talk.upload(star_file(tmp_path / "star.txt"))
        assert "entered" in await talk.upload(b"200 1\n400 3\n700 1\n", "own_unknown", "stray.txt")
        for kind in SIMULATIONS.keys() - {*OF_FRAMES}:
            ended = await talk.simulate(kind, link)
            assert ended["ended"].startswith("Done"), ended
        found = {}
        for tab in TABS.values():
            for name in () if tab.name in OF_FRAMES else tab.files:
                if name in ("temperatures", "joint"):
                    continue  # not asked for: a joint fit to an orbit takes half a minute
                _, table = await talk.file(link=link, tab=tab.name, name=name, ending="ecsv")
                verb, _, _ = COMMANDS[name]
                (question,) = (one for one in tab.questions if asked(one, Study())[0] == verb)
                file, study = await talk.file(link=link, tab="", name=question, ending="study")
                assert file.endswith(".zip" if "star" in tab.reads else ".toml")
                found[name] = table, study, question
        talk.end()
        return found

    done = dict[tuple[str, str], Path]()
    for name, (table, study, question) in served(work).items():
        assert b"mauvecl-page" not in table + study, "what an upload is called on the server appears nowhere"
        verb, flags, written = COMMANDS[name]
        if (verb, question) not in done:
            folder = done[verb, question] = tmp_path / name
            folder.mkdir()
            if verb in ("visible", "plan"):
                # These ask nothing of the uploaded star.
                (folder / "study.toml").write_bytes(study)
            else:
                with zipfile.ZipFile(io.BytesIO(study)) as archive:
                    archive.extractall(folder)
                assert sorted(path.name for path in folder.iterdir()) == ["star.ecsv", "study.toml"]
            with pytest.MonkeyPatch.context() as patch:
                patch.chdir(folder)
                ended = CliRunner().invoke(app, [verb, "study.toml", *flags, "--no-pictures", "-q", "-o", "out"])
            assert ended.exit_code == 0, ended.output
        assert (done[verb, question] / "out" / written).read_bytes() == table, name
    # From another folder the table finds its star again, and no other file of that name.
    folder = done["detect", "detection"]
    again = Study.read(folder / "out" / "detection.ecsv")
    assert again.star[0].file == (folder / "star.ecsv").resolve()
    (folder / "star.ecsv").write_bytes(star_file(tmp_path / "other.txt"))
    with refused("file", value="star.ecsv"):
        Study.read(folder / "out" / "detection.ecsv")


# Who is let in


def test_hosts_are_those_of_the_address_and_the_allowed() -> None:
    assert access.hosts("127.0.0.1", 5006, []) == {"127.0.0.1:5006", "localhost:5006", "[::1]:5006"}
    assert access.hosts("0.0.0.0", 5006, ["https://Mauve.example.org/"]) >= {"mauve.example.org"}
    assert "[::1]:80" not in access.hosts("::1", 80, [])


@pytest.mark.parametrize("address", ["", "no such host", "0.0.0.0"])
def test_serve_command_refuses_invalid_addresses(address: str, tmp_path: Path) -> None:
    done = run("serve", "--address", address, folder=tmp_path, code=2)
    assert re.fullmatch(r"mauvecl: --address '[^\n]*\n", done.stderr)


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return a function that runs a coroutine with a server and returns its outcome."""
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    async def all_of(work: Any, address: str) -> Any:
        made = server.make(address, port, [])
        try:
            return await work(access.netloc(address, port))
        finally:
            made.stop()
            await made.close_all_connections()

    yield lambda work, address="127.0.0.1": loop.run_until_complete(asyncio.wait_for(all_of(work, address), 120))
    loop.close()
    asyncio.set_event_loop(None)


async def got(url: str, **headers: str) -> tuple[int, str]:
    try:
        answer = await AsyncHTTPClient().fetch(HTTPRequest(url, headers=headers, request_timeout=60))
    except HTTPClientError as error:
        return error.code, (error.response.body or b"").decode() if error.response else ""
    return answer.code, answer.body.decode(errors="replace")


async def opened(host: str, **headers: str) -> Any:
    return await websocket_connect(HTTPRequest(f"ws://{host}/live", headers=headers, request_timeout=60))


def test_foreign_hosts_and_origins_are_refused(served: Any) -> None:
    async def work(host: str) -> None:
        port = host.rsplit(":", 1)[1]
        for foreign in ("evil.example", f"evil.example:{port}", f"127.0.0.1.evil.example:{port}", "127.0.0.1:1"):
            assert (await got(f"http://{host}/", Host=foreign))[0] == 403
            assert (await got(f"http://{host}/assets/page.js", Host=foreign))[0] == 403
        for origin in ("http://evil.example", "null", "https://127.0.0.1:1", f"http://localhost.evil:{port}"):
            assert (await got(f"http://{host}/", Origin=origin))[0] == 403
        for headers in ({"Origin": "http://evil.example"}, {"Host": f"evil.example:{port}"}, {}):
            with pytest.raises(HTTPClientError, match="403"):
                await opened(host, **headers)
        assert not visitor.Visitor.here, "nothing is made for them"
        assert (await got(f"http://{host}/", Origin=f"http://localhost:{port}"))[0] == 200
        (await Talk.begin(host)).end()

    served(work)


def test_page_has_every_field_once(served: Any) -> None:
    async def work(host: str) -> None:
        _, page = await got(f"http://{host}/")
        assert {name: page.count(f'id="f-{name}"') for name in FIELDS} == dict.fromkeys(FIELDS, 1)

    served(work)


def test_ipv6_is_served(served: Any) -> None:
    async def work(host: str) -> None:
        assert (await got(f"http://{host}/"))[0] == 200
        (await Talk.begin(host)).end()

    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("no IPv6 here")
    served(work, "::1")


def test_number_of_visitors_is_limited(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "MAX_VISITORS", 2)

    async def work(host: str) -> None:
        here = [await Talk.begin(host) for _ in range(2)]
        code, reported = await got(f"http://{host}/")
        assert (code, reported) == (
            503,
            "Too many visitors are here at the moment; please come again in some minutes.\n",
        )
        with pytest.raises(HTTPClientError, match="503"):
            await opened(host, Origin=f"http://{host}")
        assert (await got(f"http://{host}/favicon.svg"))[0] == 200
        assert "answer" in await here[0].answer(), "who is in stays in"
        here[1].end()
        await asyncio.sleep(0.2)
        assert (await got(f"http://{host}/"))[0] == 200
        here[0].end()

    served(work)


def test_unused_page_is_closed(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    async def work(host: str) -> None:
        connection = await opened(host, Origin=f"http://{host}")
        await connection.read_message()
        server.close_unused()
        (one,) = visitor.Visitor.here
        monkeypatch.setattr(server, "IDLE_S", 0)
        server.close_unused()
        assert await asyncio.wait_for(connection.read_message(), 10) is None
        assert connection.close_code == visitor.UNUSED, "the page receives the reason"
        await asyncio.sleep(0.1)
        assert one not in visitor.Visitor.here
        assert not Path(one._folder.name).exists()

    served(work)


NONSENSE = [
    "{",
    "[]",
    '{"n": 1}',
    '{"ask": "nothing"}',
    '{"ask": "answer", "n": "x"}',
    '{"ask": "answer", "link": 7}',
    '{"ask": ["answer"]}',
    '{"ask": "_init__"}',
    "[" * 100_000,
    "x" * 100_000,
    b"bytes of no file",
]
#: What is asked as the page asks, and for what is not there.
POINTLESS = [
    {"ask": "draw"},
    {"ask": "export"},
    {"ask": "simulate", "kind": "everything"},
    {"ask": "file", "tab": "../../etc", "name": "passwd", "ending": "study", "link": "?star=x"},
    {"ask": "file", "tab": "noise", "name": "../noise-budget", "ending": "ecsv"},
    {"ask": "file", "tab": "limit", "name": "limit", "ending": "ecsv"},
    {"ask": "upload", "field": "folder", "name": "x"},
    {"ask": "cancel"},
]


@pytest.mark.long
def test_invalid_messages_give_no_traceback_and_no_path(served: Any, caplog: pytest.LogCaptureFixture) -> None:
    reported: list[str] = []

    async def work(host: str) -> None:
        for message in NONSENSE:
            connection = await opened(host, Origin=f"http://{host}")
            await connection.read_message()
            await connection.write_message(message, binary=isinstance(message, bytes))
            assert await asyncio.wait_for(connection.read_message(), 10) is None, "the end of it"
            reported.append(str(connection.close_reason))
        for pointless in POINTLESS:
            talk = await Talk.begin(host)
            await talk._connection.write_message(json.dumps({"n": 1, "link": ""} | pointless))
            with contextlib.suppress(TimeoutError):
                reported.append(str(await asyncio.wait_for(talk._connection.read_message(), 1.0)))
            talk.end()
        outside = "/..%2f..%2fetc/passwd", "/assets/%00", "/assets/../page.py", "/assets/server.py", "/nothing", "/live"
        for path in (*outside, "/figures/light/nothing.json", "/figures/light/excess.json?log=xyz"):
            code, text = await got(f"http://{host}{path}")
            assert 400 <= code < 500, path
            reported.append(text)
        assert (await got(f"http://{host}/?star=%ff%fe"))[0] == 200
        reader, writer = await asyncio.open_connection(*host.rsplit(":", 1))
        writer.write(b"GET / HTTP/9.9\r\nHost: \xff\xfe\r\nContent-Length: -1\r\n\r\n")
        reported.append((await reader.read(1000)).decode())

    with caplog.at_level(logging.WARNING):
        served(work)
    form = Plain()
    lines = [form.format(record) for record in caplog.records]
    assert any("not a valid request" in one for one in lines), "there is something to see"
    for text in (*reported, *lines):
        assert "Traceback" not in text
        assert "site-packages" not in text
        assert str(Path(__file__).parents[2]) not in text
        assert not re.search(r'File "/', text)
    assert all("\n" not in line and len(line) < 1500 for line in lines)


def test_messages_without_fields_are_answered_or_refused(served: Any, caplog: pytest.LogCaptureFixture) -> None:
    """Messages that hold only what they ask are answered or refused, and no handler fails."""
    questions = [name.removeprefix("_ask_") for name in dir(visitor.Visitor) if name.startswith("_ask_")]
    assert len(questions) >= 8

    async def work(host: str) -> None:
        for ask in questions:
            connection = await opened(host, Origin=f"http://{host}")
            await connection.read_message()
            await connection.write_message(json.dumps({"ask": ask}))
            # Whoever is still there answers the next message.
            await connection.write_message(json.dumps({"ask": "export", "n": 7, "link": "?star=M3V&magnitude=9"}))
            reported: Any = {}
            while reported.get("n") != 7:
                message = await asyncio.wait_for(connection.read_message(), 60)
                assert message is not None, ask
                # A requested file arrives as bytes.
                reported = json.loads(message) if isinstance(message, str) else {}
            connection.close()

    with caplog.at_level(logging.ERROR):
        served(work)
    assert not [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]


def test_half_open_connections_are_dropped(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drop connections that never end their headers or body, and those beyond the limit; a page stays."""
    monkeypatch.setattr(server, "REQUEST_S", 1.0)

    async def work(host: str) -> None:
        page = await opened(host, Origin=f"http://{host}")
        await page.read_message()
        place = host.rsplit(":", 1)
        begun = f"POST / HTTP/1.1\r\nHost: {host}\r\nContent-Length: 100\r\n\r\nx".encode()
        parts = (b"", b"GET / HTTP/1.1\r\nHost:", begun)
        some = [(await asyncio.open_connection(*place), part) for part in parts for _ in range(100)]
        for (_, writer), part in some:
            writer.write(part)
        for (reader, _), _ in some:
            await asyncio.wait_for(reader.read(), 20)
        assert (await got(f"http://{host}/"))[0] == 200
        await page.write_message(json.dumps({"ask": "export", "n": 7}))
        assert json.loads(await asyncio.wait_for(page.read_message(), 60))["n"] == 7

    served(work)


def test_connections_are_bounded(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MAX_CONNECTIONS", 8)

    async def work(host: str) -> None:
        page = await opened(host, Origin=f"http://{host}")
        await page.read_message()
        some = [await asyncio.open_connection(*host.rsplit(":", 1)) for _ in range(20)]
        await asyncio.sleep(0.5)
        ended = [reader.at_eof() for reader, _ in some]
        assert ended == [True] * 13 + [False] * 7, "the oldest are closed, and the page is not"
        assert (await got(f"http://{host}/"))[0] == 200
        await page.write_message(json.dumps({"ask": "export", "n": 7}))
        assert json.loads(await asyncio.wait_for(page.read_message(), 60))["n"] == 7

    served(work)


def test_first_load_is_small_and_compressed(served: Any) -> None:
    """2.5 MB is the most that the issue allows; nothing for formulas is among it."""

    async def work(host: str) -> float:
        _, html = await got(f"http://{host}/")
        parts = re.findall(r'(?:src|href)="((?:assets|favicon)[^"]+)"', html)
        scripts = Path(static_pages.__file__).parent / "assets"
        parts += [f"assets/{path.name}" for path in scripts.glob("*.js") if f"assets/{path.name}?" not in html]
        parts += [f"figures/light/{name}.json" for name in ("excess", "distributions", "roc")]
        assert not [part for part in parts if "mathjax" in part]
        total = 0
        for part in ("", *parts):
            request = HTTPRequest(
                f"http://{host}/{part}", headers={"Accept-Encoding": "gzip"}, decompress_response=False
            )
            answer = await AsyncHTTPClient().fetch(request)
            assert answer.headers["Content-Encoding"] == "gzip", part
            assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
            total += len(answer.body)
            request.headers["If-None-Match"] = answer.headers["Etag"]
            with pytest.raises(HTTPClientError, match="304"):
                await AsyncHTTPClient().fetch(request)
        return total / 1e6

    assert served(work) < 0.6


def test_upload_limit_fits_into_a_message() -> None:
    assert max(one.most for one in UPLOADS.values()) + 4096 < server.MESSAGE


def test_tab_of_a_verb_follows_from_its_row() -> None:
    """Any verb with an answer may ask for a tab; its table is that of the terminal."""
    made = tabs._tab_of("exposure")
    assert (made.name, made.title, made.simulations) == ("exposure", "Exposure", {"exposure": "Exposure"})
    study = Study().with_settings(["signal.snr=10", "signal.wavelength_nm=300"])
    answer = VERBS["exposure"].ask(study)
    headings, *cells = made.rows(None, {"exposure": answer})  # type: ignore[arg-type]
    shown, all_cells = answer.views[0].texts(FIXED)
    assert set(headings) <= set(shown)
    assert len(cells) == len(all_cells) == 2
    assert made.rows(None, {}) == []  # type: ignore[arg-type]


# Memory


def arrays_of(thing: object) -> int:
    """Return the bytes of all arrays that an object keeps alive, modules and classes left out."""
    seen, waiting, total = {id(thing)}, [thing], 0
    while waiting:
        one = waiting.pop()
        if isinstance(one, np.ndarray) and one.base is None:
            total += one.nbytes
        for other in gc.get_referents(one):
            if id(other) not in seen and not isinstance(other, (type, types.ModuleType, types.FunctionType)):
                seen.add(id(other))
                waiting.append(other)
    return total


@pytest.mark.long
@pytest.mark.parametrize("kind", ["visible", "plan"])
def test_kept_answer_is_small(kind: str) -> None:
    """The positions of a year, 110 MB, once stayed with every plan that a visitor's connection kept."""
    state = State()
    state.enter({"targets": "AU Mic", "star": "M3V"})
    with tempfile.TemporaryDirectory() as folder:
        study = ClosedForms.of(state.question(), Path(folder)).study
        answer = visitor.SIMULATIONS[kind](study, Pool(LocalWorkers([None])))[kind]
    assert arrays_of(answer) < 20e6


@pytest.mark.long
def test_plan_of_a_hidden_target_says_so() -> None:
    """Proxima Centauri lies outside the declinations that are observed; its plan has no energies to draw."""
    state = State()
    state.enter({"targets": "Proxima Cen", "star": "M3V"})
    with tempfile.TemporaryDirectory() as folder:
        closed = ClosedForms.of(state.question(), Path(folder))
        answers = visitor.SIMULATIONS["plan"](closed.study, Pool(LocalWorkers([None])))
        shown = visitor.shown("plan", closed, answers)
    assert "Proxima Cen is never seen" in shown["pictures"]["expected"]["text"]


def test_cached_curves_release_their_question() -> None:
    """Caches of the limit keep curves, not the questions they were computed from."""
    state = State()
    state.enter({"fap": "0.0123"})
    with tempfile.TemporaryDirectory() as folder:
        closed = ClosedForms.of(state.question(), Path(folder))
    drawn = limit.Curve().drawn(closed, {}), limit.Map().drawn(closed, {})
    left = weakref.ref(closed)
    del closed
    gc.collect()
    assert left() is None
    assert all(one.sources for one in drawn)
