"""The great flare of AD Leo (1985) seen by Mauve: fits of a blackbody, of a Balmer jump, and of the optical alone.

By the command line, which takes the flare for as bright as it was observed; in Python by `test_measurements.py`.

The spectra end at 444 nm, beyond which a blackbody of 9500 K continues the flare and a library spectrum the star;
322-368 nm hold the seam of two instruments, a straight line over a gap, and blended Balmer lines, and are left out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from commands import run

from mauvecl import FlareModel, Instrument, Source, expect, fit

DATA = Path(__file__).parent.parent / "data"
OBSERVED = DATA / "spectra" / "ADLeo_912s.dat"
QUIET = DATA / "flares" / "adleo_quiescent2.dat"


def ad_leo_words() -> tuple[str | Path, ...]:
    """Return the command for the flare as it was observed, at the star's own brightness."""
    star = ("--star", QUIET, "--wavelength-unit", "Angstrom", "--extend", "M3V")
    flare = ("--flare-file", OBSERVED, "--flare-quiescent", QUIET, "--flare-wavelength-unit", "Angstrom")
    return ("measure", *star, *flare, "--continue-at", "9500", "--as-observed", "--no-pictures", "-o", "out")


@pytest.mark.long
def test_command_line_measures_the_flare(tmp_path: Path) -> None:
    """Measure 200 exposures of 50 s; 1 % of good fits have p < 0.01, more than 40 % of them once in 1e40.

    The spectra of `fit` are added on another grid, so that intervals agree to a few percent of an error.
    """
    words = (*ad_leo_words(), "--fits", "200")
    run(*words, "--model", "blackbody", "--model", "balmer", "--skip", "322:368", folder=tmp_path)
    fits, table = (Table.read(tmp_path / "out" / f"{name}.ecsv") for name in ("fits", "measure"))
    rejected = dict(zip(fits["model"], fits["rejected"], strict=True))
    assert rejected["blackbody"] > 0.8
    assert rejected["balmer"] < 0.5 * rejected["blackbody"]
    (jump,) = (row for row in table if row["quantity"] == "jump")
    assert [jump["low_95"], jump["perfect"], jump["high_95"]] == pytest.approx([1.53, 1.68, 1.84], abs=0.05)
    run(*words, "--model", "blackbody", "--skip", "200:400", "--restart", folder=tmp_path)
    table = Table.read(tmp_path / "out" / "measure.ecsv")
    (optical,) = (row for row in table if row["quantity"] == "temperature")
    assert optical["low_68"] - 100 < 9500.0 < optical["high_68"]
    assert 8500 < optical["low_95"] < 9500.0 < optical["high_95"] < 10_700
    # The flux of the file, integrated here.
    nm, flaring = np.loadtxt(OBSERVED, unpack=True, skiprows=2)[:2]
    quiet_nm, quiet = np.loadtxt(QUIET, unpack=True, skiprows=2)[:2]
    grid = np.linspace(2000.0, 3200.0, 20_001)
    added = np.interp(grid, nm, flaring) - np.interp(grid, quiet_nm, quiet)
    (flux,) = (row for row in table if row["quantity"] == "flux 200-320 nm")
    assert flux["truth"] == pytest.approx(np.trapezoid(added, grid), rel=0.01)


def test_skipped_pixels_are_ignored() -> None:
    star, mauve = Source.from_library("M3V").at_magnitude(9), Instrument.load("mauve")
    quiet, lit = (expect(s, mauve, exposure=50.0) for s in (star, star.flaring(0.5, 9000.0)))
    model, nm = FlareModel.of(star, mauve, quiet), quiet.wavelength_nm
    spoiled = np.where((nm >= 300) & (nm <= 350), 0.0, lit.recorded_dn)
    found = fit(spoiled, quiet, model, skipped_nm=((300, 350),))
    assert found.estimates[0, 0] == pytest.approx(9000.0, rel=1e-3)
    assert found.dof == int(((nm < 300) | (nm > 350)).sum()) - 2
