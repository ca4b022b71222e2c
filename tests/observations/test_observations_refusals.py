"""Invalid frames and questions about them raise an InputError that names the key."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import QTable
from corpus import CORPUS, mapping_of, written
from corpus import cases as files
from refusals import refused

from mauvecl import Study, calibrate, change
from mauvecl.answers.observations.neighbour_flares import blended_stars
from mauvecl.host.orbit.targets import Target
from mauvecl.host.orbit.visibility import Windows
from mauvecl.observations.barycentre import barycentric
from mauvecl.observations.changes.periods import visit_times_d
from mauvecl.observations.frames import Frames
from mauvecl.observations.line_index import MG_II_CONTINUUM_NM, MG_II_NM, line_index
from mauvecl.observations.mapping import FrameMapping
from mauvecl.observations.reading import frames_of, reduce_frames
from mauvecl.study.cases import cases

TIME = np.arange(100) * 20.0
FLUX = 1000 + np.random.default_rng(29).normal(0, 5, 100)
ERROR = np.full(100, 5.0)
NM = np.linspace(270.0, 290.0, 201)
PLACED = {"reference_mjd": 61_000.0, "scale": "utc", "position": "GEOCENTER"}


def of_arrays(**changed: Any) -> object:
    return Frames.of(**({"time_s": TIME, "flux": FLUX, "error": ERROR} | changed))


def index(**changed: Any) -> object:
    given: dict[str, Any] = {"wavelength_nm": NM, "flux": np.ones(NM.size), "band_nm": MG_II_NM}
    return line_index(**(given | {"continuum_nm": MG_II_CONTINUUM_NM} | changed))


def at_the_sun(**changed: Any) -> object:
    return barycentric(Frames.of(TIME, FLUX, **(PLACED | changed)), Target("AU Mic", 311.2897, -31.3409, "given"))


def changes(*settings: str) -> object:
    return change(Study().with_settings(settings))


def visits(exposure_s: float) -> object:
    start = np.array([0.0, 5000.0])
    return visit_times_d(Windows(start, start + np.array([1000.0, 3000.0]), np.zeros(2)), 5, exposure_s, 1)


CALLS: dict[str, tuple[Callable[[], object], str]] = {
    "few frames": (lambda: of_arrays(time_s=TIME[:5], flux=FLUX[:5]), "frames"),
    "fewer times than frames": (lambda: of_arrays(time_s=TIME[:50]), "shape"),
    "a flux whose square is infinite": (lambda: of_arrays(flux=np.where(TIME == 40, -1e308, FLUX)), "flux"),
    "a time that is nan": (lambda: of_arrays(time_s=np.where(TIME == 40, np.nan, TIME)), "time"),
    "a time twice": (lambda: of_arrays(time_s=np.where(TIME == 40, 20.0, TIME)), "time"),
    "fewer errors than frames": (lambda: of_arrays(error=ERROR[:5]), "error"),
    "fewer flags than frames": (lambda: of_arrays(quality=np.zeros(3)), "quality"),
    "no exposure": (lambda: of_arrays(exposure_s=0.0), "exposure"),
    "errors of light for spectra": (lambda: of_arrays(flux=np.tile(FLUX[:, None], 3)), "error"),
    "spectra without wavelengths": (lambda: of_arrays(flux=np.tile(FLUX[:, None], 3), error=None), "wavelength"),
    "an array as container": (lambda: frames_of(FLUX), "container"),
    "a number as container": (lambda: frames_of(3), "container"),
    "no container": (lambda: frames_of(None), "container"),
    "a name as container": (lambda: frames_of("file.fits"), "container"),
    "a table without times": (lambda: frames_of(QTable({"a": [1.0]})), "mapping"),
    "index beyond its continuum": (lambda: index(band_nm=(278.0, 291.0)), "band_nm"),
    "continuum of a pixel": (lambda: index(continuum_nm=[(275.5, 275.65)]), "continuum_nm"),
    "descending wavelengths": (lambda: index(wavelength_nm=NM[::-1]), "wavelength_nm"),
    "a line that is nan": (lambda: index(flux=np.where(NM > 280, np.nan, 1.0)), "flux"),
    "another number of fluxes": (lambda: index(flux=np.ones(3)), "flux"),
    "another number of errors": (lambda: index(error=np.ones(3)), "error"),
    "times without an epoch": (lambda: at_the_sun(reference_mjd=None), "epoch"),
    "times without a scale": (lambda: at_the_sun(scale=""), "scale"),
    "times without a place": (lambda: at_the_sun(position=""), "position"),
    "times on Mars": (lambda: at_the_sun(position="MARS"), "position"),
    "a satellite without an orbit": (lambda: at_the_sun(position="TOPOCENTER"), "orbit.tle"),
    "change of nothing": (lambda: changes("change.of=['nothing']"), "change.of"),
    "change without a file": (lambda: changes("change.of=['spectrum']"), "change.file"),
    "change of a reversed band": (lambda: changes("change.of=['320-200']"), "change.of"),
    "periods without a target": (lambda: changes("change.periods=true", "change.visits=20"), "orbit.targets"),
    "reversed periods": (lambda: changes("change.shortest_d=40"), "change.longest_d"),
    "visits longer than windows": (lambda: visits(4000.0), "observation.exposure_s"),
    "calibration without a star": (lambda: calibrate(Study()), "calibrate.observations"),
    "neighbours of two stars": (lambda: blended_stars(cases(Study(), swept=False)), "star"),
}


@pytest.mark.parametrize("name", CALLS)
def test_bad_input_raises(name: str) -> None:
    call, key = CALLS[name]
    with refused(key):
        call()


def test_weights_of_other_pixels_are_refused(tmp_path: Path) -> None:
    name = "row per pixel, with units in the mapping Angstrom s csv"
    case = dict(files(CORPUS / "frames_of_spectra.toml"))[f"frames_of_spectra {name}"]
    with refused("weights"):
        reduce_frames(written(case, tmp_path), np.ones((1, 4)), FrameMapping.read(mapping_of(case, tmp_path)))
