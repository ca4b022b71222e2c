"""Files of every kind are read as their entry in the corpus says, or refused in one sentence that helps.

The entries are in data/corpus, whose README says what they may hold; those of stored files are beside the files.
"""

import io
import lzma
import re
import warnings
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path
from typing import Any

import astropy.units as u
import corpus
import numpy as np
import pytest
from astropy.io import fits
from corpus import CORPUS, FLUX, LIGHT, NM, Case, cases, mapping_of, value, written
from refusals import refused
from scenes import instrument, star

from mauvecl import Source, Study, read_frames
from mauvecl.host.stars.formats import read_spectrum
from mauvecl.host.tables import opening
from mauvecl.observations import frames as observed

# Astropy warns of the usual units when it writes a VOTable.
pytestmark = pytest.mark.filterwarnings("ignore:The unit .* has been deprecated in the VOUnit standard")

STORED = [CORPUS.parent / folder / "expected.toml" for folder in ("cases", "light_curves")]
CASES = [one for path in (*sorted(CORPUS.glob("*.toml")), *STORED) for one in cases(path)]


#: Words of frames and of spectra by their keys in an entry.
WORDS = {"scale": "scale", "position": "position", "mission": "mission", "star": "name"}


def _check_words(found: Any, case: Case) -> None:
    for key in {*WORDS} & {*case}:
        assert getattr(found, WORDS[key]) == case[key]
    for text, start in zip(getattr(found, "messages", ()), case.get("messages", ()), strict="messages" in case):
        assert text.startswith(start)


def _spectrum(path: Path, case: Case) -> tuple[str, ...]:
    star = Source.read(f"{path}{case.get('part', '')}", **case.get("options", {}))
    _check_words(star, case)
    assert star.messages[0] == case.get("first", star.messages[0])
    if (expected := case.get("nm", "nm")) != "":
        nm, flux = value(expected), value(case.get("flux", "flux"))
        rows, rtol = value(case.get("inside", "every")), case.get("rtol", 1e-8)
        np.testing.assert_allclose(star.wavelength_nm[rows], nm[rows] if nm.size > 1 else nm, rtol=rtol)
        scale = (star.flux_flam[100], flux[100]) if case.get("relative") else (1.0, 1.0)
        np.testing.assert_allclose(star.flux_flam / scale[0], flux / scale[1], rtol=case.get("flux_rtol", rtol))
    return (*star.messages, *star.notes)


def _frames(path: Path, case: Case) -> tuple[str, ...]:
    frames = read_frames(f"{path}{case.get('part', '')}", mapping_of(case, path.parent), **case.get("options", {}))
    rows = value(case.get("kept", "every"))
    time, flux = value(case.get("time", "t"))[rows], value(case.get("light", "light"))[rows]
    assert (frames.reference_mjd is None) == ("mjd" not in case)
    if frames.reference_mjd is not None:
        first = frames.reference_mjd + frames.time_s[0] / 86_400
        assert first == pytest.approx(value(case["mjd"]), abs=case.get("days", 1e-8))
        np.testing.assert_allclose(frames.time_s - frames.time_s[0], time - time[0], atol=case.get("atol", 1e-3))
    else:
        np.testing.assert_allclose(frames.time_s, time, atol=1e-4)
    faults = {str(k): observed.Reason(int(frames.faults[k])).name for k in np.flatnonzero(frames.faults)}
    assert faults == case.get("faults", {})
    good = np.ones(frames.n_frames, bool) if case.get("pixels") else frames.faults == 0
    np.testing.assert_allclose(frames.flux[good], flux[good], rtol=case.get("rtol", 1e-9))
    if frames.wavelength_nm is not None and "nm" in case:
        found = frames.wavelength_nm[value(case.get("inside", "every"))]
        np.testing.assert_allclose(found, value(case["nm"]), rtol=case.get("rtol", 1e-9))
    if case.get("error"):
        np.testing.assert_allclose(frames.error[good], value(case["error"])[rows][good], rtol=1e-6)
    _check_words(frames, case)
    assert "unit" not in case or u.Unit(frames.unit) == u.Unit(case["unit"])
    for key, unit, rtol in (("quality", "", 0), ("exposure", "_s", 1e-7), ("temperature", "_c", 1e-6)):
        if case.get(key):
            np.testing.assert_allclose(getattr(frames, key + unit), value(case[key]), rtol=rtol)
    assert case.get("says") or len(frames.remarks) == case.get("remarks", len(frames.remarks)), frames.remarks
    return frames.remarks


