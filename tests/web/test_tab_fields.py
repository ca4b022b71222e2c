"""Fields of each tab: those that it shows change what is asked, and others change nothing."""

from __future__ import annotations

import io
import json
import zipfile
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("tornado")
pytest.importorskip("bokeh")

from mauvecl.answers.verbs import VERBS
from mauvecl.host.spectra.conversion import ReadSpectrum
from mauvecl.host.stars.source import Source
from mauvecl.web.card import card
from mauvecl.web.closed_forms import ClosedForms
from mauvecl.web.fields import FIELDS, UPLOADED_FILE, WITH_FILE
from mauvecl.web.simulations import SIMULATIONS, asked, verbs_of
from mauvecl.web.standards import Observations
from mauvecl.web.state import State
from mauvecl.web.tabs import TABS, reads_of
from mauvecl.web.tabs.tab import Tab
from mauvecl.web.upload import UPLOADS, VisitorFile
from mauvecl.web.visitor import shown

pytestmark = pytest.mark.long

#: Files of the visitor's.


def archive() -> Observations:
    """Return an archive with a study and a file that it names."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as files:
        files.writestr("standards.toml", '[[calibrate.observations]]\nframes = "a.csv"\nlibrary = "G2V"\n')
        files.writestr("a.csv", "1")
    return Observations.of("standards.zip", out.getvalue())


ADDED = Source.from_library("A0V")
FLARE, QUIET = (
    ReadSpectrum(ADDED.wavelength_nm, share * ADDED.flux_flam, name, "upload")
    for name, share in (("flare", 1e-4), ("quiescent", 5e-5 * np.linspace(0.1, 1, ADDED.wavelength_nm.size)))
)
FILES = {
    "change_file": ADDED,
    "flare_file": FLARE,
    "flare_quiescent": QUIET,
    "frames": VisitorFile("a.csv", b"1"),
    "mapping": VisitorFile("a.toml", b"2"),
    "observations": archive(),
}
Given = tuple[tuple[str, str], ...]

#: A table of neighbours, and the same with positions from which separations are measured.
NEAR, PLACES = "name,separation,magnitude,spectral_type\nB,8,9,G2V", "name,ra,dec,V,spectral_type\nB,0,0.002,9,G2V"
#: Another valid text for every field.
OTHER = {
    "star": "K5V", "magnitude": "9", "band": "B", "amplitude_percent": "3", "exposure_s": "100", "fap": "0.01",
    "statistic": "chi2", "realisations": "1000000", "flare_temperature_k": "12000", "balmer_jump": "2",
    "lines": "Mg II=0.03", "second_temperature_k": "20000", "second_area": "0.3", "temperature_c": "5", "sky": "none",
    "sky_brightness": "21", "target": "53.2 -9", "time": "2027-01-20", "unknown": "the usual",
    "own_unknown": "200 1, 700 2", "targets": "AU Mic", "start": "2027-06-01", "days": "100", "hours": "50",
    "seed": "7", "signal": "paper", "instrument": "mauve-electrons", "visits": "5", "of": "magnitude", "power": "0.5",
    "ebv": "0.1", "skipped_nm": "200:250", "snr_per_bin": "20", "joint_fit": "yes", "changes": "Mg II",
    "shortest_d": "2", "longest_d": "20", "distance_pc": "7", "false_alarms": "2",
    "per": "day", "neighbours": NEAR, "neighbours_of": "0 0", "neighbour_share": "0.5", "pointing_rate": "2",
    "pointing_duration": "100", "pointing_depth": "10", "frames": UPLOADED_FILE, "mapping": UPLOADED_FILE,
    "quality_bits": "none",
    "change_file": UPLOADED_FILE, "change_band": "B", "flare_file": UPLOADED_FILE, "flare_quiescent": UPLOADED_FILE,
    "as_observed": "yes",
    "observations": UPLOADED_FILE, "knots": "50", "light_error": "1", "spectrum_error": "2",
}  # fmt: skip
#: Fields that say how an upload is read, which change nothing without one.
READS = {name for one in UPLOADS.values() for name in one.options}
#: What must be entered first for a field to apply.
SKY = {"sky": "target and time", "target": "eps Eri", "time": "2027-01-15"}
BEFORE = {"target": SKY, "time": SKY, "second_area": {"second_temperature_k": "20000"},
          "neighbours_of": {"neighbours": PLACES, "neighbours_of": "0 0.001"}, "neighbour_share": {"neighbours": NEAR},
          "change_band": {"change_file": UPLOADED_FILE},
          **{name: {"flare_file": UPLOADED_FILE} for name in ("flare_quiescent", "as_observed")},
          "pointing_duration": {"pointing_rate": "1"}, "pointing_depth": {"pointing_rate": "1"},
          **{name: {"targets": "eps Eri"} for name in ("start", "days", "hours")}}  # fmt: skip
#: Fields of the headline that the tabs of pictures show with it.
HEADLINE = TABS["detection"].reads


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return one folder for all tests, so that pictures of the first question are drawn once."""
    return tmp_path_factory.mktemp("fields")


