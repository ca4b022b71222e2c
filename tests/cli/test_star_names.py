"""Stars in place of a study, and common names of stars."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from commands import ended, run
from refusals import refused
from typer.main import get_command

from mauvecl.cli.app import app
from mauvecl.host.orbit.targets import target_table
from mauvecl.study.sections import Star
from mauvecl.study.study import Study

#: The argument of `analyse` is a file of frames.
VERBS = [name for name, one in get_command(app).commands.items()  # type: ignore[attr-defined]
         if {"study_file", "star"} <= {p.name for p in one.params} and name != "analyse"]  # fmt: skip


def spectrum(folder: Path, name: str) -> str:
    nm = np.linspace(170.0, 1150.0, 800)
    flux = 1e-12 * np.exp(-(((nm - 560) / 250) ** 2))
    np.savetxt(folder / name, np.transpose([nm, flux]))
    return name


@pytest.mark.parametrize("verb", VERBS)
def test_star_is_accepted_in_place_of_the_study(verb: str, tmp_path: Path) -> None:
    """Give every verb a star with a wrong magnitude, which its message names."""
    for star in ("G2V,M3V", spectrum(tmp_path, "noname")):
        code, _, reported = ended(verb, star, "-m", "99", folder=tmp_path)
        assert (code, reported) == (2, "mauvecl: --magnitude 99.0, expected -30 to 40 mag\n"), star
    code, _, reported = ended(verb, "G2V", "--star", "M3V", "-m", "7", folder=tmp_path)
    assert (code, reported) == (2, "mauvecl: 'G2V' and --star are both stars, expected one of them\n")


def test_given_star_becomes_the_star_of_the_study(tmp_path: Path) -> None:
    name = spectrum(tmp_path, "star.txt")
    for given in ("G2V", name):
        run("exposure", given, "-m", "8", "--snr", "10", "--at", "300", "--no-pictures", folder=tmp_path)
        (star,) = Study.read(tmp_path / "mauvecl-exposure" / "study.toml").star
        assert (star.library or (star.file and star.file.name), star.magnitude) == (given, 8.0)
    # A study is still one, whatever it is called.
    (tmp_path / "mauvecl-exposure" / "study.toml").rename(tmp_path / "study")
    reported = run("exposure", "study", "--no-pictures", folder=tmp_path).stdout
    assert "star V = 8" in reported


def test_missing_study_is_reported(tmp_path: Path) -> None:
    for name in ("no.toml", "nothing", "G3V"):
        code, _, reported = ended("detect", name, folder=tmp_path)
        assert (code, f"study file {name!r} does not exist" in reported) == (2, True), reported


@pytest.mark.parametrize("name", ["AD Leo", "ad leo", "Proxima", "Proxima Cen", "EV Lac", "YZ CMi", "AU Mic", "GJ 388",
                                  "CN Leo", "TRAPPIST-1", "eps Eri", "Barnard's star"])  # fmt: skip
def test_well_known_stars_name_a_spectrum_and_a_magnitude(name: str) -> None:
    with refused("star", value=name) as caught:
        Star(library=name).source()
    found = re.search(r"`star='(\S+)'` with `magnitude=(\S+)`", str(caught.value))
    assert found, caught.value
    # The star that the error proposes exists.
    assert Star(library=found[1], magnitude=float(found[2])).source().name


def test_flags_are_proposed_for_a_well_known_star(tmp_path: Path) -> None:
    for words in (("--star", "AD Leo"), ("ad leo",)):
        code, _, reported = ended("simulate", *words, folder=tmp_path)
        assert code == 2
        found = re.search(r"(--star \S+) with (--magnitude \S+) ", reported)
        assert found, reported
    run("simulate", *shlex.split(f"{found[1]} {found[2]}"), "--no-pictures", folder=tmp_path)


def test_every_listed_star_is_proposed() -> None:
    for row in target_table():
        if str(row["name"]) in ("Vega", "HD 40307", "GJ 581", "GX And"):
            continue  # the library has them, of which GX And as GJ 15 A, its M1V
        with refused("star", value=str(row["name"])):
            Star(library=str(row["name"])).source()


def test_sun_needs_another_magnitude(tmp_path: Path) -> None:
    code, _, reported = ended("detect", "--star", "Sun", folder=tmp_path)
    assert code == 2
    assert "V = -26.76" in reported
    assert "--magnitude 7.4" in reported
