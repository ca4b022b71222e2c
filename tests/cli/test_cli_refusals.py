"""Mistakes on the command line: one sentence that names the flag and what is accepted, and exit code 2."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from commands import ended

STAR = ("--star", "G2V", "-m", "7")
FLARE = ("detect", "--star", "M3V", "-m", "9", "-a", "0.05")
#: Words of a command, and what its sentence contains: first the flag or what the sentence is about.
ROWS: list[tuple[tuple[str, ...], *tuple[str, ...]]] = [
    (("detetc",), "detetc"),
    (("export",), "Missing argument"),
    (("detect", "--nonsense"), "nonsense"),
    # Values of flags, in every way to write them
    (("detect", "--fap", "2"), "--fap 2.0, expected"),
    (("detect", "--fap=2"), "--fap 2.0, expected"),
    (("detect", "-m99"), "--magnitude 99.0, expected"),
    (("detect", "-a", "-3"), "--amplitude -3.0, expected"),
    (("detect", "-n", "many"), "--realisations 'many', expected a whole number"),
    (("detect", "-n", "0"), "--realisations 0"),
    (("detect", "--exposure", "-5"), "--exposure -5.0, expected"),
    (("detect", "--flare-temperature", "5"), "--flare-temperature 5.0, expected 1000 to 200000 K"),
    (("detect", "--photosphere-temperature", "2", "--geometry", "replaces"), "--photosphere-temperature 2.0, expected"),
    (("detect", "--geometry", "sideways"), "--geometry 'sideways', expected 'added' or 'replaces'"),
    (("detect", "--tails", "guessed"), "--tails 'guessed', expected 'counted' or 'sampled'"),
    (("detect", "--statistic", "chi2,chi3"), "--statistic 'chi3', expected one of "),
    (("detect", "--reference", "stack"), "--reference 'stack', expected 'template', 'exposure' or"),
    (("detect", "--variances", "guessed"), "--variances 'guessed'"),
    (("detect", "--cluster", "x"), "--cluster 'x', expected"),
    (("detect", "--temperature", "900"), "--temperature 900.0, expected"),
    (("detect", "--set", "x"), "--set 'x', expected key=value"),
    (("snr", "--sweep", "magnitude=a"), "--sweep 'magnitude=a'"),
    (("serve", "--port", "99999"), "--port '99999', expected 1 to 65535"),
    (("simulate", "--realisation", str(2**64)), "--realisation"),
    (("stare", *STAR, "--distance", "-5"), "--distance -5.0, expected"),
    (("stare", "--gap", "10"), "--gap '10', expected two times in s"),
    (("visible", "--look-at", "Vega", "--sun", "wide"), "--sun 'wide', expected 0 to 180 deg, or none"),
    (("visible", "--look-at", "Vega", "--declination", "3"), "--declination '3', expected low:high"),
    *[
        (("map", "--x", axis), f"--x '{axis}'")
        for axis in ("magnitude:6:9", "magnitude:a:b:3", "magnitude=a", "magnitude:6:9:3:cubic")
    ],
    # Flares
    ((*FLARE, "--line", "Mg II"), "--line"),
    ((*FLARE, "--line", "Mg II=x"), "--line", "expected a number"),
    ((*FLARE, "--balmer-jump", "0.2"), "--balmer-jump 0.2"),
    ((*FLARE, "--second-area", "0.2"), "second_temperature_k"),
    ((*FLARE, "--flare-file", "missing.txt"), "missing.txt"),
    # Names
    (("detect", "--star", "G3V"), "'G3V' has no spectrum", "--star G2V"),
    (("detect", "--star", "G2V,M3V,", "-m", "7"), "star '' is unknown"),
    (("detect", "--star", "no.txt"), "'no.txt' does not exist"),
    (("detect", "--instrument", "hubble"), "hubble"),
    (("detect", "--instrument", "."), "instrument '.' is a folder, expected a name or a TOML file"),
    (("detect", "--device", "abacus"), "'abacus' is not here, expected one of"),
    (("detect", "no.toml"), "'no.toml' does not exist"),
    (("visible", "--look-at", "Vega", "--tle", "none.tle"), "orbit file 'none.tle' does not exist"),
    (("plan", "missing.csv"), "table of targets 'missing.csv' does not exist"),
    (("detect", "-o", "/proc/nothing"), "cannot be written"),
    (("detect", "--output", __file__, "-n", "1e5"), "is a file, expected the name of a folder"),
    # What is missing, and what contradicts
    (("detect", "--target", "290 11"), "only one of target and time"),
    (("detect", "-m", "1", "-m", "2", "-m", "3"), "3 magnitudes for 2 stars"),
    (("detect", "--star", "G2V", "--fap", "1e-6", "-n", "1000"), "ask for 100000000 realisations"),
    (("stare", "--energy", "1e33", "--amplitude", "0.1"), "--energy is given together with --amplitude"),
    (("limit", "--known", "light_loss,luck"), "unknowns.known names 'luck', expected some of "),
    (("exposure", *STAR), "no wanted S/N, expected --snr and --at"),
    (("exposure", *STAR, "--snr", "10", "--at", "900"), "wavelength = 900.0 nm"),
    (("snr", *STAR, "--at", "30"), "wavelength = 30.0 nm, expected 200.1 to 699.8 nm"),
    (("visible",), "no targets, expected names or coordinates, such as --look-at 'eps Eri'"),
    (("plan",), "the plan has no targets, expected some, such as --targets targets.csv"),
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: " ".join(row[0])[:60])
def test_bad_input_exits_with_code_2(row: tuple[tuple[str, ...], *tuple[str, ...]], tmp_path: Path) -> None:
    words, *facts = row
    code, out, reported = ended(*words, folder=tmp_path)
    assert (code, out, reported.count("\n")) == (2, "", 1), reported
    assert reported.startswith("mauvecl: ")
    assert "`" not in reported
    assert all(fact in reported for fact in facts), reported
    assert re.search(r"expected|Missing|No such|does not|cannot|is unknown|only one|\d magnitudes for", reported), (
        reported
    )


def test_study_file_keeps_its_keys(tmp_path: Path) -> None:
    """A value of a file is named by its key, not by a flag."""
    (tmp_path / "s.toml").write_text("[run]\nfap = 2\n")
    code, _, reported = ended("detect", "s.toml", "--seed", "3", folder=tmp_path)
    assert (code, reported) == (2, "mauvecl: s.toml: run.fap = 2, expected a number above 0 and below 1\n")
    (tmp_path / "s.toml").write_text("[run]\nsead = 3")
    code, _, reported = ended("detect", "s.toml", folder=tmp_path)
    assert (code, reported.count("\n")) == (2, 1)
    assert "'run.sead', did you mean 'seed'?" in reported
