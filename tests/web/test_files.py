"""Studies, commands, programs and tables that the page gives: they are the question, and their numbers are the page's.

Files go the other way, too: what a visitor uploads is read as the command line reads it, or refused in a sentence.
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import re
import shlex
import struct
import tempfile
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from astropy.table import Table
from commands import run
from golden_inputs import FRAMES, INPUTS, frames
from marks import long_but
from refusals import refused, says_what_is_accepted
from scripts import tool

from mauvecl import Instrument, Source, Study
from tests.web.visits import Server, Talk, column, link

ROOT = Path(__file__).parents[2]
check_commands = tool("check_commands")
FILE = "uploaded file"
DATA = Path(__file__).parents[1] / "data" / "web"
FIELDS = tomllib.loads((DATA / "fields.toml").read_text(encoding="utf-8"))
#: Expressions, for `made`, of the content of uploads that are refused.
UPLOADS = tomllib.loads((DATA / "uploads.toml").read_text(encoding="utf-8"))
SHOWN = {tab: {*names.split()} for tab, names in tomllib.loads((DATA / "shown.toml").read_text()).items()}


def valued(data: Any, key: str) -> Any:
    for part in key.split("."):
        data = (data or [{}])[0] if isinstance(data, list) else data
        data = data.get(part) if isinstance(data, dict) else None
    return data


async def test_every_field_is_a_key_of_the_study(talk: Talk, words: dict[str, Any]) -> None:
    """Fields are shown where they matter, and are in the downloaded study, the printed command and program."""
    assert {tab: {*seen["reads"]} for tab, seen in words["tabs"].items()} == SHOWN, "shown.toml lists fields of tabs"
    uploads = {name for name, one in words["uploads"].items() for name in (name, *one["options"])}
    expected = words["fields"].keys() - uploads - {"as_observed", "change_band"} | {"star", "own_unknown"}
    assert FIELDS.keys() == expected, "fields.toml has a key and a value of every field"
    for name, row in FIELDS.items():
        tab = row.get("tab") or next(tab for tab in SHOWN if name in SHOWN[tab])
        before = row.get("before", {})
        seen = []
        for entered in (before, before | {name: row["text"]}):
            asked = link(**entered)
            question, printed = next(iter((await talk.exported(asked, tab)).items()))
            file, study = await talk.file(link=asked, tab="", name=question, ending="study")
            if file.endswith(".zip"):
                study = zipfile.ZipFile(io.BytesIO(study)).read("study.toml")
            given: dict[str, Any] = {}
            exec(printed["python"].partition("answer =")[0], given)
            found = (tomllib.loads(study.decode()), given["study"].model_dump(mode="json"))
            seen.append([valued(one, row["key"]) == row["value"] for one in found])
            seen[-1].append(f"{row['command']} " in f"{printed['command']} ")
        assert seen == [[False] * 3, [True] * 3], (name, printed)


@pytest.mark.long
async def test_hidden_fields_change_nothing_and_others_do(talk: Talk, words: dict[str, Any]) -> None:
    """Hidden fields may even be wrong."""
    # Each question is asked once: most fields change the same one.
    known: dict[tuple[str, ...], Any] = {}

    async def once(ask: Any, asked: str, tab: str) -> Any:
        if (key := (ask.__name__, asked, tab)) not in known:
            known[key] = await ask(asked, tab)
        return known[key]

    for tab, shown in SHOWN.items():
        wrong = {name: "x" for name in words["fields"] if name not in shown}
        first, other = [await once(talk.answer, link(**entered), tab) for entered in ({}, wrong)]
        assert {**first, "n": 0} == {**other, "n": 0, "known": first["known"]}, tab
        for name in FIELDS.keys() & shown:
            before = FIELDS[name].get("before", {})
            asked = [link(**entered) for entered in (before, before | {name: FIELDS[name]["text"]})]
            old, new = [await once(talk.exported, one, tab) for one in asked]
            if old == new:
                old, new = [await once(talk.answer, one, tab) for one in asked]
                # Limits stand in a sentence of their own; the number of draws and their seed are the button's.
                above = words["tabs"][tab]["chance"] and name in ("of", "power", "realisations", "seed")
                assert above or {**old, "n": 0} != {**new, "n": 0}, f"{tab} shows {name}, which changes nothing"


#: For each table of a tab: verb with flags, and file.
COMMANDS = {
    (tab, name): command.rsplit(" ", 1)
    for tab, tables in tomllib.loads((DATA / "tables.toml").read_text(encoding="utf-8")).items()
    for name, command in tables.items()
}
PAIRS = b"200 1\n400 3\n700 1\n"


def made(content: str) -> Any:
    return eval(content, globals() | {"bz2": bz2, "lzma": lzma, "struct": struct})


def star_file() -> bytes:
    nm = np.linspace(170.0, 1000.0, 400)
    return rows_of(nm, 1e-12 * np.exp(-(((nm - 500) / 150) ** 2)))


def rows_of(*columns: Any) -> bytes:
    return "\n".join(" ".join(f"{x:.9e}" for x in row) for row in zip(*columns, strict=True)).encode()


def extracted(content: bytes, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(folder)
    return folder


def answered(folder: Path, command: str) -> dict[str, Table]:
    words = shlex.split(command.removeprefix("mauvecl "))
    run(*words, "--no-pictures", "--quiet", "--output", f"out-{len(list(folder.iterdir()))}", folder=folder)
    newest = max(folder.glob("out-*"), key=lambda path: int(path.name[4:]))
    return {path.stem: Table.read(path, format="ascii.ecsv") for path in newest.glob("*.ecsv")}


def same_numbers(one: Table, other: Table, *names: str, rtol: float = 1e-9) -> None:
    """Compare columns, by default all of them; sums of linear algebra may differ in their last digits."""
    assert one.colnames == other.colnames
    for name in names or one.colnames:
        if one[name].dtype.kind == "f":
            np.testing.assert_allclose(np.asarray(one[name]), np.asarray(other[name]), rtol=rtol, err_msg=name)
        else:
            assert list(map(str, one[name])) == list(map(str, other[name])), name


@pytest.mark.long
def test_downloads_equal_the_files_of_the_command_line(server: Server, words: dict[str, Any], tmp_path: Path) -> None:
    """With a study that is taken from the page, of an uploaded star, unknown and added spectrum: all bytes."""
    entered = {"realisations": "10000", "fap": "0.05", "statistic": "chi2", "magnitude": "7", "targets": "eps Eri"}
    # A short campaign and few periods, whose numbers take seconds.
    entered |= {"days": "10", "shortest_d": "3", "longest_d": "5", "visits": "5"}
    entered |= {"changes": "Mg II", "change_file": FILE, "change_wavelength_unit": "Angstrom", "change_band": "B"}
    asked = link(**entered, star="uploaded star", own_unknown="uploaded spectrum")
    nm = np.linspace(170.0, 1000.0, 800)
    flux = np.exp(-(((nm - 300) / 80) ** 2))

    async def work(talk: Talk) -> dict[tuple[str, str], tuple[bytes, bytes, str]]:
        assert (await talk.upload(star_file()))["entered"] == "uploaded star"
        assert (await talk.upload(PAIRS, "own_unknown", "stray.txt"))["entered"] == "uploaded spectrum"
        assert (await talk.upload(rows_of(10 * nm, flux), "change_file", "own.txt", asked))["entered"] == FILE
        for kind in words["asks"].keys() - {"analyse", "calibrate"}:
            assert (await talk.simulate(kind, asked)).startswith("Done"), kind
        offered = (await talk.answer(asked))["answer"]["files"]
        tables = {tuple(one.split()) for one in offered if not one.endswith((".pdf", ".html"))}
        assert tables == COMMANDS.keys()
        found = {}
        for (tab, name), (verb, _) in COMMANDS.items():
            _, table = await talk.file(link=asked, tab=tab, name=name, ending="ecsv")
            said = await talk.exported(asked, tab)
            (question,) = (name for name, one in said.items() if one["command"].split()[1] == verb.split()[0])
            file, study = await talk.file(link=asked, tab="", name=question, ending="study")
            assert file.endswith(".zip" if "star" in SHOWN[tab] else ".toml")
            found[tab, name] = table, study, question
        return found

    done: dict[tuple[str, str], Path] = {}
    for (tab, name), (table, study, question) in server.visited(work).items():
        assert b"mauvecl-page" not in table + study, "what an upload is called on the server appears nowhere"
        command, written = COMMANDS[tab, name]
        verb, *flags = command.split()
        folder = tmp_path / f"{question}-{verb}"
        if (verb, question) not in done:
            done[verb, question] = folder
            if study[:2] == b"PK":
                files = {"star.ecsv", "study.toml"} | ({"added.ecsv"} if verb == "change" else set())
                assert {path.name for path in extracted(study, folder).iterdir()} == files
            else:
                folder.mkdir()
                (folder / "study.toml").write_bytes(study)
            run(verb, "study.toml", *flags, "--no-pictures", "-q", "-o", "out", folder=folder)
        assert (folder / "out" / f"{written}.ecsv").read_bytes() == table, name
    # The added light is that of its file in nm, in the band B.
    folder = done["change", "change"]
    added = Source.read(folder / "added.ecsv")
    np.testing.assert_allclose([added.wavelength_nm, added.flux_flam], [nm, flux], rtol=1e-9)
    assert Study.read(folder / "study.toml").change.band == "B"
    assert list(Table.read(folder / "out" / "change.ecsv")["change"]) == ["Mg II", "spectrum"]
    # From another folder the table finds its star again, and no other file of that name.
    folder = done["detect", "detection"]
    again = Study.read(folder / "out" / "detection.ecsv")
    assert again.star[0].file == (folder / "star.ecsv").resolve()
    (folder / "star.ecsv").write_bytes(star_file())
    with refused("file", "star.ecsv"):
        Study.read(folder / "out" / "detection.ecsv")


@pytest.mark.long
@pytest.mark.parametrize("tab", [name for name in SHOWN if name not in ("analyse", "calibrate", "measure", "periods")])
def test_printed_commands_give_the_numbers_of_the_page(tab: str, tmp_path: Path) -> None:
    """Run the command of a random question for each tab; `tools/check_commands.py` runs twenty.

    This detects a page and a command line that compute something else from the same question; answers with files of the
    visitor's, fits and periods, which are slow, are compared in other tests.
    """
    generator = np.random.default_rng([3, len(tab)])
    asked = check_commands.possible_question(generator, check_commands.TABS[tab], tmp_path, quick=True)
    assert check_commands.differences(check_commands.TABS[tab], *asked, tmp_path) == []
    compared = {path.stem for path in tmp_path.glob("page-*.ecsv")}
    assert compared == {f"page-{name}" for of, name in COMMANDS if of == tab}


async def test_bibtex_cites_what_the_citation_file_cites(talk: Talk, server: Server) -> None:
    _, html = await server.got()
    (text,) = re.findall(r"@software.*?@article.*?\n}", html.replace("&#34;", '"'), re.DOTALL)
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert text.count("{") == text.count("}")
    for entry in (cited, *cited["references"]):
        assert f"title = {{{entry['title']}}}" in text
        assert all(one.get("family-names", one.get("name")) in text for one in entry["authors"])
    assert f"version = {{{cited['version']}}}" in text
    paper = cited["references"][0]
    for value in (paper["journal"], str(paper["year"]), paper["url"], str(cited["date-released"])[:4]):
        assert f"{{{value}}}" in text


async def taken(talk: Talk, asked: str, tab: str, folder: Path) -> str:
    """Extract the study of a tab's first question, and return its printed command."""
    question, printed = next(iter((await talk.exported(asked, tab)).items()))
    _, content = await talk.file(link=asked, tab="", name=question, ending="study")
    extracted(content, folder)
    return printed["command"]


