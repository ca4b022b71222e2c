"""Commands and programs that the page prints: they are the question, and their numbers are the page's."""

from __future__ import annotations

import io
import re
import shlex
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from marks import long_but
from scripts import tool

pytest.importorskip("bokeh")

from typer.testing import CliRunner

from mauvecl.answers.observations.change import change
from mauvecl.answers.verbs import VERBS
from mauvecl.cli import session
from mauvecl.cli.app import app
from mauvecl.runs.pool import LocalWorkers, Pool
from mauvecl.schema.errors import InputError
from mauvecl.study.cases import cases
from mauvecl.study.study import Study
from mauvecl.web.closed_forms import ClosedForms
from mauvecl.web.commands import differing, keys_used
from mauvecl.web.downloads import commands_and_programs, study_file
from mauvecl.web.fields import UPLOADED
from mauvecl.web.simulations import SIMULATIONS, asked
from mauvecl.web.state import State
from mauvecl.web.static_pages import BIBTEX
from mauvecl.web.tabs import TABS
from mauvecl.web.upload import read_added, read_flare, read_quiescent, read_upload

ROOT = Path(__file__).parents[2]
#: Links with fields that the random ones do not reach.
LINKS = (
    "",
    "?star=Vega&magnitude=3&band=GALEX+NUV&sky=none&realisations=100000+sampled&fap=1e-06&unknown=the+usual",
    "?sky=target+and+time&target=290.68+%2B11.12&time=2026-09-01T12:00&own_unknown=200+1,+450+3&seed=7&targets=eps+Eri"
    "&signal=paper&instrument=mauve-electrons",
    "?star=blackbody+9000+K&ebv=0.1&targets=AU+Mic",
    "?star=power+law+-2&targets=AU+Mic",
    "?balmer_jump=2.5&lines=Mg+II%3D0.03,+280%3D0.01&targets=AU+Mic",
    "?second_temperature_k=30000&second_area=0.1&visits=7",
    "?joint_fit=yes&snr_per_bin=20&skipped_nm=200:250,322:368",
)


check_commands = tool("check_commands")


def _study_of(command: str, monkeypatch: pytest.MonkeyPatch) -> Study:
    """Return the study of a command, which is not answered."""
    seen: list[Study] = []

    def stop(self: Any) -> Any:
        seen.append(self.study)
        raise InputError("seen")

    with monkeypatch.context() as patch:
        patch.setattr(session.Session, "__enter__", stop)
        program, *words = shlex.split(command)
        assert program == "mauvecl"
        ended = CliRunner().invoke(app, words)
        assert seen, ended.output
    (found,) = seen
    return found


