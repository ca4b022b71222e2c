"""Values of the payload, pixels that differ, and the content of users' instrument files."""

import re
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from mauvecl import Instrument, PixelMap, Source, expect


def test_efficiency_is_the_product_of_the_paper(mauve: Instrument) -> None:
    # The knots at 300 nm, by hand.
    by_hand = 0.80 * 0.977 * 0.96**4 * 0.910**2 * 0.888**2 * 0.92 * 0.999 * 0.66
    assert mauve.efficiency(300.0) == pytest.approx(by_hand, rel=1e-12)
    assert mauve.quantum_efficiency(300.0) == pytest.approx(0.122 * 1239.84198 / 300, rel=1e-8)
    assert mauve.throughput(300.0) == pytest.approx(by_hand * 0.122 * 1239.84198 / 300, rel=1e-8)
    assert mauve.with_(pointing_loss=0.05).efficiency(300.0) == pytest.approx(0.95 * by_hand, rel=1e-12)


@pytest.mark.parametrize("name", ["mauvesim", "mauve"])
def test_every_value_has_a_source(name: str) -> None:
    instrument = Instrument.load(name)
    assert instrument.name == name
    given = {field for field in Instrument.model_fields if getattr(instrument, field) not in (None, ())}
    assert set(instrument.sources) == given - {"name", "notice", "sources"}
    assert all(re.match("[PDCA]: (?!.*no source)", source) for source in instrument.sources.values())
    assert "not a flight calibration" in instrument.notice


def test_with_returns_a_marked_copy(mauve: Instrument) -> None:
    cold = mauve.with_(temperature_c=13, grating_efficiency=0.5)
    assert (mauve.temperature_c, cold.temperature_c) == (21, 13)
    assert cold.grating_efficiency.at([200, 700]).tolist() == [0.5, 0.5]
    marked = {name for name, source in cold.sources.items() if source.startswith("U: ")}
    assert marked == {"temperature_c", "grating_efficiency"}
    assert cold.digest != mauve.digest == mauve.with_(name="renamed").digest
    assert {mauve: 1}[mauve.with_(temperature_c=21.0)] == 1


def test_user_file_extends_an_embedded_instrument(tmp_path: Path, mauve: Instrument) -> None:
    grating = Path(__file__).parents[1] / "data" / "grating.ecsv"
    (tmp_path / "mine.toml").write_text(
        f'extends = "mauvesim"\nname = "mine"\nlight_loss = 0.2\ngrating_efficiency = "{grating}"\n'
        'read_noise_dn = { value = 11, tag = "D", source = "lab" }\nwindow_efficiency = 0.9\n'
    )
    mine = Instrument.load(str(tmp_path / "mine.toml"))
    assert (mine.name, mine.light_loss, mine.read_noise_dn, mine.frame_s) == ("mine", 0.2, 11, 5)
    assert mine.grating_efficiency.at(450.0) == pytest.approx(0.3)
    assert mine.window_efficiency.at(450.0) == 0.9
    changed = {"read_noise_dn": "D: lab", "grating_efficiency": "D: measured"}
    changed |= dict.fromkeys(("light_loss", "window_efficiency"), "A: assumed, no source in mine.toml")
    assert mine.sources == mauve.sources | changed
    # A file may extend a user's own, too.
    (tmp_path / "colder.toml").write_text('extends = "mine.toml"\ntemperature_c = 13\n')
    assert Instrument.load(tmp_path / "colder.toml").with_(temperature_c=21) == mine


@pytest.mark.parametrize(("length", "unit", "per_nm", "value"), [
    ("ANGSTROMS", "A / W", 10, 0.05), ("A", "A/W", 10, 0.05), ("microns", "A / W", 1e-3, 0.05),
    ("Nanometers", "mA / W", 1, 50.0), ("nm", "%", 1, 5.0), ("nm", "percent", 1, 5.0),
])  # fmt: skip
def test_curve_units_in_any_spelling(
    tmp_path: Path, mauve: Instrument, length: str, unit: str, per_nm: float, value: float
) -> None:
    """Read A as Angstrom of a wavelength and as ampere of a sensitivity."""
    rows = "\n".join(f"{nm * per_nm:g} {value * k}" for k, nm in ((1, 180), (2, 500), (1, 800)))
    (tmp_path / "curve.ecsv").write_text(
        "# %ECSV 1.0\n# ---\n# datatype:\n"
        f"# - {{name: wavelength, unit: '{length}', datatype: float64}}\n"
        f"# - {{name: value, unit: '{unit}', datatype: float64}}\n# schema: astropy-2.0\nwavelength value\n{rows}\n"
    )
    name = "quantum_efficiency_a_per_w" if "W" in unit else "grating_efficiency"
    curve = getattr(mauve.with_(**{name: tmp_path / "curve.ecsv"}), name)
    np.testing.assert_allclose(curve.wavelength_nm, [180.0, 500.0, 800.0])
    # The end values hold beyond the knots.
    np.testing.assert_allclose(curve.at([100.0, 180.0, 340.0, 500.0, 900.0]), [0.05, 0.05, 0.075, 0.1, 0.05])


def test_each_column_changes_its_own_quantity(mauve: Instrument) -> None:
    n, part, star = np.arange(2048), mauve.read_pixels, Source.from_library("G2V").at_magnitude(6.0)
    given = PixelMap(
        response=n % 64 / 64, dark=1 + n / 1024, gain=1 - n / 8192, bias_dn=500.0 + n, read_noise_dn=10 + n / 500
    )
    maps = (None, given, PixelMap(dark=given.dark))
    plain, uneven, only_dark = (expect(star, mauve.with_(pixel_map=one), exposure=5.0) for one in maps)
    assert (part.start, part.stop - part.start) == (76, plain.wavelength_nm.size)
    for name, factor in (("source_electrons", "response"), ("dark_dn", "dark"), ("gain_dn_per_electron", "gain")):
        found = getattr(plain, name) * getattr(given, factor)[part]
        np.testing.assert_allclose(getattr(uneven, name), found, rtol=1e-12)
    np.testing.assert_array_equal(uneven.bias_dn, given.bias_dn[part])
    np.testing.assert_array_equal(uneven.read_noise_dn, given.read_noise_dn[part])
    np.testing.assert_array_equal(only_dark.source_electrons, plain.source_electrons)
    assert mauve.with_(pixel_map=given).digest != mauve.digest


def test_written_maps_are_read_back(tmp_path: Path) -> None:
    made = PixelMap.made_up(2048, seed=3, hot_share=0.01, hot_dark=50.0)
    assert 5 < np.sum(made.dark > 10) < 50
    made.write(tmp_path / "map.ecsv")
    again = PixelMap.read(tmp_path / "map.ecsv")
    assert again.digest == made.digest
    assert again.source == "A: made up, seed 3"
    QTable({"response": [98.0, 102.0] * u.percent}).write(tmp_path / "percent.ecsv", format="ascii.ecsv")
    np.testing.assert_allclose(PixelMap.read(tmp_path / "percent.ecsv").response, [0.98, 1.02])
    (tmp_path / "own.toml").write_text('extends = "mauvesim"\nname = "own"\npixel_map = "map.ecsv"\n')
    payload = Instrument.load(tmp_path / "own.toml")
    assert payload.pixel_map.digest == made.digest
    assert payload.sources["pixel_map"] == made.source