@pytest.mark.long
async def test_own_files_answer_as_on_the_command_line(talk: Talk, tmp_path: Path) -> None:
    """A star with a neighbour, a flare as bright as observed, in Angstrom, and an unknown; both numbers, bit by bit.

    The page's simulation, the study that it gives, and a command that reads the files itself have the same draws.
    """
    units = {"flare_wavelength_unit": "Angstrom", "flare_flux_unit": "erg s-1 cm-2 Angstrom-1"}
    table = 'designation,ra,dec,phot_g_mean_mag,bp_rp\n"Gaia DR3 1",150.0,60.0,9,2.1\n"Gaia DR3 2",150.0,60.003,8,0.8\n'
    observed = units | {"flare_file": FILE, "flare_quiescent": FILE, "continue_at_k": "9000", "as_observed": "yes"}
    entered = observed | {"star": "uploaded star", "own_unknown": "uploaded spectrum", "amplitude_percent": "77"}
    entered |= {"neighbours": table, "neighbours_of": "Gaia DR3 1", "realisations": "10000", "fap": "0.05"}
    asked = link(**entered)
    nm = np.linspace(300.0, 690.0, 800), np.linspace(290.0, 680.0, 500)
    contents = {
        "star": rows_of(np.arange(170, 1001), np.full(831, 1e-12)), "own_unknown": b"# nm DN\n200 1\n450 3.5\n700 1\n",
        "flare_file": rows_of(10 * nm[0], 1e-12 + 1e-13 * (350 / nm[0]) ** 2),
        "flare_quiescent": rows_of(10 * nm[1], np.full(500, 1e-12)),
    }  # fmt: skip
    for field, content in contents.items():
        await talk.upload(content, field, f"{field}.txt", asked)
        (tmp_path / f"{field}.txt").write_bytes(content)
    reported = (await talk.answer(asked))["answer"]
    assert "your own star" in reported["words"]
    assert any("ASSUMED" in text for text, _ in reported["notes"])
    assert {kind for _, kind in reported["notes"]} == {"info"}, "red is what changes the answer"
    # No flag holds a visitor's file: a study does, next to which the file lies.
    for tab in (tab for tab, shown in SHOWN.items() if "star" in shown):
        for one in (await talk.exported(asked, tab)).values():
            assert re.fullmatch(r"mauvecl \w+ study\.toml", one["command"])
            assert "'file': 'star.ecsv'" in one["python"]
    # Without the subtraction the flare is another one, and so it is with an amplitude.
    chances = [(await talk.chances(link(**observed | one)))[0]
               for one in ({}, {"flare_quiescent": ""}, {"as_observed": "no"})]  # fmt: skip
    assert min(abs(chances[0] - other) for other in chances[1:]) > 0.01
    await talk.simulate("detection", asked)
    numbers = (await talk.answer(asked))["answer"]["numbers"]
    _, roc = await talk.file(link=asked, tab="detection", name="roc", ending="fits")
    assert roc.startswith(b"SIMPLE")
    (tmp_path / "neighbours.csv").write_text(table)
    direct = "detect --star star.txt --magnitude 8.5 --neighbours neighbours.csv --neighbours-of 'Gaia DR3 1' "
    direct += "--flare-file flare_file.txt --flare-quiescent flare_quiescent.txt --as-observed --continue-at 9000 "
    direct += "--flare-wavelength-unit Angstrom --flare-flux-unit 'erg s-1 cm-2 Angstrom-1' --fap 0.05 -n 10000 "
    direct += "--set 'nuisances.own={own={points=[[200,1],[450,3.5],[700,1]]}}' --temperature 21 "
    direct += "--statistic chi2 --statistic chi2_element --statistic matched"
    for one, flag in zip(numbers, ("", " --ideal"), strict=True):
        folder = tmp_path / one["unknown"]
        command = await taken(talk, link(**entered, unknown=one["unknown"]), "detection", folder)
        given, own = answered(folder, command)["detection"], answered(tmp_path, f"{direct}{flag}")["detection"]
        same_numbers(given, own, "amplitude", "threshold", "probability")
        (row,) = (row for row in given if row["statistic"] == "matched")
        assert one["value"] == row["probability"]
        assert "of 10,000 simulated" in one["interval"]
    study = Study.read(folder / "study.toml")
    assert study.star[0].file == folder / "star.ecsv"
    assert round(study.star[0].near().stars[0].separation_arcsec, 3) == 10.8  # type: ignore[union-attr]
    (told,) = re.findall(r"a ([\d.]+) % flare", reported["words"])
    assert float(told) == pytest.approx(100 * study.flare.amplitudes[0], rel=1e-4)


