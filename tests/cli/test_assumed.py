"""Every verb that answers a study says in one line what it assumed."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from commands import run
from marks import long_but
from typer.main import get_command

from mauvecl.cli.app import app
from mauvecl.host.expectation import expect
from mauvecl.host.stars.source import Source
from mauvecl.study.assumptions import Use, assumption_line
from mauvecl.study.study import Study

USUAL = "instrument mauve, detector at 21 deg C; sky of V = 22.1 mag/arcsec2; "
FLARE = "flares of 10000 K, added to the star, amplitudes in the Kepler band; "
REST = "everything known; seed 1"
FEW = "--star G2V -m 7.4 -n 10000 --fap 0.01"
#: What is asked, and what its line holds.
ASKED = {
    "simulate": ("--star G2V -m 7.4", USUAL + REST),
    "snr": ("--star G2V -m 7.4 -n 1000", USUAL + REST),
    "exposure": ("--star G2V -m 7.4 --snr 10 --at 300", USUAL[:-2]),
    "detect": (f"{FEW} -a 0.24", USUAL + FLARE + REST),
    "limit": (f"{FEW} -a 0.24", USUAL + FLARE + REST),
    "map": (f"{FEW} --x magnitude=7,8 --y amplitude=0.1,0.2", USUAL + FLARE + REST),
    "gaussian": (f"{FEW} --sweep exposure=5,50", USUAL + FLARE + REST),
    "stare": ("--star G2V -m 7.4 --duration 600", USUAL + FLARE + REST),
    "inject": ("--star M3V -m 9 --duration 600 -n 20 --set injections.sizes=2 --set injections.widths=2",
               USUAL + FLARE + REST),
    "visible": ("--look-at 'eps Eri' --days 3",
                "orbit of embedded elements; least angles: Earth's limb 25 deg, Sun 46 deg, Moon 25 deg"),
    "plan": ("targets.csv --days 3 --completeness 'closed form' --report html",
             "instrument mauve, detector at 21 deg C; " + FLARE + "orbit of embedded elements; "
             "least angles: Earth's limb 25 deg, Sun 46 deg, Moon 25 deg; " + REST),
    "analyse": ("frames.csv --mapping mapping.toml", "flares of the shape davenport2014; noise as measured; seed 1"),
    "calibrate": ("standards.toml", USUAL[:-2]),
    "measure": ("--star G2V -m 7.4 --set measure.fits=100", USUAL + FLARE + REST),
    "realise": ("--star G2V -m 7.4 -n 10 --output r.zarr", USUAL + FLARE + REST),
}  # fmt: skip


def verbs() -> list[str]:
    """Return the verbs that take a study."""
    commands: Any = get_command(app)
    return [name for name, one in commands.commands.items() if any(p.name == "study_file" for p in one.params)]


def write_standards(folder: Path) -> None:
    """Write a study with frames of one standard star."""
    x = expect(Source.from_library("A0V").at_magnitude(6.0), "mauve", exposure=5.0)
    raw = np.random.default_rng(1).poisson(x.mean_raw_dn, (20, x.wavelength_nm.size)).astype(float)
    times = fits.BinTableHDU(Table({"TIME": 5.0 * np.arange(20)}), name="FRAMES")
    images = [fits.ImageHDU(raw, name="RAW"), fits.ImageHDU(x.wavelength_nm, name="NM")]
    fits.HDUList([fits.PrimaryHDU(), times, *images]).writeto(folder / "a0v.fits")
    (folder / "frames.toml").write_text(
        'hdu = "FRAMES"\ntime = "TIME"\ntime_unit = "s"\nflux = "RAW"\nflux_unit = "DN"\nwavelength = "NM"\n'
        'wavelength_unit = "nm"\n'
    )
    (folder / "standards.toml").write_text(
        '[[calibrate.observations]]\nframes = "a0v.fits"\nmapping = "frames.toml"\nlibrary = "A0V"\n'
        "magnitude = 6.0\ntemperature_c = 21.0\n"
    )


@pytest.mark.parametrize("verb", long_but(verbs(), "simulate", "exposure", "detect", "visible"))
def test_every_verb_prints_its_assumptions(verb: str, tmp_path: Path) -> None:
    flags, expected = ASKED[verb]
    (tmp_path / "targets.csv").write_text("name\neps Eri\n")
    light = np.random.default_rng(1).normal(100, 1, 200)
    (tmp_path / "frames.csv").write_text("t,f\n" + "".join(f"{600 * k},{f:.3f}\n" for k, f in enumerate(light)))
    (tmp_path / "mapping.toml").write_text('time = "t"\ntime_unit = "s"\nflux = "f"\n')
    if verb == "calibrate":
        write_standards(tmp_path)
    pictures = () if verb == "realise" else ("--no-pictures",)
    words = (verb, *shlex.split(flags), *pictures)
    lines = run(*words, folder=tmp_path).stdout.splitlines()
    assert [line for line in lines if line.startswith("Assumed: ")] == [f"Assumed: {expected}."]
    if verb in ("exposure", "realise"):
        again = ("--restart",) if verb == "realise" else ()
        assert json.loads(run(*words, "--json", *again, folder=tmp_path).stdout)["assumed"] == f"Assumed: {expected}."


ALL = get_args(Use)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("observation.instrument=mauve-electrons", "instrument mauve-electrons"),
        ("observation.temperature_c=13", "detector at 13 deg C"),
        ("observation.changes={light_loss=0.2}", "with another light_loss"),
        ("sky={surface_brightness=20.5}", "sky of V = 20.5 mag/arcsec2"),
        ("sky={none=true}", "no sky"),
        ("sky={target='53.2 -9.5', time='2027-01-01'}", "sky at 53.2 -9.5, 2027-01-01 UTC"),
        ("flare.temperature_k=9000", "flares of 9000 K"),
        ("flare.band=TESS", "amplitudes in the TESS band"),
        ("flare.geometry=replaces", "replacing photosphere"),
        ("run.seed=7", "seed 7"),
        ("nuisances.usual=true", "the usual unknowns drawn and marginalised"),
        ("nuisances.dark=0.1", "marginalised: dark"),
        ("processes.jitter.uniform=[0,0.05]", "drawn: jitter"),
        ("stare.thermal.amplitude=0.5", "drawn: thermal"),
        ("stare.jitters={light=0.01}", "drawn: jitters of light"),
        ("unknowns.draws=4", "4 draws of the instrument's unknowns"),
        ("sweep.axes=[{quantity='sky', values=[20, 21]}]", "sky as swept"),
        ("sweep.axes=[{quantity='detector_temperature', values=[13, 21]}]", "detector temperature as swept"),
        ("sweep.axes=[{quantity='flare_temperature', values=[9000, 8000]}]", "flares of swept temperature"),
        ("orbit.limits.sun_deg=50", "Sun 50 deg"),
    ],
)
def test_assumptions_follow_the_study(setting: str, words: str) -> None:
    usual, changed = assumption_line(Study(), ALL), assumption_line(Study().with_settings([setting]), ALL)
    assert words in changed
    assert words not in usual
    assert "\n" not in changed


def test_every_verb_is_tested() -> None:
    assert sorted(verbs()) == sorted(ASKED)
