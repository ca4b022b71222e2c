"""Spectrum files on the command line and in studies; the first lines of an answer state assumptions."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from refusals import refused
from typer.testing import CliRunner

from mauvecl.cli.app import app
from mauvecl.schema.errors import InputError
from mauvecl.study.study import Study

FILES = Path(__file__).parents[1] / "data" / "spectra"


def simulated(folder: Path, *flags: str) -> str:
    flags = ("simulate", *flags, "--exposure", "5", "--no-pictures", "-o", str(folder / "out"))
    done = CliRunner().invoke(app, flags)
    assert done.exit_code == 0, done.output
    return " ".join(done.output.split())


def test_assumptions_about_a_spectrum_come_first(tmp_path: Path) -> None:
    reported = simulated(
        tmp_path, "--star", str(FILES / "10lac_stis_001.txt"), "--wavelength-unit", "Angstrom", "-m", "8"
    )
    assert reported.index("ASSUMED: flux in erg") < reported.index("10lac_stis_001 V = 8")
    record = json.loads(next((tmp_path / "out").glob("*.json")).read_text())
    assert "ASSUMED: flux in erg" in json.dumps(record)
    # The study that was written reads the same star again.
    again = Study.read(tmp_path / "out" / "study.toml")
    assert (again.star[0].wavelength_unit, again.star[0].magnitude) == ("Angstrom", 8.0)


@pytest.mark.long
def test_star_is_extended_and_binned(tmp_path: Path) -> None:
    flags = ("--star", str(FILES / "vb8_stiswfcnic_004.fits"), "--extend", "M3V", "--bin-nm", "2", "-m", "9")
    reported = simulated(tmp_path, *flags)
    assert "continued by M3V" in reported
    assert "113 of its 1349 points" in reported
    reported = simulated(tmp_path, "--star", f"{FILES / 'ckp00_5750.fits'}[g45]", "-m", "8")
    assert "ckp00_5750" in reported


def test_keys_of_files_need_stars_from_files(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["simulate", "--star", "G2V", "--extend", "K5V", "-o", str(tmp_path)])
    assert isinstance(done.exception, InputError)
    assert "--extend without a spectrum file among the stars" in str(done.exception)
    with refused("star.0.extend"):
        Study.build({"star": [{"library": "G2V", "extend": "K5V"}]}, "test")
    study = Study.build({"star": [{"file": "x.txt", "extend": "K5V", "flux_unit": "Jy"}]}, "test")
    star = study.at("star", "G2V").star[0]
    assert (star.library, star.file, star.extend, star.flux_unit) == ("G2V", None, None, None)
