"""Exposures for a wanted S/N: inversion, and comparison with the engine."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from answers import expectations, of_kind

from mauvecl import Engine, Expectation, Study, exposure_for


def study(magnitude: float = 7.4, **observation: float) -> Study:
    return Study.build({"star": [{"library": "G2V", "magnitude": magnitude}], "observation": observation}, "test")


def snr_at(x: Expectation, wavelength_nm: float, per: str) -> float:
    pixel = int(np.argmin(np.abs(x.wavelength_nm - wavelength_nm)))
    return float(x.snr()[pixel] if per == "pixel" else x.snr_per_element()[x.element[pixel]])


@pytest.mark.parametrize("per", ["pixel", "element"])
@pytest.mark.parametrize("frames", [1, 2, 7, 120])
@pytest.mark.parametrize("wavelength", [280.0, 450.0])
def test_exposure_inverts_snr(per: str, frames: int, wavelength: float) -> None:
    """Check that the S/N of an exposure asks for that exposure, and that one frame more is a little longer."""
    asked = study(exposure_s=5.0 * frames)
    snr = snr_at(expectations(asked)[0], wavelength, per)
    (same,) = exposure_for(asked, snr * (1 - 1e-9), wavelength, per=per).exposures
    assert (same.frames, same.exposure_s) == (frames, 5.0 * frames)
    assert same.snr_one_frame_less < snr <= same.snr * (1 + 1e-9)
    (more,) = exposure_for(asked, snr * (1 + 1e-9), wavelength, per=per).exposures
    assert more.frames == frames + 1


def test_engine_finds_the_wanted_snr(engine: Engine) -> None:
    """Compare the mean S/N of realisations at the answer within 5 standard errors and 1 % for the curved root."""
    (found,) = exposure_for(study(), 20.0, 300.0).exposures
    quiet = expectations(study(exposure_s=found.exposure_s))[0]
    table = engine.snr(quiet, realisations=20_000, seed=4).element
    row = table[int(np.argmin(np.abs(table["wavelength"].value - 300.0)))]
    assert row["mean"] == pytest.approx(found.snr, abs=5 * row["std"] / np.sqrt(20_000) + 0.01 * found.snr)


def test_fainter_stars_need_longer_exposures_and_saturation_is_reported() -> None:
    bright, faint = (exposure_for(study(m), 10.0, 400.0).exposures[0] for m in (6.0, 8.0))
    assert faint.frames > bright.frames
    blinding = exposure_for(study(-2.0), 10.0, 450.0)
    assert blinding.exposures[0].saturated
    assert of_kind(blinding.messages, "saturated")
    assert not bright.saturated


def test_failure_of_one_star_keeps_the_others() -> None:
    stars = [{"library": "G2V", "magnitude": m} for m in (7.4, 28.0)]
    found = exposure_for(Study.build({"star": stars}, "test"), 10.0, 300.0)
    assert [one.star for one in found.exposures] == ["G2V V = 7.4"]
    assert of_kind(found.messages, "no answer") == list(found.messages[:1])
    assert "G2V V = 28" in found.messages[0]


def test_exposure_above_one_day_is_answered() -> None:
    """Check that longer times are sums of several exposures, although `expect` allows only one day."""
    found = exposure_for(study(14.5), 10.0, 550.0)
    (answer,) = found.exposures
    assert answer.exposure_s > 86_400.0
    assert answer.snr_one_frame_less < 10.0 <= answer.snr
    assert of_kind(found.messages, "long exposure")


def test_answer_is_written_and_drawn(tmp_path: Path) -> None:
    found = exposure_for(study(), 10.0, 300.0)
    assert [path.name for path in found.write(tmp_path)] == ["exposure.ecsv", "study.toml"]
    again = exposure_for(Study.read(tmp_path / "exposure.ecsv"))
    assert (again.study, again.exposures) == (found.study, found.exposures)
    found.plot(tmp_path / "exposure.png")
    assert (tmp_path / "exposure.png").read_bytes()[:4] == b"\x89PNG"