@cache
def forms(tab: str, given: Given, folder: Path, *, everything: bool = False) -> ClosedForms:
    state = State(FILES)
    state.enter(dict(given))
    question = state.question() if everything else state.question(TABS[tab].reads)
    return ClosedForms.of(question, folder, headline=TABS[tab].headline)


@cache
def pictures(tab: str, given: Given, folder: Path, *, everything: bool = False) -> str:
    """Return what a tab shows without a simulation, its headline included."""
    closed = forms(tab, given, folder, everything=everything)
    above = card(closed, {}) if TABS[tab].headline else {}
    return json.dumps([above, shown(tab, closed, {})], default=str)


def requests(tab: Tab, given: Given, folder: Path) -> list[str]:
    """Return the keys of the studies that a tab's simulations ask, as far as their verbs take them."""
    study, found = forms(tab.name, given, folder).study, []
    for simulation in tab.simulations:
        wanted = SIMULATIONS[simulation].asked(study).model_dump(mode="json")
        for verb in verbs_of(simulation):
            taken = {f"{section}.{key}": value for section, keys in wanted.items() if isinstance(keys, dict)
                     for key, value in keys.items()}  # fmt: skip
            taken |= {f"star.{key}": value for key, value in wanted["star"][0].items()}
            # The keys that a simulation sets itself are part of what it asks.
            found.append(str({key: value for key, value in taken.items() if takes(verb, key)}))
    return found


def takes(verb: str, key: str) -> bool:
    section = key.partition(".")[0]
    one = VERBS[verb]
    return (
        one.accepts(key)
        or section in ("map", "injections", "measure")
        or any(taken.startswith(f"{key}.") for taken in (*one.observation, *one.takes))
    )


def texts(name: str) -> tuple[Given, Given]:
    """Return what is entered before a field is changed, and after it."""
    before: dict[str, Any] = BEFORE.get(name, {})
    return tuple(before.items()), tuple((before | {name: OTHER[name]}).items())


def test_every_field_has_another_text() -> None:
    assert OTHER.keys() == FIELDS.keys() - READS


@pytest.mark.parametrize("name", OTHER)
def test_hidden_fields_change_nothing_and_others_do(name: str, folder: Path) -> None:
    before, after = texts(name)
    for tab in TABS.values():
        if name in tab.reads:
            drawn = pictures(tab.name, before, folder) != pictures(tab.name, after, folder)
            wanted = requests(tab, before, folder) != requests(tab, after, folder)
            # The number of draws and their seed are those of the button next to the headline.
            headline = tab.headline and name in HEADLINE
            assert drawn or wanted or headline, f"{tab.title} shows {name}, which changes nothing"
        else:
            # Even if the value reached the pictures, they would not change.
            same = [pictures(tab.name, given, folder, everything=True) for given in (before, after)]
            assert same[0] == same[1], f"{tab.title} hides {name}, which changes its pictures"
            assert requests(tab, before, folder) == requests(tab, after, folder)


def test_fields_of_the_detection_change_the_detection(folder: Path) -> None:
    for name in HEADLINE - READS:
        before, after = texts(name)
        drawn = pictures("detection", before, folder) != pictures("detection", after, folder)
        # The limit in a sentence is that of the tab of limits.
        tabs = [TABS["detection"], TABS["limit"]]
        assert drawn or any(requests(tab, before, folder) != requests(tab, after, folder) for tab in tabs), name


def test_fields_are_shown_where_they_matter() -> None:
    assert {"exposure_s", "fap", "statistic"}.isdisjoint(TABS["completeness"].reads)
    assert TABS["visibility"].reads == {"targets", "start", "days"}
    spectrum = {"flare_temperature_k", "balmer_jump", "lines", "second_temperature_k", "second_area", "flare_file"}
    spectrum |= set(WITH_FILE["flare_file"])
    spectrum -= {"as_observed"}
    assert TABS["plan"].reads == {"targets", "start", "days", "hours", "instrument", "temperature_c", "per"} | spectrum
    assert "visits" in TABS["change"].reads
    assert "visits" not in HEADLINE
    for name in SIMULATIONS:
        assert asked(name, State().question(reads_of(name)).study())


def test_invalid_field_of_another_tab_leaves_the_answer() -> None:
    state = State()
    state.enter({"star": "no such star", "targets": "eps Eri"})
    assert state.faults.keys() == {"star"}
    assert state.faults_of(TABS["plan"].reads) == {}
    assert state.question(TABS["plan"].reads).star == "G2V"


def test_tables_along_a_stare_are_offered_where_it_is_measured() -> None:
    tab, answer = TABS["measure"], SimpleNamespace(tables=dict.fromkeys(("measure", "fits", "joint")))
    assert [name for name in tab.files if tab.offers(name, {"measure": answer})] == ["measure", "fits", "joint"]
    assert not any(tab.offers(name, {}) for name in tab.files)
