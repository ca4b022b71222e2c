"""Values of the payload, pixels that differ, the detector's response, expectations and closed forms of their noise."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from scenes import instrument, quiescent, source
from scipy.special import erf
from scipy.stats import norm
from tables import DATA

from mauvecl import Expectation, Instrument, PixelMap, Sky, Source, expect

SUN, QUIET, MAUVE = source("G2V", 7.4), quiescent("G2V", 7.4), instrument()


def kinds(x: Expectation) -> list[str]:
    return [one.kind for one in x.messages if hasattr(one, "kind")]


def test_rates_equal_the_published_ones() -> None:
    """Compare DN/s/pixel of independent work with Pickles' spectra, so that 10 % is for the grids alone."""
    for name, magnitude, rates in (
        ("G2V", 7.4, {250: 0.4, 300: 5.1, 400: 16.8, 500: 23.7, 600: 20.1, 699.7: 13.8}),
        ("B2IV", 3.03, {200.2: 2989, 250: 5373, 300: 6064, 400: 3657, 500: 1741, 600: 851, 699.7: 406}),
    ):
        x = expect(source(name, magnitude), MAUVE, exposure=5)
        found = np.interp(list(rates), x.wavelength_nm, x.net_source_dn / x.exposure_s)
        np.testing.assert_allclose(found, list(rates.values()), rtol=0.1)


@pytest.mark.parametrize("signal", ["net", "paper"])
def test_closed_form_signal_to_noise(signal: Any) -> None:
    """Compare one pixel, and warn of frames that fall below zero, which closed forms neglect."""
    # One pixel by hand: 10 frames, noise added in quadrature; the paper counts the zodiacal light as signal.
    p, x = 900, expect(SUN, MAUVE, exposure=50, sky=22.1, signal=signal)
    assert ("paper signal" in kinds(x)) == (signal == "paper")
    star, sky = 10 * x.source_electrons[p], 10 * x.sky_electrons[p]
    assert sky > 0.005 * star
    counted = 0.5957818 * (star + sky if signal == "paper" else star)
    light = 0.5957818 * (star + sky)
    noise = np.sqrt((0.5957818 * np.sqrt(star + sky)) ** 2 + 10 * 12.0**2 + 10 * 445.5337 * 5)
    assert x.signal_dn[p] == pytest.approx(counted, rel=1e-6)
    assert x.recorded_light_dn[p] == pytest.approx(light, rel=1e-6)
    assert x.snr()[p] == pytest.approx(counted / noise, rel=1e-6)
    assert x.variance_dn2[p] == pytest.approx(noise**2 + 10 / 12, rel=1e-6)
    assert x.mean_raw_dn[p] == pytest.approx(light / 10 + 445.5337 * 5 + 600, rel=1e-6)
    assert x.element_wavelength_nm[[0, -1]] == pytest.approx([205.25, 698.75])
    low = expect(SUN, MAUVE.with_(bias_dn=20, dark_scale_dn_per_s=0, read_noise_dn=12), exposure=50, signal=signal)
    sd = np.sqrt(low.variance_dn2 / 10)
    near = norm.sf((low.mean_raw_dn + 0.5) / sd) > 1e-4
    assert f"frames of {near.sum()} of 1643 pixels fall below 0 DN" in " ".join(low.messages)
    assert (near.any(), near.all(), "below 0 DN" in " ".join(x.messages)) == (True, False, False)


@pytest.mark.parametrize(("exposure", "frame_s", "frames", "rounded"), [
    (50, 5, 10, False), (47.0, 5, 10, True), (0.001, 5, 1, True), (5, 5, 1, False), (5.001, 5, 2, True),
    (2 * u.min, 5, 24, False), (1 * u.day, 5, 17280, False), (np.float32(10), 5, 2, False), (0.1 + 0.2, 0.1, 3, False),
])  # fmt: skip
def test_exposures_are_whole_frames(exposure: Any, frame_s: float, frames: int, rounded: bool) -> None:
    x = expect(SUN, MAUVE.with_(frame_s=frame_s), exposure=exposure)
    assert x.n_frames == frames
    assert x.exposure_s == pytest.approx(frame_s * frames, rel=1e-15)
    assert ("rounded up" in kinds(x)) is rounded


