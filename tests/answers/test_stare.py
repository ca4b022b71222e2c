"""One simulated stare: its light, its files, and refusals."""

import io
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from answers import expectations
from astropy.io import fits
from scenes import paper

from mauvecl import Engine, Study, stare

#: A G2V star for five minutes with a gap and a flare.
SHORT = paper(
    'star=[{library="G2V", magnitude=7.4}]', "flare.amplitudes=[0.5]", "stare.duration_s=300",
    "stare.gaps=[[100, 150]]", "stare.half_width_s=20", "stare.search=false",
    "stare.thermal.amplitude=2.0", "stare.thermal.period_s=600",
)  # fmt: skip


def test_spectra_summed_over_frames_equal_exposures_of_the_engine(stares):
    # Frames of a stare have the addresses of an exposure's: the same draws, to the last DN.
    near = Path(__file__).parents[1] / "data" / "studies" / "near.csv"
    study = SHORT.with_settings(["stare.gaps=[]", "stare.duration_s=50", "flare.amplitudes=[0]", "run.seed=5",
                                 f"star.0.neighbours='{near}'", "star.0.neighbour_share=0.5"])  # fmt: skip
    study = study.model_copy(update={"stare": study.stare.model_copy(update={"thermal": None, "number": 3})})
    one = stare(study, stares).stares[0]
    exposure, *_ = expectations(study.with_settings(["observation.exposure_s=50"]))
    raw = Engine().realise(exposure, start=3, count=1, seed=study.run.seed, mode="frames")[0]
    net = raw - 10 * (exposure.bias_dn + exposure.dark_dn)
    elements = np.bincount(exposure.element, net)
    np.testing.assert_allclose(5.0 * one.light.spectrum.sum(axis=0), elements, atol=0.05)
    assert 5.0 * one.light.flux[:, 0].sum() == pytest.approx(net.sum(), abs=0.5)
    band = (exposure.wavelength_nm >= 300) & (exposure.wavelength_nm < 400)
    assert 5.0 * one.light.flux[:, 2].sum() == pytest.approx(net[band].sum(), abs=0.1)


def test_light_scatters_by_its_standard_deviation_in_bands_of_a_sweep_and_files(stares, tmp_path):
    """Files have the columns of lightkurve; a sweep goes over magnitude and temperature, in bands that overlap."""
    (tmp_path / "i.toml").write_text('version = 2\nextends = "mauvesim"\nname = "λ"\ntemperature_c = 20.0')
    asked = SHORT.with_settings([f"observation.instrument='{tmp_path / 'i.toml'}'"])
    found = stare(asked, stares)
    light = found.stares[0].light
    z = (light.flux - light.mean) / light.sd
    spectrum = (light.spectrum - light.spectrum_mean) / light.spectrum_sd
    # 50 frames x 4 bands (the first is their sum), and 50 x 48 elements: beyond these once in 1e6.
    assert abs(z[:, 1:].mean()) < 4.9 / np.sqrt(z[:, 1:].size)
    assert abs((spectrum**2).mean() - 1) < 4.9 * np.sqrt(2 / spectrum.size) + 0.01
    # The dark follows 2 deg C up and down, hundreds of standard deviations that are known and taken off.
    assert abs(spectrum.mean()) < 4.9 / np.sqrt(spectrum.size)
    with fits.open(io.BytesIO(found.documents["light-curve-1.fits"]())) as hdus:
        hdus.verify("exception")
        table, gti = hdus[1], hdus["GTI"]
        # `lightkurve.read` takes a file for a generic one only where CREATOR or ORIGIN is missing, and needs a time.
        assert "ORIGIN" not in hdus[0].header
        assert table.header["MJDREFI"] == 61041
        assert (table.header["TIMESYS"], table.header["TREFPOS"]) == ("UTC", "TOPOCENTER")
        np.testing.assert_allclose([86_400 * table.header[name] for name in ("EXPOSURE", "TSTOP")], [250, 300])
        assert hdus[0].header["TELESCOP"] == hdus[0].header["INSTRUME"] == r"\u03bb"
        # 2 deg C times the mean of the sine over 0-100 s and 150-300 s of 600 s; frames of 5 s give it to 1e-4.
        warmth = 2 * 600 / (2 * np.pi) * (1 - np.cos(np.pi / 3) + 1) / 250
        assert hdus[0].header["CCD-TEMP"] == pytest.approx(20 + warmth, rel=1e-4)
        assert table.columns.names[:6] == ["TIME", "CADENCENO", "QUALITY", "FLUX", "FLUX_ERR", "MEAN"]
        assert table.columns["TIME"].unit == "d"
        np.testing.assert_allclose(table.data["FLUX"], light.flux[:, 0], rtol=1e-6)
        np.testing.assert_allclose(table.data["FLUX_ERR_300_400"], light.sd[:, 2], rtol=1e-6)
        assert table.data["CADENCENO"].tolist() == [*range(20), *range(30, 60)]
        np.testing.assert_allclose(gti.data["START"] * 86_400, [0.0, 150.0])
        np.testing.assert_allclose(gti.data["STOP"] * 86_400, [100.0, 300.0])
        assert hdus[0].header["OBJECT"] == "G2V V = 7.4"
    bands = [[200, 300], [200, 300], [250, 450], *([300 + 10 * k, 400 + 10 * k] for k in range(9))]
    axes = '{quantity="magnitude", values=[7.4, 9]}, {quantity="flare_temperature", values=[10000, 20000]}'
    swept = stare(asked.with_settings([f"stare.bands_nm={bands}", f"sweep.axes=[{axes}]"]), stares)
    assert swept.table["magnitude"].value.tolist() == [7.4, 7.4, 9.0, 9.0]
    assert swept.table["frame_noise"][2] > 2 * swept.table["frame_noise"][0]
    assert [one.flares[0].event.hottest_k for one in swept.stares] == [10_000.0, 20_000.0] * 2
    flux = swept.stares[0].light.flux
    assert flux.shape == (50, 13)
    np.testing.assert_array_equal(flux[:, 1], flux[:, 2])
    np.testing.assert_allclose(flux[:, [1, 4]], light.flux[:, [1, 2]], atol=0.01)