def _summary(path: Path, case: Case) -> tuple[str, ...]:
    """Read frames of a stored file, of which numbers are known instead of arrays, or which astropy reads."""
    frames = read_frames(path, mapping_of(case, path.parent), **case.get("options", {}))
    flagged = frames.faults & observed.Reason.QUALITY != 0
    found: Case = {
        "frames": frames.n_frames, "dated": frames.reference_mjd is not None, "cadence_s": frames.cadence_s,
        "mjd": (frames.reference_mjd or 0.0) + frames.time_s[0] / 86_400, "median": np.nanmedian(frames.flux),
        "error": 0.0 if frames.error is None else np.median(frames.error), "flagged": np.flatnonzero(flagged).tolist(),
        "highest": frames.flux[frames.faults == 0].max(),
    }  # fmt: skip
    # Files with eight decimals of a day have a millisecond and a half.
    margins = {"mjd": {"abs": 2e-8}, "cadence_s": {"abs": 1e-3}, "median": {"rel": 1e-3}}
    for key in {*found} & {*case}:
        assert found[key] == pytest.approx(case[key], **margins.get(key, {})), key
    _check_words(frames, case)
    if "epoch" in case:
        rows = fits.getdata(io.BytesIO(lzma.decompress(path.read_bytes())), 1)
        rows = rows[np.isfinite(rows["TIME"])]
        # The bits that exclude a frame by lightkurve 2.6, without 512 for TESS.
        bits = rows["SAP_QUALITY" if "SAP_QUALITY" in rows.names else "QUALITY"] & case["bits"]
        np.testing.assert_array_equal(frames.flux, rows["PDCSAP_FLUX"].astype(float))
        days = frames.reference_mjd + frames.time_s / 86_400 + 2_400_000.5 - case["epoch"]
        np.testing.assert_allclose(days, rows["TIME"], atol=2e-9, rtol=0)
        np.testing.assert_array_equal(flagged, bits != 0)
        assert ["(" in text for text in frames.flags if text] == [True] * np.count_nonzero(bits)
    return frames.remarks


def _points(path: Path, case: Case) -> tuple[str, ...]:
    """Read a spectrum that may be short or undefined in part, and compare it at some wavelengths."""
    found = read_spectrum(Path(f"{path}{case.get('part', '')}"), **case.get("options", {}))
    assert "law" in case or "nm" in case
    bad = found.wavelength_nm[~np.isfinite(found.flux_flam)]
    np.testing.assert_allclose(bad, case.get("undefined_nm", []))
    if "span_nm" in case:
        np.testing.assert_allclose(found.wavelength_nm[[0, -1]], case["span_nm"], atol=0.01)
    if "law" in case:
        law = value(case["law"], nm=found.wavelength_nm)
        np.testing.assert_allclose(found.flux_flam, law, rtol=case["rtol"])
        assert (np.diff(found.wavelength_nm) > 0).all()
    if "wave" in case:
        np.testing.assert_allclose(found.wavelength_nm, value(case["wave"]), rtol=1e-5)
    _check_words(found, case)
    for nm, flux in zip(case.get("nm", ()), case.get("flux", ()), strict=True):
        at = int(np.argmin(np.abs(found.wavelength_nm - nm)))
        assert found.wavelength_nm[at] == pytest.approx(nm, abs=1e-4)
        assert found.flux_flam[at] == pytest.approx(flux, rel=case.get("rtol", 1e-5))
    return found.messages


def _targets(path: Path, case: Case) -> tuple[str, ...]:
    for target, wanted in zip(Study.of(targets=str(path)).plan.targets, case["targets"], strict=True):
        found = target.model_dump()
        assert wanted.get("only", [*target.model_fields_set]) == [*target.model_fields_set]
        if "ra" in wanted:
            place = target.target(simbad=False)
            found |= {"ra": place.ra_deg, "dec": place.dec_deg}
        for key, one in wanted.items():
            rtol = 1e-11 if key in ("ra", "dec") else 1e-6
            assert key == "only" or _same(found[key], one, rtol), f"{key} = {found[key]!r}"
    return ()


def _same(found: Any, wanted: Any, rtol: float = 1e-6) -> bool:
    """Compare with a value of TOML, which has lists and, here, the word None."""
    if isinstance(wanted, list):
        return len(found) == len(wanted) and all(_same(*both, rtol) for both in zip(found, wanted, strict=True))
    if isinstance(wanted, float):
        return found is not None and bool(found == pytest.approx(wanted, rel=rtol, abs=1e-10))
    return bool(found == (None if wanted == "None" else wanted))