def test_saturation_is_at_its_rate_and_the_first_message() -> None:
    """The ADC's end is the published 12.5 kDN/s; the detector's typical 2.0 V comes before it."""
    for saturation_v, rate_dn_per_s in ((2.2, 12_541), (2.0, 11_350)):
        x = expect(SUN, MAUVE.with_(saturation_v=saturation_v), exposure=5)
        electrons = np.full(1643, rate_dn_per_s * 5 / MAUVE.gain_dn_per_electron)
        assert not replace(x, source_electrons=electrons * 0.999).saturated.any()
        assert replace(x, source_electrons=electrons * 1.001).saturated.all()
    star = source("B2IV", 1.5)
    x = expect(star, MAUVE, exposure=7)
    assert kinds(x) == ["saturated", "rounded up", "nominal throughput"]
    hit = x.wavelength_nm[x.saturated]
    for words in (f"{hit[0]:.1f}-", f"-{hit[-1]:.1f} nm", f"{x.saturated.sum()} of 1643 pixels"):
        assert words in x.messages[0]
    # A frame of the reported length is safe, and one a little longer is not.
    safe = float(x.messages[0].split("longest safe frame is ")[1].split(" s")[0])
    assert safe == pytest.approx(x.longest_safe_frame_s, abs=1e-3)
    assert not expect(star, MAUVE.with_(frame_s=safe), exposure=1).saturated.any()
    assert expect(star, MAUVE.with_(frame_s=safe + 0.002), exposure=1).saturated.any()
    bright = expect(source("B2IV", -9.0), MAUVE, exposure=1)
    safe = float(bright.messages[0].split("longest safe frame is ")[1].split(" s")[0])
    assert safe == pytest.approx(bright.longest_safe_frame_s, rel=0.01)
    assert (QUIET.saturated.any(), "saturated" in kinds(QUIET), QUIET.longest_safe_frame_s > 60) == (False, False, True)


def test_sky_is_there_by_default_and_provenance_names_the_inputs() -> None:
    rate = QUIET.sky_electrons * QUIET.gain_dn_per_electron / QUIET.frame_s
    assert rate.max() == pytest.approx(0.2, abs=0.05)
    np.testing.assert_array_equal(expect(SUN, MAUVE, exposure=50, sky=22.1).sky_electrons, QUIET.sky_electrons)
    assert not expect(SUN, MAUVE, exposure=50, sky=Sky.none()).sky_electrons.any()
    assert (QUIET.name, QUIET.instrument) == (SUN.name, "mauvesim")
    wanted = {"source digest": SUN.digest, "instrument digest": MAUVE.digest, "order": "paper",
              "requested exposure": "50 s"}  # fmt: skip
    assert wanted.items() <= dict(QUIET.provenance).items()
    assert "22.10" in QUIET.provenance["sky"]
    assert all(isinstance(value, str) for value in QUIET.provenance.values())
    for array in (QUIET.dark_dn, SUN.flux_flam):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


Order = Literal["paper", "physical"]


def landing(offset: np.ndarray, instrument: Instrument) -> np.ndarray:
    """Integrate a top hat convolved with a Gaussian numerically over pixels at an array of offsets, nm."""
    half, top_hat = instrument.dispersion_nm_per_pixel / 2, instrument.top_hat_width_nm
    root = np.sqrt(2) * instrument.gaussian_fwhm_nm / 2.354820045030949
    if root == 0:  # the overlap of two intervals
        low, high = np.maximum(offset - half, -top_hat / 2), np.minimum(offset + half, top_hat / 2)
        return np.asarray(np.maximum(high - low, 0) / top_hat)
    x, w = np.polynomial.legendre.leggauss(24)
    at = offset[..., None] + half * x
    if top_hat == 0:
        line = np.exp(-((at / root) ** 2)) / (root * np.sqrt(np.pi))
    else:
        line = (erf((at + top_hat / 2) / root) - erf((at - top_hat / 2) / root)) / (2 * top_hat)
    return np.asarray(line @ w * half)


def by_quadrature(instrument: Instrument, wavelength: np.ndarray, flux: np.ndarray, pixel: int, order: Order) -> float:
    """Compute a pixel's electrons per second by Gauss-Legendre quadrature between all kinks."""
    centre = instrument.wavelength_nm[pixel]
    corner = (instrument.top_hat_width_nm + np.array([-1, 1]) * instrument.dispersion_nm_per_pixel) / 2
    reach = corner[1] + 8 * instrument.gaussian_fwhm_nm / 2.35 + 0.1
    within = np.linspace(centre - reach, centre + reach, 400)
    edges = np.unique(np.concatenate([wavelength, instrument.knots_nm, centre - corner, centre + corner, within]))
    edges = edges[np.abs(edges - centre) <= reach]
    x, w = np.polynomial.legendre.leggauss(8)
    at = edges[:-1, None] + np.diff(edges)[:, None] * (1 + x) / 2
    per_joule = instrument.electrons_per_joule_cm2(at if order == "physical" else centre, held=True)
    # erg s^-1 cm^-2 A^-1 is 1e-6 W cm^-2 nm^-1.
    light = np.interp(at, wavelength, flux) * 1e-6 * landing(centre - at, instrument)
    return float(np.sum(light * per_joule * np.diff(edges)[:, None] / 2 * w))