async def refusal(talk: Talk, field: str, content: bytes, asked: str, tab: str) -> str:
    """Return why a file is refused, at once or with the answer that reads it."""
    why = (await talk.upload(content, field, "my ![star](http://x/y.png).txt")).get("lacks")
    if why is None:
        faults = await talk.faults(asked, tab)
        assert faults.keys() == {field}
        why = faults[field]
    assert says_what_is_accepted(why), why
    assert "\n" not in why
    assert "mauvecl-page" not in why
    return str(why)


@pytest.mark.long
async def test_unusable_spectra_leave_no_answer(talk: Talk, server: Server) -> None:
    """Whatever was there before; a message on a file names the fields of this file, and what they advise works.

    Files that unpack without end are refused early: processor time is the same on a busy machine.
    """
    angstrom = rows_of(np.arange(1700.0, 10_001.0, 10), np.full(831, 1e-12))
    asked = {"star": "uploaded star", "own_unknown": "uploaded spectrum"}
    for field, content, reported in UPLOADS["spectra"]:
        good = star_file() if field == "star" else PAIRS
        assert (await talk.upload(good, field))["entered"] == asked[field]
        assert "answer" in await talk.answer(link(**{field: asked[field]}))
        spent, memory = server.spent(readers=True), server.memory()
        assert reported in await refusal(talk, field, made(content), "", "detection")
        # 3 s of it are the start of Python.
        assert server.spent(readers=True) - spent < 10.0
        assert server.memory() - memory < 100.0
        faults = await talk.faults(link(**{field: asked[field]}))
        assert "its file again" in faults[field], content
        refused = await talk.ask("file", "refused", link=link(**{field: asked[field]}), tab="spectrum",
                                 name="observation", ending="ecsv")  # fmt: skip
        assert says_what_is_accepted(refused["refused"])
    assert "entered" in await talk.upload(gzip.compress(star_file()), name="a.exe"), "its content shows what it is"
    for field, option in (
        ("star", "wavelength_unit"), ("flare_file", "flare_wavelength_unit"),
        ("flare_quiescent", "flare_wavelength_unit"), ("change_file", "change_wavelength_unit"),
    ):  # fmt: skip
        told = await talk.upload(angstrom, field)
        assert told["remedies"] == [[option, "Angstrom"]], told
        assert "nit of wavelengths Angstrom" in told["lacks"]
        assert "entered" in await talk.upload(angstrom, field, link=link(**{option: "Angstrom"}))
    # One file as the flare and as the star without it: nothing is left, continued by a blackbody or not.
    nm = np.arange(170.0, 1001.0)
    units = {"flare_wavelength_unit": "nm", "flare_flux_unit": "erg s-1 cm-2 Angstrom-1"}
    for continued in ("", "9000"):
        same = link(flare_file=FILE, flare_quiescent=FILE, continue_at_k=continued, **units)
        for field in ("flare_file", "flare_quiescent"):
            await talk.upload(rows_of(nm, 1e-12 * (1 + 0.1 * np.sin(nm))), field, "same.txt", same)
        for tab in ("detection", "measure"):
            reported = await talk.answer(same, tab)
            assert "answer" not in reported
            assert "must be brighter than uploaded star without the flare" in reported["faults"]["flare_quiescent"]


