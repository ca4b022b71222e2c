"""Files of the kinds that archives and users have are read as they say, or refused in a sentence that helps.

What each file holds is in the `expected.toml` beside it, from how it was made or from a reading by another program.
"""

from __future__ import annotations

import lzma
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from refusals import refused

from mauvecl.host.neighbour_table import read_neighbours
from mauvecl.host.spectra.formats import read_spectrum
from mauvecl.host.stars.flare_table import read_flares
from mauvecl.host.stars.source import Source
from mauvecl.observations.frames import Frames, Reason
from mauvecl.observations.reading import read_frames
from mauvecl.study.orbits import PlanTarget, read_targets

DATA = Path(__file__).parent / "data"
Case = dict[str, Any]
CASES: list[tuple[Path, Case]] = [
    (DATA / folder, case)
    for folder in ("cases", "light_curves")
    for case in tomllib.loads((DATA / folder / "expected.toml").read_text(encoding="utf-8"))["case"]
]


def _frames(path: Path, case: Case) -> tuple[str, ...]:
    mapping = DATA / "cases" / case["mapping"] if "mapping" in case else None
    frames = read_frames(path, mapping, quality_bits=case.get("quality_bits"))
    assert frames.n_frames == case["frames"]
    assert case.get("dated", True) == (frames.reference_mjd is not None) or "mjd" not in case
    if "mjd" in case:
        assert frames.reference_mjd is not None
        # A millisecond and a half, as files with eight decimals of a day have.
        assert frames.reference_mjd + frames.time_s[0] / 86_400 == pytest.approx(case["mjd"], abs=2e-8)
    assert frames.scale == case.get("scale", frames.scale)
    assert frames.mission == case.get("mission", frames.mission)
    assert frames.cadence_s == pytest.approx(case.get("cadence_s", frames.cadence_s), abs=1e-3)
    median = float(np.nanmedian(frames.flux))
    assert median == pytest.approx(case.get("median", median), rel=1e-3)
    if "error" in case:
        assert frames.error is not None
        assert np.median(frames.error) == pytest.approx(case["error"])
    flagged = np.flatnonzero(frames.faults & Reason.QUALITY)
    assert flagged.tolist() == case.get("flagged", flagged.tolist())
    assert flagged.size == case.get("flagged_count", flagged.size)
    if "flares_above" in case:
        usable = frames.flux[frames.faults == 0]
        assert usable.max() - np.median(usable) > case["flares_above"]
    return frames.remarks


def _spectrum(path: Path, case: Case) -> tuple[str, ...]:
    found = read_spectrum(path)
    bad = found.wavelength_nm[~np.isfinite(found.flux_flam)]
    np.testing.assert_allclose(bad, case.get("undefined_nm", []))
    if "span_nm" in case:
        np.testing.assert_allclose(found.wavelength_nm[[0, -1]], case["span_nm"], atol=0.01)
    for nm, flux in zip(case["nm"], case["flux"], strict=True):
        at = int(np.argmin(np.abs(found.wavelength_nm - nm)))
        assert found.wavelength_nm[at] == pytest.approx(nm, abs=1e-4)
        assert found.flux_flam[at] == pytest.approx(flux, rel=case.get("rtol", 1e-5))
    return found.messages


def _star(path: Path, case: Case) -> tuple[str, ...]:
    return Source.read(path).messages


def _targets(path: Path, case: Case) -> tuple[str, ...]:
    targets = [PlanTarget.model_validate(one) for one in read_targets(path)]
    places = [one.target(simbad=False) for one in targets]
    assert [one.name for one in targets] == case["names"]
    np.testing.assert_allclose([one.ra_deg for one in places], case["ra"], atol=1e-10)
    np.testing.assert_allclose([one.dec_deg for one in places], case["dec"], atol=1e-10)
    assert {one.spectral_type for one in targets} == {"K5V"}
    assert {one.magnitude for one in targets} == {8.0}
    assert {one.distance_pc for one in targets} == {10.0}
    return ()


def _neighbours(path: Path, case: Case) -> tuple[str, ...]:
    stars, notes = read_neighbours(path, case["of"])
    np.testing.assert_allclose([star.separation_arcsec for star in stars], case["separations"], atol=2e-3)
    return notes


def _flares(path: Path, case: Case) -> tuple[str, ...]:
    np.testing.assert_array_equal(read_flares(path)["amplitude"], case["amplitudes"])
    return ()


READERS: dict[str, Callable[[Path, Case], tuple[str, ...]]] = {
    "frames": _frames, "spectrum": _spectrum, "star": _star, "targets": _targets, "neighbours": _neighbours,
    "flares": _flares,
}  # fmt: skip


@pytest.mark.parametrize(("folder", "case"), CASES, ids=[f"{case['file']}" for _, case in CASES])
def test_files_are_read_as_they_say(folder: Path, case: Case) -> None:
    read = READERS[case["reader"]]
    if "refused" in case:
        with refused(case["refused"], *case["words"]) as caught:
            read(folder / case["file"], case)
        assert case.get("without", "\n") not in str(caught.value)
        return
    said = read(folder / case["file"], case)
    assert all(any(word in text for text in said) for word in case.get("words", ())), said


#: Files of the pipelines, with the mask of bits that excludes a frame by lightkurve 2.6 (without 512 for TESS).
PIPELINES = [
    ("kplr010002792-2009259160929_llc.fits.xz", 1_130_799, 2_454_833),
    ("ktwo211117077-c04_llc.fits.xz", 1_130_799, 2_454_833),
    ("tess2018206045859-s0001-0000000358108509-0120-s_lc.fits.xz", 17_087 - 512, 2_457_000),
]


@pytest.mark.parametrize(("file", "mask", "epoch"), PIPELINES)
def test_light_curves_of_the_pipelines_are_those_of_astropy(file: str, mask: int, epoch: int, tmp_path: Path) -> None:
    path = tmp_path / "lc.fits"
    path.write_bytes(lzma.decompress((DATA / "light_curves" / file).read_bytes()))
    found: Frames = read_frames(path)
    rows = fits.getdata(path, 1)
    kept = np.isfinite(rows["TIME"])
    rows = rows[kept]
    flags = rows["SAP_QUALITY" if "SAP_QUALITY" in rows.names else "QUALITY"]
    np.testing.assert_array_equal(found.flux, rows["PDCSAP_FLUX"].astype(float))
    assert found.reference_mjd is not None
    days = found.reference_mjd + found.time_s / 86_400 + 2_400_000.5 - epoch
    np.testing.assert_allclose(days, rows["TIME"], atol=2e-9, rtol=0)
    np.testing.assert_array_equal(found.faults & Reason.QUALITY != 0, flags & mask != 0)
    names = [text for text in found.flags if text]
    assert len(names) == np.count_nonzero(flags & mask)
    assert all("(" in text for text in names)


def test_damage_is_reported_and_can_be_ignored(tmp_path: Path) -> None:
    content = bytearray((DATA / "cases" / "checksum-without-datasum" / "lc.fits").read_bytes())
    whole = read_frames(DATA / "cases" / "checksum-without-datasum" / "lc.fits")
    content[-2880 + 31] ^= 1
    path = tmp_path / "lc.fits"
    path.write_bytes(content)
    with refused("CHECKSUM", "extension 1", "`ignore_checksum=True`"):
        read_frames(path)
    read = read_frames(path, ignore_checksum=True)
    assert np.count_nonzero(read.flux != whole.flux) + np.count_nonzero(read.time_s != whole.time_s) == 1