@pytest.mark.parametrize("number", long_but(range(len(LINKS) + 20), *range(len(LINKS) + 2)))
def test_command_and_program_are_the_question(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For every tab: links of choice, and 20 random ones; what the verb does not use is not said."""
    monkeypatch.chdir(tmp_path)
    state = State()
    generator = np.random.default_rng([2, number])
    state.follow(LINKS[number] if number < len(LINKS) else check_commands.random_link(generator))
    while number >= len(LINKS) and state.faults:
        # Links do not hold a visitor's files.
        state = State()
        state.follow(check_commands.random_link(generator))
    question = state.question()
    for tab in TABS.values():
        for one in commands_and_programs(tab, question, tmp_path):
            verb, wanted = asked(one["question"], question.study())
            assert one["command"].startswith(f"mauvecl {verb}")
            given: dict[str, Any] = {}
            exec(one["python"].partition("answer =")[0], given)
            found = _study_of(one["command"], monkeypatch), given["study"]
            said = dict(keys_used(VERBS[verb], wanted, Study()))
            assert said or verb == "visible", one["command"]
            for study in found:
                other = dict(differing(study, Study()))
                assert {key: other.get(key) for key in said} == said, one["command"]


def test_own_star_is_in_the_study_that_the_command_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No flag holds a visitor's file: what observes it is asked by the study, next to which the file lies."""
    monkeypatch.chdir(tmp_path)
    text = "\n".join(f"{nm} 1e-12" for nm in range(170, 1001))
    kept = tmp_path / "kept"
    kept.mkdir()
    state = State({"star": read_upload("star.txt", text.encode())})
    state.follow(f"?star={UPLOADED.replace(' ', '+')}")
    for tab in TABS.values():
        question = state.question(tab.reads)
        for one in commands_and_programs(tab, question, kept):
            if "star" not in tab.reads:
                continue
            verb, wanted = asked(one["question"], question.study(kept))
            assert one["command"] == f"mauvecl {verb} study.toml"
            assert "'file': 'star.ecsv'" in one["python"]
            _, content = study_file(wanted, "study")
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                archive.extractall(tmp_path)
            assert _study_of(one["command"], monkeypatch).star[0].file == Path("star.ecsv")


def test_own_flare_answers_as_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In Angstrom, continued by a blackbody: as the command line reads it itself, and as the study of the page."""
    monkeypatch.chdir(tmp_path)
    kept = tmp_path / "kept"
    kept.mkdir()
    nm = np.linspace(300.0, 690.0, 800)
    text = "\n".join(f"{10 * x:.4f} {np.exp(-(((x - 350) / 60) ** 2)):.9e}" for x in nm)
    (tmp_path / "own.txt").write_text(text)
    options = {"flare_wavelength_unit": "Angstrom", "flare_flux_unit": None, "continue_at_k": 9000.0}
    state = State({"flare_file": read_flare("own.txt", text.encode(), **options)})
    state.follow("?flare_file=uploaded+file&flare_wavelength_unit=Angstrom&continue_at_k=9000")
    question = state.question()
    page = ClosedForms.of(question, kept)
    taken = {one["question"]: one for one in commands_and_programs(TABS["detection"], question, kept)}
    assert taken["detection"]["command"] == "mauvecl detect study.toml"
    _, content = study_file(page.study, "study")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(tmp_path)
    direct = "mauvecl detect --star G2V --magnitude 8.5 --amplitude 0.02 --temperature 21 --flare-file own.txt"
    direct += " --flare-wavelength-unit Angstrom --continue-at 9000"
    for command in (taken["detection"]["command"], direct):
        (case,) = cases(_study_of(command, monkeypatch))
        np.testing.assert_allclose(case.flares[0].source_electrons, page.flare.source_electrons, rtol=1e-9)
    # The flare is another one than without the file.
    other = ClosedForms.of(State().question(), kept)
    assert abs(page.chance - other.chance) > 0.01


@pytest.mark.parametrize("tab", long_but(["detection", "measure"], "detection"))
def test_observed_flare_without_its_star_answers_as_its_files(
    tab: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As bright as observed, in Angstrom: as the command line subtracts the star, and as the study of the page."""
    monkeypatch.chdir(tmp_path)
    kept = tmp_path / "kept"
    kept.mkdir()
    ranges = {"flare_file": np.linspace(300.0, 690.0, 800), "flare_quiescent": np.linspace(290.0, 680.0, 500)}
    texts = {}
    for field, nm in ranges.items():
        flux = 1e-12 * np.ones(nm.size)
        if field == "flare_file":
            flux += 1e-13 * (350 / nm) ** 2
        texts[field] = "\n".join(f"{10 * x:.4f} {y:.9e}" for x, y in zip(nm, flux, strict=True))
        (tmp_path / f"{field}.txt").write_text(texts[field])
    units = {"flare_wavelength_unit": "Angstrom", "flare_flux_unit": "erg s-1 cm-2 Angstrom-1"}
    state = State({
        "flare_file": read_flare("a.txt", texts["flare_file"].encode(), continue_at_k=9000.0, **units),
        "flare_quiescent": read_quiescent("b.txt", texts["flare_quiescent"].encode(), **units),
    })  # fmt: skip
    link = "&".join(f"{name}={text}" for name, text in units.items()).replace(" ", "+")
    both = f"?{link}&continue_at_k=9000&flare_file=uploaded+file&flare_quiescent=uploaded+file"
    state.follow(f"{both}&as_observed=yes&amplitude_percent=77")
    question = state.question(TABS[tab].reads)
    page = ClosedForms.of(question, kept)
    assert page.question.amplitude_percent == pytest.approx(100 * page.study.flare.amplitudes[0])
    (taken,) = commands_and_programs(TABS[tab], question, kept)
    verb = {"detection": "detect"}.get(tab, tab)
    assert taken["command"] == f"mauvecl {verb} study.toml"
    _, content = study_file(page.study, "study")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(tmp_path)
    direct = f"mauvecl {verb} --star G2V --magnitude 8.5 --temperature 21 --flare-file flare_file.txt --as-observed "
    direct += "--flare-quiescent flare_quiescent.txt --continue-at 9000 --flare-wavelength-unit Angstrom "
    direct += "--flare-flux-unit 'erg s-1 cm-2 Angstrom-1'"
    for command in (taken["command"], direct):
        (case,) = cases(_study_of(command, monkeypatch))
        assert case.amplitudes == pytest.approx(page.study.flare.amplitudes, rel=1e-9)
        np.testing.assert_allclose(case.flares[0].source_electrons, page.flare.source_electrons, rtol=1e-9)
    # Without the subtraction the flare is another one, and so it is with an amplitude.
    for other in (f"{both}&as_observed=no".replace("&flare_quiescent=uploaded+file", ""), f"{both}&as_observed=no"):
        state.follow(other)
        found = ClosedForms.of(state.question(TABS[tab].reads), kept)
        assert np.abs(found.flare.source_electrons / page.flare.source_electrons - 1).max() > 0.01


@pytest.mark.long
def test_own_added_spectrum_answers_as_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In Angstrom, for a band: as the command line reads it itself, and as the command that the page prints."""
    monkeypatch.chdir(tmp_path)
    kept = tmp_path / "kept"
    kept.mkdir()
    nm = np.linspace(170.0, 1000.0, 800)
    text = "\n".join(f"{10 * x:.4f} {np.exp(-(((x - 300) / 80) ** 2)):.9e}" for x in nm)
    (tmp_path / "own.txt").write_text(text)
    state = State({"change_file": read_added("own.txt", text.encode(), change_wavelength_unit="Angstrom")})
    state.follow("?change_file=uploaded+file&change_wavelength_unit=Angstrom&change_band=B&changes=Mg+II&magnitude=7")
    tab = TABS["change"]
    question = state.question(tab.reads)
    page = SIMULATIONS["change"](question.study(kept), Pool(LocalWorkers([None])))["change"].table
    assert page["change"].tolist() == ["Mg II", "spectrum"]
    (taken,) = commands_and_programs(tab, question, kept)
    assert "--change-file added.ecsv --change-band B" in taken["command"]
    _, content = study_file(asked("change", question.study(kept))[1], "study")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(tmp_path)
    direct = "mauvecl change --star G2V --magnitude 7 --temperature 21 --sky 22.1 --visits 20 --change 'Mg II'"
    direct += " --change spectrum --change-file own.txt --change-wavelength-unit Angstrom --change-band B"
    for command in (taken["command"], "mauvecl change study.toml", direct):
        table = change(_study_of(command, monkeypatch)).table
        for name in ("error", "smallest"):
            np.testing.assert_allclose(np.asarray(table[name]), np.asarray(page[name]), rtol=1e-9, err_msg=command)
    # Another band is another answer: that of the light in V.
    state.enter({"change_band": "V"})
    other = change(state.question(tab.reads).study(kept)).table
    assert abs(other["smallest"][1] / page["smallest"][1] - 1) > 0.01


@pytest.mark.long
@pytest.mark.usefixtures("short_simulations")
@pytest.mark.parametrize(
    # Answers about a visitor's frames are compared in `test_uploaded_frames` and `test_uploaded_standards`.
    "tab",
    [name for name in TABS if name not in ("analyse", "calibrate")],
)
def test_printed_commands_give_the_numbers_of_the_page(tab: str, tmp_path: Path) -> None:
    """Run the command of a random question for each tab; `tools/check_commands.py` runs twenty.

    This detects a page and a command line that compute something else from the same question. Answers with the
    user's own unknown spectrum are compared in `test_downloads_equal_the_files_of_the_command_line`.
    """
    generator = np.random.default_rng([3, len(tab)])
    state, closed = check_commands.possible_question(generator, TABS[tab], tmp_path, quick=True)
    assert check_commands.differences(TABS[tab], state, closed, tmp_path) == []


@pytest.mark.long
def test_comparison_asks_what_the_tab_reads(tmp_path: Path) -> None:
    """A sky that the plan does not read changes nothing, not even for a target that is never visible."""
    state = State()
    state.follow("?sky=none&targets=AU+Mic&days=10&exposure_s=7.5&magnitude=6")
    everything = ClosedForms.of(state.question(), tmp_path)
    assert check_commands.differences(TABS["plan"], state, everything, tmp_path) == []


@pytest.mark.long
def test_comparison_notices_another_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tab = TABS["spectrum"]
    state, closed = check_commands.possible_question(np.random.default_rng(5), tab, tmp_path)
    original = check_commands.commands_and_programs

    def reseeded(*how: Any) -> list[dict[str, str]]:
        return [one | {"command": re.sub(r"--seed \d+", "--seed 99", one["command"])} for one in original(*how)]

    monkeypatch.setattr(check_commands, "commands_and_programs", reseeded)
    assert check_commands.differences(tab, state, closed, tmp_path)


def test_bibtex_cites_what_the_citation_file_cites() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    text = BIBTEX.format(version=cited["version"])
    assert text.count("@") == 2
    assert text.count("{") == text.count("}")
    for entry in (cited, *cited["references"]):
        assert f"title = {{{entry['title']}}}" in text
        assert all(one.get("family-names", one.get("name")) in text for one in entry["authors"])
    assert f"version = {{{cited['version']}}}" in text
    paper = cited["references"][0]
    for value in (paper["journal"], str(paper["year"]), paper["url"], str(cited["date-released"])[:4]):
        assert f"{{{value}}}" in text