@pytest.mark.parametrize("order", ["paper", "physical"])
@pytest.mark.parametrize(("top_hat", "fwhm"), [(10.8, 10.5), (10.8, 0.0), (0.0, 10.5), (2.0, 0.4)])
@pytest.mark.parametrize("n", [400, 40_001])
def test_random_spectra_agree_with_quadrature(mauve: Any, top_hat: float, fwhm: float, order: Order, n: int) -> None:
    """Try fewer and more nodes than a matrix of the response is made for."""
    instrument = mauve.with_(top_hat_width_nm=top_hat, gaussian_fwhm_nm=fwhm)
    rng = np.random.default_rng(20250101)
    wavelength = np.sort(np.append(rng.uniform(150, 790, n), [150, 790]))
    flux = rng.random(wavelength.size) * np.where(rng.random(wavelength.size) < 0.03, 50, 1)
    star = Source.from_arrays(wavelength, 1e-12 * flux)
    x = expect(star, instrument, exposure=instrument.frame_s, sky=Sky.none(), order=order)
    rate = 1e12 * x.source_electrons / x.frame_s
    # Light of every wavelength reaches one of these.
    for pixel in (0, 1, *range(53, 1642, 53), 1642):
        # Far below the requested 1e-6.
        assert rate[pixel] == pytest.approx(by_quadrature(instrument, wavelength, flux, pixel, order), rel=1e-9)


def test_values_state_their_source_also_in_copies_and_files(tmp_path: Path, mauve: Instrument) -> None:
    for name in ("mauvesim", "mauve"):
        one = Instrument.load(name)
        given = {field for field in Instrument.model_fields if getattr(one, field) not in (None, ())}
        assert one.name == name
        assert set(one.sources) == given - {"name", "notice", "sources"}
        assert all(re.match("[PDCA]: (?!.*no source)", text) for text in one.sources.values())
        assert "not a flight calibration" in one.notice
    cold = mauve.with_(temperature_c=13, grating_efficiency=0.5)
    assert (mauve.temperature_c, cold.temperature_c) == (21, 13)
    assert cold.grating_efficiency.at([200, 700]).tolist() == [0.5, 0.5]
    marked = {name for name, text in cold.sources.items() if text.startswith("U: ")}
    assert marked == {"temperature_c", "grating_efficiency"}
    assert cold.digest != mauve.digest == mauve.with_(name="renamed").digest
    assert {mauve: 1}[mauve.with_(temperature_c=21.0)] == 1
    pixels = PixelMap.made_up(2048, seed=3, hot_share=0.01, hot_dark=50.0)
    assert 5 < np.sum(pixels.dark > 10) < 50
    pixels.write(tmp_path / "map.ecsv")
    QTable({"response": [98.0, 102.0] * u.percent}).write(tmp_path / "percent.ecsv", format="ascii.ecsv")
    np.testing.assert_allclose(PixelMap.read(tmp_path / "percent.ecsv").response, [0.98, 1.02])
    (tmp_path / "mine.toml").write_text(
        f'extends = "mauvesim"\nname = "mine"\nlight_loss = 0.2\ngrating_efficiency = "{DATA / "grating.ecsv"}"\n'
        'read_noise_dn = { value = 11, tag = "D", source = "lab" }\nwindow_efficiency = 0.9\npixel_map = "map.ecsv"\n'
    )
    mine = Instrument.load(str(tmp_path / "mine.toml"))
    assert mine.pixel_map.digest == pixels.digest
    assert (mine.name, mine.light_loss, mine.read_noise_dn, mine.frame_s) == ("mine", 0.2, 11, 5)
    assert (mine.grating_efficiency.at(450.0), mine.window_efficiency.at(450.0)) == pytest.approx((0.3, 0.9))
    changed = {"read_noise_dn": "D: lab", "grating_efficiency": "D: measured", "pixel_map": "A: made up, seed 3"}
    changed |= dict.fromkeys(("light_loss", "window_efficiency"), "A: assumed, no source in mine.toml")
    assert mine.sources == mauve.sources | changed
    # A file may extend a user's own, too.
    (tmp_path / "colder.toml").write_text('extends = "mine.toml"\ntemperature_c = 13\n')
    assert Instrument.load(tmp_path / "colder.toml").with_(temperature_c=21) == mine
