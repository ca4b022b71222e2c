"""Stored light curves of the pipelines equal astropy's reading of them, and damage is reported.

What each stored file holds is an entry of the corpus, which `test_corpus.py` reads.
"""

import lzma
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from refusals import refused

from mauvecl import Frames, read_frames
from mauvecl.observations import frames as observed

DATA = Path(__file__).parent / "data"
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
    days = found.reference_mjd + found.time_s / 86_400 + 2_400_000.5 - epoch
    np.testing.assert_allclose(days, rows["TIME"], atol=2e-9, rtol=0)
    np.testing.assert_array_equal(found.faults & observed.Reason.QUALITY != 0, flags & mask != 0)
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
