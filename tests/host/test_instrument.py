"""Values of the payload, and the content of users' instrument files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from mauvecl import Instrument

# Computed independently of this code: wavelength nm, total efficiency, effective area cm^2.
PUBLISHED = [
    (200, 0.101, 5.6),
    (250, 0.207, 11.6),
    (300, 0.263, 16.2),
    (400, 0.228, 14.7),
    (500, 0.167, 12.3),
    (600, 0.125, 9.7),
    (700, 0.093, 6.9),
]


@pytest.fixture(scope="module")
def mauve() -> Instrument:
    return Instrument.load("mauve")


@pytest.mark.parametrize(("nm", "efficiency", "area_cm2"), PUBLISHED)
def test_efficiency_and_effective_area(mauve: Instrument, nm: float, efficiency: float, area_cm2: float) -> None:
    assert mauve.efficiency(nm) == pytest.approx(efficiency, rel=0.02)
    assert mauve.effective_area_cm2(nm) == pytest.approx(area_cm2, rel=0.02)


def test_efficiency_is_the_product_of_the_paper(mauve: Instrument) -> None:
    # The knots at 300 nm, by hand.
    by_hand = 0.80 * 0.977 * 0.96**4 * 0.910**2 * 0.888**2 * 0.92 * 0.999 * 0.66
    assert mauve.efficiency(300.0) == pytest.approx(by_hand, rel=1e-12)
    assert mauve.quantum_efficiency(300.0) == pytest.approx(0.122 * 1239.84198 / 300, rel=1e-8)
    assert mauve.throughput(300.0) == pytest.approx(by_hand * 0.122 * 1239.84198 / 300, rel=1e-8)
    assert mauve.with_(pointing_loss=0.05).efficiency(300.0) == pytest.approx(0.95 * by_hand, rel=1e-12)


def test_detector_has_the_published_values(mauve: Instrument) -> None:
    assert mauve.dark_dn_per_s == pytest.approx(445.5, abs=0.1)
    assert mauve.with_(temperature_c=13).dark_dn_per_s == pytest.approx(258, abs=0.5)
    assert mauve.gain_dn_per_electron == pytest.approx(0.5958, abs=5e-5)
    assert mauve.saturation_dn == pytest.approx(59.6e3, rel=1e-3)
    assert mauve.adc_max_dn == 65535
    assert mauve.field_of_view_arcsec2 == pytest.approx(np.pi * 47.46**2)


def test_pixels_cover_the_output_range(mauve: Instrument) -> None:
    centres = mauve.wavelength_nm
    assert centres.size == 1643
    assert centres[0] >= 200
    assert centres[0] - 0.3043 < 200
    assert centres[-1] <= 700 < centres[-1] + 0.3043
    np.testing.assert_allclose(np.diff(centres), 0.3043, rtol=1e-9)


@pytest.mark.parametrize("name", ["mauve", "mauve-electrons"])
def test_every_value_has_a_source(name: str) -> None:
    instrument = Instrument.load(name)
    assert instrument.name == name
    values = {field: getattr(instrument, field) for field in Instrument.model_fields}
    given = {field for field, value in values.items() if value is not None and not isinstance(value, tuple)}
    assert set(instrument.sources) == given - {"name", "notice", "sources"}
    assert all(source[:3] in ("P: ", "D: ", "C: ", "A: ") for source in instrument.sources.values())
    assert not any("no source" in source for source in instrument.sources.values())
    assert "not a flight calibration" in instrument.notice


def test_mauve_electrons_differs_only_in_counting(mauve: Instrument) -> None:
    electrons = Instrument.load("mauve-electrons")
    assert (mauve.dark_unit, electrons.dark_unit) == ("DN", "electrons")
    assert electrons != mauve
    assert electrons.with_(dark_unit="DN", photon_noise="gaussian") == mauve


def test_with_returns_a_marked_copy(mauve: Instrument) -> None:
    cold = mauve.with_(temperature_c=13, grating_efficiency=0.5)
    assert (mauve.temperature_c, cold.temperature_c) == (21, 13)
    assert cold.grating_efficiency.at([200, 700]).tolist() == [0.5, 0.5]
    assert cold.sources["temperature_c"].startswith("U: ")
    assert cold.sources["grating_efficiency"].startswith("U: ")
    assert cold.sources["light_loss"] == mauve.sources["light_loss"]
    assert cold.digest != mauve.digest
    assert mauve.with_(name="renamed").digest == mauve.digest
    assert {mauve: 1}[mauve.with_(temperature_c=21.0)] == 1


CURVE = """# %ECSV 1.0
# ---
# datatype:
# - {name: wavelength, unit: Angstrom, datatype: float64}
# - {name: efficiency, unit: '', datatype: float64}
# meta: !!omap
# - {tag: D}
# - {source: measured}
# schema: astropy-2.0
wavelength efficiency
1900 0.2
7100 0.4
"""


def test_user_file_extends_an_embedded_instrument(tmp_path: Path, mauve: Instrument) -> None:
    (tmp_path / "grating.ecsv").write_text(CURVE)
    file = tmp_path / "mine.toml"
    file.write_text(
        'extends = "mauve"\nname = "mine"\nlight_loss = 0.2\ngrating_efficiency = "grating.ecsv"\n'
        'read_noise_dn = { value = 11, tag = "D", source = "lab" }\nwindow_efficiency = 0.9\n'
    )
    mine = Instrument.load(str(file))
    assert (mine.name, mine.light_loss, mine.read_noise_dn, mine.frame_s) == ("mine", 0.2, 11, 5)
    assert mine.grating_efficiency.at(450.0) == pytest.approx(0.3)
    assert mine.window_efficiency.at(450.0) == 0.9
    assert mine.sources["light_loss"] == "A: assumed, no source in mine.toml"
    assert mine.sources["read_noise_dn"] == "D: lab"
    assert mine.sources["grating_efficiency"] == "D: measured"
    assert mine.sources["bias_dn"] == mauve.sources["bias_dn"]
    # A file may extend a user's own, too.
    colder = tmp_path / "colder.toml"
    colder.write_text('extends = "mine.toml"\ntemperature_c = 13\n')
    assert Instrument.load(colder).with_(temperature_c=21) == mine


CURVE_UNITS = pytest.mark.parametrize(
    ("length", "unit", "per_nm", "value"),
    [("ANGSTROMS", "A / W", 10, 0.05), ("A", "A/W", 10, 0.05), ("microns", "A / W", 1e-3, 0.05),
     ("Nanometers", "mA / W", 1, 50.0), ("nm", "%", 1, 5.0), ("nm", "percent", 1, 5.0)],
)  # fmt: skip


@CURVE_UNITS
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


@pytest.mark.parametrize("name", [
    "grating_efficiency", "fibre_efficiency", "telescope_mirror_reflectivity", "spectrometer_mirror_reflectivity",
    "collection_lens_efficiency", "quantum_efficiency_a_per_w",
])  # fmt: skip
def test_instrument_without_throughput_raises(tmp_path: Path, mauve: Instrument, name: str) -> None:
    """Refuse two curves of which one is 0 at every wavelength, since all S/N would be 0."""
    for file, values in (("below", (0.03, 0.03, 0.0, 0.0)), ("above", (0.0, 0.0, 0.03, 0.03))):
        at = (1000, 4500, 4501 if file == "below" else 4502, 9000)
        rows = "".join(f"{a} {value}\n" for a, value in zip(at, values, strict=True))
        unit = "A / W" if name == "quantum_efficiency_a_per_w" and file == "below" else ""
        text = CURVE.split("1900")[0].replace("unit: ''", f"unit: '{unit}'")
        (tmp_path / f"{file}.ecsv").write_text(text + rows)
    with refused("throughput", "0"):
        mauve.with_(**{name: tmp_path / "below.ecsv", "window_efficiency": tmp_path / "above.ecsv"})
    assert mauve.with_(**{name: tmp_path / "below.ecsv"}).throughput(300.0) > 0
