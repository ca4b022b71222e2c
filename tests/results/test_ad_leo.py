"""The great flare of AD Leo (1985) seen by Mauve: fits of a blackbody, of a Balmer jump, and of the optical alone.

In Python, and by the command line, which takes the flare for as bright as it was observed.

The spectra end at 444 nm, beyond which a blackbody of 9500 K continues the flare and a library spectrum the star;
322-368 nm hold the seam of two instruments, a straight line over a gap, and blended Balmer lines, and are left out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from commands import run

from mauvecl import Engine, FlareModel, Instrument, ObservedFlare, Source, expect, fit

DATA = Path(__file__).parent.parent / "data"
FILES = {912: DATA / "spectra" / "ADLeo_912s.dat", 1497: DATA / "flares" / "ADLeo_1497s.dat"}
QUIET, GAP_NM = DATA / "flares" / "adleo_quiescent2.dat", (322.0, 368.0)


@pytest.mark.long
def test_blackbody_is_rejected_and_jump_is_measured(engine: Engine) -> None:
    """Fit 200 exposures of 50 s; 1 % of good fits have p < 0.01, more than 40 % of them once in 1e40."""
    star = Source.read(QUIET, wavelength_unit="Angstrom", extend="M3V")
    mauve = Instrument.load("mauve")
    quiet = expect(star, mauve, exposure=50.0)
    rejected, jumps = {}, {}
    for seconds, path in FILES.items():
        flare = ObservedFlare.read(path, QUIET, wavelength_unit="Angstrom", continue_at_k=9500.0)
        grid = flare.grid(star.wavelength_nm)
        light = np.interp(grid, star.wavelength_nm, star.flux_flam) + flare.flux(grid)
        lit = expect(Source(grid, light, "AD Leo", "test"), mauve, exposure=50.0)
        raw = engine.realise(lit, count=200, seed=1)
        plain, balmer = (FlareModel.of(star, mauve, quiet, jump=jump) for jump in (False, True))
        one, other = (fit(raw, quiet, model, skipped_nm=(GAP_NM,)) for model in (plain, balmer))
        rejected[seconds] = [float((found.p_value < 0.01).mean()) for found in (one, other)]
        best = fit(lit.recorded_dn, quiet, balmer, skipped_nm=(GAP_NM,))
        place = best.column("jump")
        jumps[seconds] = [float(x[place]) for x in (best.low[1, 0], best.estimates[0], best.high[1, 0])]
        assert np.median(one.estimates[:, 0]) > np.median(other.estimates[:, 0]) + 500
        optical = fit(lit.recorded_dn, quiet, plain, skipped_nm=((200.0, 400.0),))
        assert optical.low[1, 0, 0] < 9500.0 < optical.high[1, 0, 0]
    assert rejected[912][0] > 0.8
    assert rejected[912][1] < 0.5 * rejected[912][0]
    # The published spectrum has 1.41 between 361.5 and 417.0 nm, lines included.
    assert jumps[912][0] > 1.3
    assert jumps[912] == pytest.approx([1.53, 1.68, 1.84], abs=0.05)
    assert jumps[1497][0] < jumps[1497][1] < jumps[1497][2]


def ad_leo_words(seconds: int) -> tuple[str | Path, ...]:
    """Return the command for the flare as it was observed, at the star's own brightness."""
    star = ("--star", QUIET, "--wavelength-unit", "Angstrom", "--extend", "M3V")
    flare = ("--flare-file", FILES[seconds], "--flare-quiescent", QUIET, "--flare-wavelength-unit", "Angstrom")
    return ("measure", *star, *flare, "--continue-at", "9500", "--as-observed", "--no-pictures", "-o", "out")


@pytest.mark.long
def test_command_line_measures_the_flare(tmp_path: Path) -> None:
    """Measure 200 exposures of 50 s; 1 % of good fits have p < 0.01, more than 40 % of them once in 1e40.

    The spectra of `fit` are added on another grid, so that intervals agree to a few percent of an error.
    """
    words = (*ad_leo_words(912), "--fits", "200")
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
    nm, flaring = np.loadtxt(FILES[912], unpack=True, skiprows=2)[:2]
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