MAPPING = b'time = "minute"\ntime_unit = "min"\nflux = "rate"\nerror = "sd"\n'
OWN = {"frames": FILE, "mapping": FILE, "false_alarms": "1", "per": "day"}


def light_curve(*, flags: bool = False) -> bytes:
    """Return a CSV file of 200 frames with a flare of 20 standard deviations, and three flags if they are wanted."""
    time = np.arange(200) / 6
    flux = 100 + np.random.default_rng(29).normal(size=200) + 20 * np.exp(-(((time - 15) / 0.8) ** 2))
    flag = {50: 1, 60: 2, 70: 4}
    rows = [f"{t},{y},1" + f",{flag.get(k, 0)}" * flags for k, (t, y) in enumerate(zip(time, flux, strict=True))]
    return "\n".join(["minute,rate,sd" + ",flag" * flags, *rows, ""]).encode()


async def given_frames(talk: Talk, frames: bytes, mapping: bytes, name: str = "my curve.csv") -> None:
    assert (await talk.upload(frames, "frames", name))["entered"] == FILE
    assert (await talk.upload(mapping, "mapping", "curve.toml"))["entered"] == FILE


@pytest.mark.long
async def test_uploaded_frames_are_analysed_as_on_the_command_line(talk: Talk, server: Server, tmp_path: Path) -> None:
    await given_frames(talk, light_curve(), MAPPING)
    assert (await talk.simulate("analyse", link(**OWN))).startswith("Done")
    drawn = await talk.answer(link(**OWN), "analyse")
    assert "1 detected" in drawn["pictures"]["frames"]["text"]
    assert "A light curve has no spectra." in drawn["pictures"]["dynamic"]["text"]
    offered = {one.split()[1] for one in drawn["answer"]["files"] if one.startswith("analyse ")}
    tables = {name: await talk.table(link(**OWN), "analyse", name) for name in offered - {"analyse.html"}}
    _, report = await talk.file(link=link(**OWN), tab="analyse", name="analyse.html", ending="")
    assert b"<!doctype html>" in report
    assert b"mauvecl-page" not in report
    assert "measured" not in tables, "of spectra alone"
    assert await talk.ask("file", "refused", link=link(**OWN), tab="analyse", name="measured", ending="ecsv")
    command = await taken(talk, link(**OWN), "analyse", tmp_path)
    assert re.fullmatch(r"mauvecl analyse my_curve\.csv (?=.*--mapping curve\.toml).*--alarms-per day.*", command)
    assert Study.read(tmp_path / "study.toml").data.file == tmp_path / "my_curve.csv"
    for words in (command, "analyse study.toml"):
        found = answered(tmp_path, words)
        for name, table in tables.items():
            same_numbers(found[name], table)


