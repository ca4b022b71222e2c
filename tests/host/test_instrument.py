"""Values of the payload, and the content of users' instrument files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from mauvecl.host.instrument.curve import Curve
from mauvecl.host.instrument.instrument import CURVES, LABELS, Instrument

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
    assert set(instrument.sources) == given - {*LABELS}
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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('extends = "mauve"\nligth_loss = 0.2', ("ligth_loss", "'light_loss'")),
        ("light_loss = 0.2\nname = 'x'", ("notice",)),
        ("light_loss 0.2", ("file", "TOML", "1")),
        ('extends = "mauve"\nlight_loss = { tag = "P" }', ("light_loss", "'value'")),
        ('extends = "mauve"\nlight_loss = { value = 0.2, sauce = "x" }', ("light_loss", "'sauce'")),
        ('extends = "mauve"\nlight_loss = { value = 0.2, tag = "Z" }', ("tag", "light_loss", "'Z'")),
        ('extends = "mauve"\nfibre_efficiency = "none.ecsv"', ("file",)),
        ('extends = "mauve"\nfibre_efficiency = "short.ecsv"', ("fibre_efficiency", "250-710")),
        ('extends = "mauve"\nfibre_efficiency = "falling.ecsv"', ("wavelength_nm",)),
        ('extends = "mauve"\nfibre_efficiency = "negative.ecsv"', ("value", "190", "-0.2")),
        ('extends = "mauve"\nfibre_efficiency = "unitless.ecsv"', ("wavelength", "'none'", "nm")),
        ('extends = "mauve"\nfibre_efficiency = "text.ecsv"', ("file",)),
        ('extends = "mauve"\nfibre_efficiency = true', ("fibre_efficiency",)),
        ('extends = "bad.toml"', ("extends",)),
        ("extends = 3", ("instrument", "3")),
        ('extends = "mauve"\nsources = {}', ("sources",)),
    ],
)
def test_invalid_files_raise(tmp_path: Path, text: str, message: tuple[str, ...]) -> None:
    (tmp_path / "short.ecsv").write_text(CURVE.replace("1900", "2500"))
    (tmp_path / "falling.ecsv").write_text(CURVE.replace("1900", "7900"))
    (tmp_path / "negative.ecsv").write_text(CURVE.replace(" 0.2", " -0.2"))
    (tmp_path / "unitless.ecsv").write_text(CURVE.replace("unit: Angstrom, ", ""))
    (tmp_path / "text.ecsv").write_text("wavelength efficiency\n200 0.3\n")
    file = tmp_path / "bad.toml"
    file.write_text(text)
    with refused(*message):
        Instrument.load(file)


def test_curves_keep_their_end_values() -> None:
    curve = Curve((200.0, 300.0), (0.2, 0.4))
    assert curve.at([100.0, 200.0, 250.0, 900.0]).tolist() == pytest.approx([0.2, 0.2, 0.3, 0.4])
    assert curve.covers(200, 300)
    assert not curve.covers(199, 300)
    assert Curve.flat(0.5).covers(1, 1e6)


def curve_file(tmp_path: Path, length: str, value: str, wavelengths: str = "2000 5000 8000") -> Path:
    rows = "\n".join(f"{one} 0.5" for one in wavelengths.split())
    path = tmp_path / "curve.ecsv"
    path.write_text(
        "# %ECSV 1.0\n# ---\n# datatype:\n"
        f"# - {{name: wavelength, unit: '{length}', datatype: float64}}\n"
        f"# - {{name: value, unit: '{value}', datatype: float64}}\n# schema: astropy-2.0\nwavelength value\n{rows}\n"
    )
    return path


@pytest.mark.parametrize(
    ("length", "value", "wavelengths", "expected"),
    [
        ("ANGSTROMS", "A / W", "2000 5000 8000", 0.5),
        ("A", "A/W", "2000 5000 8000", 0.5),
        ("microns", "%", "0.2 0.5 0.8", 0.005),
        ("Nanometers", "percent", "200 500 800", 0.005),
    ],
)
def test_curve_units_in_any_spelling(
    tmp_path: Path, length: str, value: str, wavelengths: str, expected: float
) -> None:
    """Read A as Angstrom of a wavelength and as ampere of a sensitivity."""
    curve = Curve.read(curve_file(tmp_path, length, value, wavelengths))
    np.testing.assert_allclose(curve.wavelength_nm, [200.0, 500.0, 800.0])
    np.testing.assert_allclose(curve.value, expected)


@pytest.mark.parametrize(
    ("length", "value", "refusal"),
    [
        ("nm", "FLAM", ("value", "'FLAM'", "A / W")),
        ("nm", "erg / (s cm2 Angstrom)", ("value", "erg", "A / W")),
        ("furlong", "A / W", ("unit", "'furlong'")),
        ("s", "A / W", ("wavelength", "'s'", "nm")),
    ],
)
def test_spectrum_as_curve_raises(tmp_path: Path, length: str, value: str, refusal: tuple[str, ...]) -> None:
    with refused(*refusal):
        Curve.read(curve_file(tmp_path, length, value))


@pytest.mark.parametrize("name", CURVES)
def test_instrument_without_throughput_raises(name: str) -> None:
    """Refuse a curve that is 0 over the band, and two curves of which one is always 0, since all S/N would be 0."""
    mauve = Instrument.load("mauve")
    with refused("throughput"):
        mauve.with_(**{name: 0.0})
    below = Curve(np.array([100.0, 450.0, 450.1, 900.0]), np.array([0.03, 0.03, 0.0, 0.0]))
    above = Curve(np.array([100.0, 450.0, 450.2, 900.0]), np.array([0.0, 0.0, 0.03, 0.03]))
    other = "window_efficiency" if name != "window_efficiency" else "grating_efficiency"
    with refused("throughput", "0"):
        mauve.with_(**{name: below, other: above})
    assert mauve.with_(**{name: below}).throughput(300.0) > 0