def test_one_sum_finds_flares_of_the_temperature_of_the_study(stares):
    """Find a flare within five standard errors; with a bank that is too narrow it is found and not measured."""
    asked = paper('star=[{library="M3V", magnitude=8, distance_pc=5}]', "stare.duration_s=2000", "search.sums=1",
                  "flare.temperature_k=14000", "events=[{peak_s=700, half_width_s=60, amplitude=0.2}]")  # fmt: skip
    answer, narrow = stare(asked, stares), stare(asked.with_settings(["search.half_widths_s=[5, 10, 20]"]), stares)
    (row,), put_in = answer.found, answer.events[0]
    assert np.isnan([row["temperature"].value, row["temperature_low"].value]).all()
    assert row["amplitude_error"] < 0.005
    for name in ("amplitude", "equivalent_duration"):
        assert abs(row[name] - put_in[name]) < 5 * row[f"{name}_error"]
    per_s = put_in["energy_bolometric"] / put_in["equivalent_duration"]
    for end in ("", "_low", "_high"):
        ratio = row[f"energy_bolometric{end}"] / row[f"equivalent_duration{end}"] / per_s
        assert float(ratio) == pytest.approx(1.0, rel=2e-3)
    assert narrow.headline.endswith(f"raises no false alarms; {len(narrow.found)} alarms are not measured.")
    assert {*narrow.found["event"]} == {-1}


@pytest.mark.long
def test_study_file_with_curves_shapes_and_events_is_read(tmp_path, stares):
    (tmp_path / "slow.txt").write_text("# s, relative\n0 0.0\n300 0.03\n")
    (tmp_path / "own.txt").write_text("-10 0\n0 4\n30 0\n")
    study = Study.read(shutil.copy(Path(__file__).parents[1] / "data" / "studies" / "events.toml", tmp_path))
    assert Study.build(tomllib.loads(study.toml()), "again").toml() == study.toml()
    found = stare(study, stares)
    staring = found.stares[0].staring.stare
    np.testing.assert_allclose(staring.star[[0, -1]], [1 + 0.03 * 2.5 / 300, 1 + 0.03 * 297.5 / 300])
    first, second = found.stares[0].flares
    assert first.bolometric_erg == pytest.approx(1e33, rel=1e-9)
    # Own shape: a triangle of 40 s with a peak of one.
    assert second.event.equivalent_duration_s == pytest.approx(2.0)
    assert second.event.peak == pytest.approx(0.1)
    assert staring.unknowns[0].name == "light drift"


@pytest.mark.long
def test_light_curves_state_the_light_lost_in_pointing_drifts(stares):
    study = SHORT.with_settings(["stare.pointing={rate_per_h=100.0, duration_s=60.0, depth=1.0}", "stare.number=4"])
    answer = stare(study, stares)
    (one,), curve = answer.stares, answer.light_curve()
    lost = one.staring.stare.pointing_losses(np.array([4], np.uint64), study.run.seed)[0]
    np.testing.assert_array_equal(curve["pointing_loss"], lost)
    assert lost.max() > 0.2
    with fits.open(io.BytesIO(answer.documents["light-curve-1.fits"]())) as hdus:
        np.testing.assert_allclose(hdus["LIGHTCURVE"].data["POINTING_LOSS"], lost, rtol=1e-6)
        assert hdus["LIGHTCURVE"].header["LOSTFRMS"] == np.count_nonzero(lost) == answer.table["drifting_frames"][0]
        # An observer does not know which frames these are.
        assert not hdus["LIGHTCURVE"].data["QUALITY"].any()
    # Drawn light is the mean without drifts times the share that is left, within its noise.
    excess = (one.light.flux[:, 0] - (1 - lost) * one.light.mean[:, 0]) / one.light.sd[:, 0]
    assert np.abs(excess).max() < 5.5
    assert any("lose light" in text and "assumed" in text for text in answer.messages)
    assert "pointing drifts (assumed)" in answer.assumed