@pytest.mark.long
async def test_quality_bits_are_chosen_as_on_the_command_line_and_names_of_files_are_plain(
    talk: Talk, tmp_path: Path
) -> None:
    """Three frames with the flags 1, 2 and 4; a file is read again for other bits, whatever its name."""
    for number, (name, bits, left_out) in enumerate((
        ("../../etc/passwd", "", 3), ("C:\\Users\\me\\passwd", "none", 0), ("", "all", 3), ("..", "4", 1),
        ("a\nb;$(x) ü.csv", "1,2", 2), ("-rf", "", 3), ("x" * 300, "", 3),
    )):  # fmt: skip
        await given_frames(talk, light_curve(flags=True), MAPPING + b'quality = "flag"\n', name)
        asked, folder = link(**OWN, quality_bits=bits), tmp_path / str(number)
        assert len(column(await talk.answer(asked, "analyse"), "frames", "left out", "x")) == left_out
        assert (f"--quality-bits {bits}" in await taken(talk, asked, "analyse", folder)) == bool(bits)
        (kept,) = {path.name for path in folder.iterdir()} - {"study.toml", "curve.toml"}
        assert re.fullmatch(r"[A-Za-z0-9_+][A-Za-z0-9._+-]{0,79}", kept)
        assert (folder / kept).read_bytes() == light_curve(flags=True)
    told = await talk.answer(link(**OWN, quality_bits="NoSuchBit"), "analyse")
    assert "NoSuchBit" in str(told["faults"]) + str(told.get("refused"))
    assert "at most 16 MiB" in (await talk.upload(bytes(2**24 + 1), "frames", "large"))["lacks"]


