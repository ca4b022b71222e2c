"""The two numbers of the card and the limits with them: closed forms and simulations of the verbs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from marks import long_but
from scipy.interpolate import RegularGridInterpolator

pytest.importorskip("bokeh")

from mauvecl.answers.detection.detect import detect
from mauvecl.answers.limits.search import LimitSearch
from mauvecl.runs.pool import LocalWorkers, Pool
from mauvecl.study.study import Study
from mauvecl.web.card import card
from mauvecl.web.closed_forms import ClosedForms, percent
from mauvecl.web.fields import UNKNOWN
from mauvecl.web.headline import chances, other_payloads, solved
from mauvecl.web.simulations import SIMULATIONS
from mauvecl.web.state import State
from mauvecl.web.tabs.limit import MAGNITUDES, PERCENTS, Curve, Map

M_DWARF = "?star=M3V&magnitude=9&amplitude_percent=2&exposure_s=50"


def forms_of(link: str, folder: Path) -> ClosedForms:
    state = State()
    state.follow(link)
    return ClosedForms.of(state.question(), folder)


@pytest.mark.parametrize("unknown", UNKNOWN)
def test_card_shows_both_numbers_whichever_is_chosen(unknown: str, tmp_path: Path) -> None:
    shown = card(forms_of(f"{M_DWARF}&unknown={unknown}", tmp_path), {})
    known, usual = shown["numbers"]
    assert (known["shown"], usual["shown"]) == ("81.3 %", "2.5 %")
    assert shown["chosen"] == unknown
    assert shown["shown"] == (known, usual)[UNKNOWN.index(unknown)]["shown"]
    assert "payload mauve" in shown["words"]


@pytest.mark.parametrize(
    "more", ["", "&statistic=chi2_element", "&own_unknown=200+1,+450+3", "&instrument=mauve-electrons"]
)
def test_each_number_is_the_answer_to_its_own_question(more: str, tmp_path: Path) -> None:
    """Check the numbers of the card and of the pictures."""
    for chosen in UNKNOWN:
        found = chances(forms_of(f"{M_DWARF}{more}&unknown={chosen}", tmp_path), {})
        for one in found:
            alone = forms_of(f"{M_DWARF}{more}&unknown={one.unknown}", tmp_path)
            assert one.value == alone.chance


def test_statistic_that_unknowns_exclude_has_one_number(tmp_path: Path) -> None:
    known, usual = card(forms_of(f"{M_DWARF}&statistic=paper", tmp_path), {})["numbers"]
    assert known["value"] is not None
    assert usual["value"] is None
    assert "cannot be marginalised" in usual["interval"]


@pytest.mark.parametrize("chosen", long_but(UNKNOWN, UNKNOWN[0]))
def test_one_simulation_gives_both_numbers(chosen: str, tmp_path: Path) -> None:
    """Compare all bits with `detect` with and without the usual unknowns."""
    closed = forms_of(f"{M_DWARF}&realisations=10000&fap=0.05&unknown={chosen}", tmp_path)
    pool = Pool(LocalWorkers([None]))
    answers = SIMULATIONS["detection"](closed.study, pool)
    for one in chances(closed, answers):
        data = closed.study.model_dump()
        data["nuisances"]["usual"] = one.unknown == UNKNOWN[1]
        (row,) = (row for row in detect(Study.build(data, "test"), pool).table if row["statistic"] == "matched")
        assert one.value == row["probability"]
        assert "of 10,000 simulated" in one.how


@pytest.mark.parametrize("of", ["amplitude", "magnitude", "exposure"])
def test_sentence_holds_the_limits_of_the_verb(of: str, tmp_path: Path) -> None:
    """Compare with the closed forms of `mauvecl limit`, to the digits shown."""
    closed = forms_of(f"{M_DWARF}&of={of}&power=0.8", tmp_path)
    reported = solved(closed)
    assert reported.startswith("80 % of flares")
    for words, unknown in (("everything known", UNKNOWN[0]), ("the usual unknowns", UNKNOWN[1])):
        limit = LimitSearch(closed.assuming(unknown).case, "matched").root()
        wanted = {"amplitude": f"{100 * limit:.3g} %", "magnitude": f"{limit:.2f}", "exposure": f"{limit:.3g} s"}[of]
        (clause,) = re.findall(
            rf"(?:of at least|to V =|in) ([\d.]+(?: %| s)?)(?: at V = 9 are detected)? with {words}",
            reported,
        )
        assert clause == wanted, reported


def test_flare_at_the_limit_is_detected_with_the_wanted_probability(tmp_path: Path) -> None:
    """By inversion, within the rounding of the sentence: 1 % of the amplitude moves the chance by less than 1.5 %."""
    reported = solved(forms_of(M_DWARF, tmp_path))
    for amplitude, unknown in zip(re.findall(r"of at least ([\d.]+) %", reported), UNKNOWN, strict=True):
        closed = forms_of(f"{M_DWARF}&amplitude_percent={amplitude}&unknown={unknown}", tmp_path)
        assert closed.chance == pytest.approx(0.9, abs=0.015)


def test_limit_that_does_not_exist_is_told(tmp_path: Path) -> None:
    assert "at no magnitude" in solved(
        forms_of("?star=M3V&magnitude=9&amplitude_percent=0.0001&of=magnitude", tmp_path)
    )
    slow = solved(forms_of(f"{M_DWARF}&statistic=chi2_element", tmp_path))
    assert "takes a simulation with the usual unknowns" in slow


def test_other_payload_is_that_of_its_own_question(tmp_path: Path) -> None:
    other = chances(forms_of(f"{M_DWARF}&instrument=mauve-electrons", tmp_path), {})
    reported = " and ".join(percent(one.value) for one in other)
    assert other_payloads(forms_of(M_DWARF, tmp_path)) == f"Chances with mauve-electrons: {reported}."


@pytest.mark.parametrize("of", long_but(["amplitude", "magnitude"], "magnitude"))
def test_picture_of_the_limit_has_simulated_points_of_its_own_axis_only(of: str, tmp_path: Path) -> None:
    closed = forms_of(f"{M_DWARF}&realisations=10000&fap=0.05&of={of}", tmp_path)
    answers = SIMULATIONS["limit"](closed.study, Pool(LocalWorkers([None])))
    drawn = Curve().drawn(closed, answers)
    magnitudes = list(drawn.sources["simulated"]["x"])
    assert bool(magnitudes) == (of == "magnitude")
    assert all(5 < magnitude < 14 for magnitude in magnitudes)
    unit = r"of at least [\d.]+ % \[[\d.]+ % to [\d.]+ %\]" if of == "amplitude" else r"to V = [\d.]+ \["
    assert re.search(f"Simulated: 90 % are detected .*{unit}", drawn.text), drawn.text


def test_contours_of_the_map_are_labelled_where_they_are(tmp_path: Path) -> None:
    """Each label stands where the map has its probability, and the columns of the tooltip fit the map."""
    sources = Map().drawn(forms_of(M_DWARF, tmp_path), {}).sources
    (image,), (percent,) = sources["map"]["image"], sources["map"]["percent"]
    assert np.shape(image) == np.shape(percent)
    x = np.linspace(*MAGNITUDES, np.shape(image)[1])
    y = np.linspace(*np.log10(PERCENTS), np.shape(image)[0])
    assert list(sources["labels"]["text"]) == ["10 %", "50 %", "90 %"]
    at = RegularGridInterpolator((y, x), image)(np.column_stack([sources["labels"]["y"], sources["labels"]["x"]]))
    assert at == pytest.approx([0.1, 0.5, 0.9], abs=0.03)
    assert np.log10(percent[:, 0]) == pytest.approx(y)