def _neighbours(path: Path, case: Case) -> tuple[str, ...]:
    asked = {"library": "G2V", "neighbours": path, "neighbours_of": case.get("of") or None}
    near = Study.build({"star": [asked]}, "test").star[0].near()
    assert near is not None
    stars, notes = near.stars, near.notes
    if case.get("lit") and all(star.spectral_type for star in stars):
        assert all(star.source for star in stars)
    for key, wanted in case["stars"].items():
        how = {"type": lambda star: star.spectrum[0], "last": lambda star: star.name[-1]}
        found = [how.get(key, attrgetter(key))(star) for star in stars]
        assert _same(found, wanted, case.get("rtol", 1e-6)), f"{key} = {found}"
    return notes


def _flares(path: Path, case: Case) -> tuple[str, ...]:
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        assert Study.of(flares=str(path)).flare.amplitudes == tuple(sorted({*case["amplitudes"]}))
    remarks = tuple(str(one.message) for one in noted)
    assert len(remarks) == case.get("remarks", len(remarks))
    return remarks


def _unknown(path: Path, case: Case) -> tuple[str, ...]:
    """Read the spectrum of an unknown, which is that of the corpus times 1e15."""
    study = Study.build({"nuisances": {"usual": False, "own": {"own": {"file": path}}}}, "test")
    (quiet,) = star(payload=instrument(part=True))
    (found,) = study.nuisances.marginalised(quiet).spectra
    np.testing.assert_allclose(found, np.interp(quiet.wavelength_nm, NM, 1e15 * FLUX), rtol=1e-6)
    return ()


def _curve(path: Path, case: Case) -> tuple[str, ...]:
    """Read a curve of time, which is the light curve of the corpus."""
    curve = Study.build({"stare": {"variability": {"file": path}}}, "test").stare.variability
    np.testing.assert_allclose(curve.mean_over(value("t") - 0.5e-3, 1e-3), LIGHT, rtol=1e-6)
    return ()


def _efficiency(path: Path, case: Case) -> tuple[str, ...]:
    """Read a curve of an instrument, whose end values hold beyond its knots."""
    curve = getattr(instrument(**{case["scale"]: path}), case["scale"])
    np.testing.assert_allclose(curve.wavelength_nm, [180.0, 500.0, 800.0])
    np.testing.assert_allclose(curve.at([100.0, 180.0, 340.0, 500.0, 900.0]), [0.05, 0.05, 0.075, 0.1, 0.05])
    return ()


READERS: dict[str, Callable[[Path, Case], tuple[str, ...]]] = {
    "spectrum": _spectrum, "points": _points, "frames": _frames, "summary": _summary, "targets": _targets,
    "neighbours": _neighbours, "flares": _flares, "unknown": _unknown, "curve": _curve,
    "efficiency": _efficiency,
}  # fmt: skip


def test_keys_of_entries_are_known() -> None:
    """Refuse an expectation whose key is spelt wrong, which would expect nothing."""
    known = set(re.findall(r"[\"'](\w+)[\"']", "".join(Path(file).read_text() for file in (__file__, corpus.__file__))))
    assert sorted({key for _, case in CASES for key in case} - known) == []


#: Light curves in text, which are read in pieces where they are large.
TEXTS = re.compile(r"(text_tables (?!machine-readable|IPAC).*|odd_frames (rows|unusable (text|column)).* csv\d*$)")


@pytest.mark.parametrize("case", [pytest.param(case, id=name) for name, case in CASES if TEXTS.match(name)])
def test_large_tables_are_read_in_pieces_as_they_say(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opening, "LARGE", 0)
    monkeypatch.setattr(opening, "PIECE", 200)
    test_files_are_read_as_they_say(case, tmp_path)


@pytest.mark.parametrize("case", [pytest.param(case, id=name) for name, case in CASES])
def test_files_are_read_as_they_say(case: Case, tmp_path: Path) -> None:
    path = written(case, tmp_path)
    with warnings.catch_warnings():
        # What a reading has to say it says in remarks.
        warnings.simplefilter("error")
        if not case.get("refused"):
            said = READERS[case["reader"]](path, case)
            assert all(any(word in text for text in said) for word in case.get("says", ())), said
        else:
            key, *words = case["refused"]
            with refused(key, *words, *([case["expected"]] if "expected" in case else [])) as caught:
                READERS[case["reader"]](path, case)
            said = (str(caught.value),)
            assert 20 < len(said[0]) < case.get("longest", 400 if case["reader"] == "spectrum" else 600)
            assert not any(word in said[0] for word in ("Error", "HDU"))
            if "suggested" in case:
                part = re.search(r"FILE(\[[^\]]*\])", said[0])
                assert part is not None
                assert Source.read(f"{path}{part[1]}").flux_flam.max() == case["suggested"]
    assert not any(word in text for text in said for word in case.get("without", ())), said