@pytest.mark.parametrize("number", long_but(range(len(UPLOADS["frames"])), 0))
async def test_unusable_frames_end_in_a_sentence(talk: Talk, number: int) -> None:
    *contents, words = UPLOADS["frames"][number]
    frames, mapping = map(made, contents)
    if mapping is not None:
        await talk.upload(mapping, "mapping", "curve.toml")
    asked = link(**OWN | {"mapping": FILE if mapping else ""})
    assert words in await refusal(talk, "frames", frames, asked, "analyse")
    columns = (await talk.ask("columns", "columns"))["columns"]
    named = [] if frames.startswith(b"\x89") else frames.partition(b"\n")[0].decode().split(",")
    assert columns == named, "for menus"


#: The star of the file is half a magnitude fainter in it than it was observed.
STUDY = (DATA / "standards.toml").read_bytes()
STANDARDS = link(observations=FILE)


def standards() -> dict[str, bytes]:
    """Return the files of observations of a star and of no light, by name."""
    star = Source.from_library("B3V").at_magnitude(5.0)
    files = {
        "standards.toml": STUDY, "frames.toml": (INPUTS / "raw.toml").read_bytes(),
        "b3v.txt": rows_of(star.wavelength_nm, star.flux_flam),
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        for name, drawn in {"b3v.fits": (1, "B3V", 4.5, (17.0,)), "dark.fits": FRAMES["dark.fits"]}.items():
            frames(Path(folder) / name, *drawn)
            files[name] = (Path(folder) / name).read_bytes()
    return files


def zipped(contents: dict[str, bytes], packing: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", packing) as archive:
        for name, one in contents.items():
            archive.writestr(name, one)
    return out.getvalue()


@pytest.mark.long
async def test_uploaded_standards_are_fitted_as_on_the_command_line(talk: Talk, tmp_path: Path) -> None:
    contents = standards()
    hidden = {"__MACOSX/._standards.toml": b"\x00", ".DS_Store": b"1", "nights/.DS_Store": b"2"}
    await talk.upload(zipped(contents | hidden), "observations", "standards.zip")
    assert (await talk.simulate("calibrate", STANDARDS)).startswith("Done")
    drawn = await talk.answer(STANDARDS, "calibrate")
    told = {name: one["text"] for name, one in drawn["pictures"].items()}
    assert "b3v" in told["residuals"].lower()
    assert "times the nominal one" in told["throughput"]
    assert "DN per electron" in told["transfer"]
    assert drawn["rows"][1][0] == "dark current"
    printed = (await talk.exported(STANDARDS, "calibrate"))["calibrate"]
    assert "mauvecl-page" not in printed["command"] + printed["python"]
    page = await talk.table(STANDARDS, "calibrate", "calibrate")
    study, instrument = [
        (await talk.file(link=STANDARDS, tab="calibrate", name=name, ending=ending))[1]
        for name, ending in (("calibrate", "study"), ("instrument.zip", ""))
    ]
    assert "mauvecl-page" not in (extracted(study, tmp_path / "again") / "study.toml").read_text()
    here = tmp_path / "here"
    (here / "nights").mkdir(parents=True)
    for name, content in contents.items():
        (here / ("nights" if name == "b3v.fits" else "") / name).write_bytes(content)
    for folder, words in ((here, "standards.toml --instrument mauve"), (tmp_path / "again", "study.toml")):
        same_numbers(answered(folder, f"calibrate {words}")["calibrate"], page, rtol=0)
    # The archive is an instrument like the shipped ones, and that of the command line.
    shipped = Instrument.load(extracted(instrument, tmp_path / "instrument") / "instrument.toml")
    (own,) = here.glob("out-*/**/instrument.toml")
    nm = np.array([300.0, 500.0])
    np.testing.assert_allclose(shipped.throughput(nm), Instrument.load(own).throughput(nm), rtol=1e-12)


@pytest.mark.long
async def test_missing_broken_and_unbounded_archives_are_refused(talk: Talk, server: Server) -> None:
    contents = standards()
    for name, content, value in UPLOADS["archived"]:
        chosen = {name: one for name, one in (contents | {name: made(content)}).items() if one is not None}
        assert value in await refusal(talk, "observations", zipped(chosen), STANDARDS, "calibrate")
    memory = server.memory()
    for content in UPLOADS["archives"].values():
        await refusal(talk, "observations", made(content), STANDARDS, "calibrate")
        assert "its file again" in (await talk.faults(STANDARDS, "calibrate"))["observations"]
    assert server.memory() - memory < 30.0
