"""What files state of times, coordinates, units, media and missing values is used, in each spelling, or refused.

Each list holds the spellings of FITS (standard 4.0), OGIP, VOTable, CSV and the field's archives.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time
from refusals import refused

from mauvecl.host.neighbour_table import read_neighbours
from mauvecl.host.spectra.column_roles import role_of
from mauvecl.host.spectra.formats import read_spectrum
from mauvecl.host.tables.coordinates import position
from mauvecl.host.tables.medium import LOGICAL, NAMED
from mauvecl.host.tables.names import is_magnitude
from mauvecl.observations.frames import Frames, Reason
from mauvecl.observations.mapping import FrameMapping
from mauvecl.observations.reading import read_frames
from mauvecl.study.orbits import PlanTarget, read_targets

RNG = np.random.default_rng(4300)
N = 60
CADENCE_S = 120.0
FLUX = np.round(1000 + RNG.normal(0, 2, N), 3)
NM = np.arange(180.0, 1000.0, 2.0)
STAR = 1e-13 * (1 + 0.5 * np.sin(NM / 30)) * np.exp(-(((NM - 450) / 250) ** 2))
#: 500 nm in air, in vacuum, by SDSS (https://www.sdss.org/dr7/products/spectra/vacwavelength.html).
AIR_500 = 500.1394


def light_curve(
    path: Path, time: Any, header: dict[str, Any] | None = None, name: str = "TIME", unit: str = ""
) -> Path:
    """Write a light curve as FITS."""
    columns = [fits.Column(name, "D", unit or None, array=np.asarray(time)), fits.Column("FLUX", "D", array=FLUX)]
    hdu = fits.BinTableHDU.from_columns(columns)
    hdu.header.update(header or {})
    hdu.writeto(path)
    return path


def first_mjd(frames: Frames) -> float | None:
    return None if frames.reference_mjd is None else frames.reference_mjd + frames.time_s[0] / 86_400


DAYS = np.arange(N) * CADENCE_S / 86_400
#: Unit of times, numbers of the first time and of a day in it, and the MJD of the first; None for no date.
TIME_UNITS: list[tuple[str, float, float, float | None, str]] = [
    ("BJD - 2457000, days", 1000.0, 1.0, 57_999.5, ""),
    ("BJD - 2454833", 3000.0, 1.0, 57_832.5, ""),
    ("BJD-2457000", 1000.0, 1.0, 57_999.5, ""),
    ("btjd", 1000.0, 1.0, 57_999.5, "tdb"),
    ("BTJD", 1000.0, 1.0, 57_999.5, "tdb"),
    ("bkjd", 3000.0, 1.0, 57_832.5, "tdb"),
    ("jd", 2_458_000.0, 1.0, 57_999.5, ""),
    ("BJD", 2_458_000.0, 1.0, 57_999.5, ""),
    ("BJD_TDB", 2_458_000.0, 1.0, 57_999.5, "tdb"),
    ("HJD - 2450000", 8000.0, 1.0, 57_999.5, ""),
    ("mjd", 57_999.5, 1.0, 57_999.5, ""),
    ("MJD (UTC)", 57_999.5, 1.0, 57_999.5, "utc"),
    ("days since 2017-09-03T12:00:00", 0.0, 1.0, 57_999.5, "utc"),
    ("seconds since 2017-09-03T12:00:00 TDB", 0.0, 86_400.0, 57_999.5, "tdb"),
    ("d", 5.0, 1.0, None, ""),
    ("day", 5.0, 1.0, None, ""),
    ("days", 5.0, 1.0, None, ""),
    ("h", 5.0, 24.0, None, ""),
    ("hr", 5.0, 24.0, None, ""),
    ("hours", 5.0, 24.0, None, ""),
    ("min", 5.0, 1440.0, None, ""),
    ("minutes", 5.0, 1440.0, None, ""),
    ("s", 5.0, 86_400.0, None, ""),
    ("sec", 5.0, 86_400.0, None, ""),
    ("seconds", 5.0, 86_400.0, None, ""),
    ("ms", 5.0, 86_400e3, None, ""),
]


@pytest.mark.parametrize(("unit", "first", "per_day", "mjd", "scale"), TIME_UNITS)
def test_units_of_times_give_cadence_and_date(
    unit: str, first: float, per_day: float, mjd: float | None, scale: str, tmp_path: Path
) -> None:
    times = first + DAYS * per_day
    frames = [read_frames(light_curve(tmp_path / "a.fits", times, unit=unit))]
    # The same in the name of a column.
    table = Table({f"time [{unit}]": times, "flux": FLUX})
    table.write(tmp_path / "a.csv", format="ascii.csv")
    frames.append(read_frames(tmp_path / "a.csv"))
    for one in frames:
        assert one.cadence_s == pytest.approx(CADENCE_S, abs=1e-3)
        assert first_mjd(one) == (None if mjd is None else pytest.approx(mjd, abs=1e-8))
        assert one.scale == scale


#: Keywords, first time and its unit, and the MJD of the first time.
TIME_KEYWORDS: list[tuple[dict[str, Any], float, str, float]] = [
    ({"MJDREFI": 55_000, "MJDREFF": 0.5, "TIMEZERO": 86_400.0, "TIMEUNIT": "s"}, 0.0, "s", 55_001.5),
    ({"MJDREF": 55_000.5, "TIMEZERO": 86_400.0}, 0.0, "s", 55_001.5),
    ({"MJDREF": 55_000.5, "TIMEZERI": 86_400, "TIMEZERF": 43_200.0}, 0.0, "s", 55_002.0),
    ({"MJDREF": 55_000.5, "TIMEZERI": 1, "TIMEUNIT": "d"}, 0.0, "s", 55_001.5),
    ({"MJDREF": 55_000.5, "TIMEOFFS": 1.0, "TIMEUNIT": "d"}, 43_200.0, "s", 55_002.0),
    ({"MJDREF": 55_000.5, "TIMEZERO": 86_400.0, "TIMEUNIT": "s"}, 1.0, "d", 55_002.5),
    ({"MJDREFF": 0.5, "MJDREFI": 55_000}, 0.0, "s", 55_000.5),
    ({"MJDREFF": 55_000.5}, 0.0, "s", 55_000.5),
    ({"MJDREF": 1.0, "MJDREFI": 55_000, "MJDREFF": 0.5}, 0.0, "s", 55_000.5),
    ({"DATEREF": "2009-06-18T12:00:00"}, 0.0, "s", 55_000.5),
    ({"DATEREF": "2009-06-18", "TIMESYS": "TDB"}, 43_200.0, "s", 55_000.5),
    ({"MJDREF": 55_000.5, "DATEREF": "1999-01-01"}, 0.0, "s", 55_000.5),
    ({"JDREF": 2_455_001.0}, 0.0, "s", 55_000.5),
    ({"HJDREF": 2_455_001.0}, 0.0, "s", 55_000.5),
    ({"BJDREFI": 2_454_833, "BJDREFF": 0.5}, 167.5, "d", 55_000.5),
]


@pytest.mark.parametrize(("header", "first", "unit", "mjd"), TIME_KEYWORDS)
def test_keywords_of_times_give_the_date(
    header: dict[str, Any], first: float, unit: str, mjd: float, tmp_path: Path
) -> None:
    times = first + (DAYS * u.d).to_value(unit)
    assert first_mjd(read_frames(light_curve(tmp_path / "a.fits", times, header, unit=unit))) == pytest.approx(
        mjd, abs=1e-8
    )
    # A table of another format has the same keywords in its header.
    table = Table(
        {"time": times * u.Unit(unit), "flux": FLUX}, meta={key.lower(): value for key, value in header.items()}
    )
    table.write(tmp_path / "a.ecsv")
    assert first_mjd(read_frames(tmp_path / "a.ecsv")) == pytest.approx(mjd, abs=1e-8)


def test_offsets_without_a_unit_and_epochs_that_differ_raise(tmp_path: Path) -> None:
    with refused("TIMEUNIT", "TIMEZERO"):
        read_frames(light_curve(tmp_path / "a.fits", DAYS, {"MJDREF": 55_000.0, "TIMEZERO": 5.0}, unit="d"))
    with refused("epoch", "'TIME'", "54832.5", "56999.5"):
        read_frames(light_curve(tmp_path / "b.fits", DAYS + 5, {"BJDREFI": 2_457_000}, unit="bkjd"))
    mapping = FrameMapping(time="TIME", flux="FLUX", epoch="btjd")
    assert first_mjd(read_frames(tmp_path / "b.fits", mapping)) == pytest.approx(57_004.5)
    with refused("DATEREF", "yesterday"):
        read_frames(light_curve(tmp_path / "c.fits", DAYS, {"DATEREF": "yesterday"}, unit="d"))


@pytest.mark.parametrize("date", ["2017/09/04 00:00:00", "04.09.2017", "09/04/2017 12:00", "4 Sep 2017", "yesterday"])
def test_dates_in_other_forms_raise(date: str, tmp_path: Path) -> None:
    Table({"time": [f"{date}"] * N, "flux": FLUX}).write(tmp_path / "a.csv", format="ascii.csv")
    with refused("time", date, "row 1", expected="2026-03-01T12:00:00"):
        read_frames(tmp_path / "a.csv")


#: Text of coordinates, and what astropy must be told to read the same.
COORDINATES: list[tuple[str, str, Any]] = [
    ("10.5 -3.0", "10.5 -3.0", "deg"),
    ("10.5 −3.0", "10.5 -3.0", "deg"),
    ("10.5 –3.0", "10.5 -3.0", "deg"),
    ("10.5\u00a0-3.0", "10.5 -3.0", "deg"),
    ("10.5\u2009+3.0", "10.5 3.0", "deg"),
    ("10.5, -3.0", "10.5 -3.0", "deg"),
    ("10.5; -3.0", "10.5 -3.0", "deg"),
    ("(10.5, -3.0)", "10.5 -3.0", "deg"),
    ("10.5 3e-05", "10.5 0.00003", "deg"),
    ("1.05e1 -3E-5", "10.5 -0.00003", "deg"),
    ("290.68+11.12", "290.68 11.12", "deg"),
    ("RA=10.5 Dec=-3.0", "10.5 -3.0", "deg"),
    ("10.5d -3d", "10.5 -3", "deg"),
    ("10.5° -3°", "10.5 -3", "deg"),
    ("10.5 deg -3 deg", "10.5 -3", "deg"),
    ("0.18rad -0.05rad", "0.18 -0.05", "rad"),
    ("0.7h -3d", "0.7 -3", ("hourangle", "deg")),
    ("19h22m00s -11d12m00s", "19h22m00s -11d12m00s", None),
    ("19h22m -11d12m", "19h22m -11d12m", None),
    ("19h22m00.5s −11°12′00″", "19h22m00.5s -11d12m00s", None),
    ("19:22:00 -11:12:00", "19:22:00 -11:12:00", ("hourangle", "deg")),
    ("19:22 -11:12", "19:22 -11:12", ("hourangle", "deg")),
    ("19:22:00.5 -11.2", "19:22:00.5 -11.2", ("hourangle", "deg")),
    ("05 34 31.94 +22 00 52.2", "05 34 31.94 +22 00 52.2", ("hourangle", "deg")),
]


@pytest.mark.parametrize(("text", "plain", "unit"), COORDINATES)
def test_coordinates_are_those_of_astropy(text: str, plain: str, unit: Any) -> None:
    place = SkyCoord(plain, unit=unit) if unit else SkyCoord(plain)
    np.testing.assert_allclose(position(text), (place.ra.deg, place.dec.deg), atol=1e-10)


@pytest.mark.parametrize(
    "text",
    ["10,5 -3,0", "10 5 -3 0", "nan nan", "10.5", "10.5 -3 7", "400 3", "10.5 100", "-5 3", "25:00:00 -3", "10.5 x",
     "inf 3", "10.5m -3", "B1950 10.5h"],
)  # fmt: skip
def test_other_coordinates_raise(text: str) -> None:
    with refused("target", "right ascension and declination"):
        position(text)


#: Columns of a table of targets by name with units, or texts, which all say RA 10.5, Dec -3 and 20 pc.
POSITIONS: list[dict[str, Any]] = [
    {"ra": [10.5] * u.deg, "dec": [-3.0] * u.deg, "distance_pc": [20.0] * u.pc},
    {"ra": [0.7] * u.hourangle, "dec": [-3.0] * u.deg, "distance": [0.02] * u.kpc},
    {"RA": [10.5] * u.deg, "DEC": [-180.0] * u.arcmin, "Distance": [65.231276] * u.lyr},
    {"RAJ2000": [np.radians(10.5)] * u.rad, "DEJ2000": [np.radians(-3.0)] * u.rad, "parallax": [50.0] * u.mas},
    {"_RAJ2000": [37_800.0] * u.arcsec, "_DEJ2000": [-10_800.0] * u.arcsec, "Plx": [0.05] * u.arcsec},
    {"ra_hours": [0.7], "dec_deg": [-3.0], "distance (kpc)": [0.02]},
    {"RA_ICRS": ["00:42:00"], "DE_ICRS": ["-03:00:00"], "distance (pc)": [20.0]},
    {"ra": ["0h42m00s"], "dec": ["−3d00m00s"], "dist_pc": [20.0]},
    {"ra": ["00 42 00"], "dec": ["-03 00 00"], "d_pc": ["20"]},
    {"coordinates": ["00:42:00 -03:00:00"], "distance_pc": [20.0]},
]


@pytest.mark.parametrize("columns", POSITIONS, ids=[" ".join(one) for one in POSITIONS])
@pytest.mark.parametrize("ending", ["ecsv", "fits", "vot"])
def test_columns_of_stars_are_in_the_unit_that_they_state(columns: dict[str, Any], ending: str, tmp_path: Path) -> None:
    if ending == "fits" and any(
        getattr(one, "unit", None) == u.hourangle or "−" in str(one) for one in columns.values()
    ):
        pytest.skip("FITS has no such unit or letter")
    path = tmp_path / f"a.{ending}"
    table = Table({"Name": ["0012"], **columns, "colour": [0.3]})
    table.write(path, format={"vot": "votable", "ecsv": "ascii.ecsv", "fits": "fits"}[ending])
    (one,) = read_targets(path)
    target = PlanTarget.model_validate(one)
    place = target.target(simbad=False)
    assert (place.ra_deg, place.dec_deg) == (pytest.approx(10.5, abs=1e-9), pytest.approx(-3.0, abs=1e-9))
    assert target.distance_pc == pytest.approx(20.0, rel=1e-6)
    assert (target.name, target.unused) == ("0012", ("colour",))


def test_tables_of_vizier_and_the_exoplanet_archive_are_read(tmp_path: Path) -> None:
    (tmp_path / "v.tsv").write_text(
        '#RESOURCE=yCat\n#\n_RAJ2000;_DEJ2000;Name;Vmag;Plx\n"h:m:s";"d:m:s";;mag;mas\n---;---;---;---;---\n'
        "00 42 00;-03 00 00;0012;8.0;50\n00 46 00;-03 00 00;0013;;\n"
    )
    first, second = (PlanTarget.model_validate(one) for one in read_targets(tmp_path / "v.tsv"))
    assert first.target(simbad=False).ra_deg == pytest.approx(10.5)
    assert (first.name, first.magnitude, first.distance_pc) == ("0012", 8.0, 20.0)
    assert (second.name, second.magnitude, second.distance_pc) == ("0013", None, None)
    (tmp_path / "e.csv").write_text(
        "# This file was produced by the NASA Exoplanet Archive\n#\nhostname,ra,dec,sy_vmag,st_spectype,st_age\n"
        "B,10.5,-3,8,K5V,4\n"
    )
    (one,) = read_targets(tmp_path / "e.csv")
    assert (one["name"], one["magnitude"], one["spectral_type"], one["unused"]) == ("B", 8.0, "K5V", ("st_age",))


def test_systems_of_votable_count(tmp_path: Path) -> None:
    """TIMESYS (VOTable 1.4) states epoch, scale and place of times, as in Gaia's light curves; COOSYS the frame."""
    table = Table({"time": DAYS * u.d, "flux": FLUX})
    table.write(tmp_path / "a.vot", format="votable")
    text = (tmp_path / "a.vot").read_text()
    said = '<TIMESYS ID="t" timeorigin="2455197.5" timescale="TCB" refposition="BARYCENTER"/>'
    (tmp_path / "a.vot").write_text(text.replace("<TABLE", f"{said}<TABLE", 1))
    found = read_frames(tmp_path / "a.vot")
    assert (first_mjd(found), found.scale, found.position) == (pytest.approx(55_197.0), "tcb", "BARYCENTER")
    stars = Table({"name": ["B"], "ra": [10.5] * u.deg, "dec": [-3.0] * u.deg})
    stars.write(tmp_path / "b.vot", format="votable")
    text = (tmp_path / "b.vot").read_text()
    (tmp_path / "b.vot").write_text(text.replace("<TABLE", '<COOSYS ID="c" system="eq_FK4" equinox="B1950"/><TABLE', 1))
    with refused("ra", "eq_FK4"):
        read_targets(tmp_path / "b.vot")


@pytest.mark.parametrize(
    "name", ["BJD", "MJD", "HJD", "BJD_TDB", "time_bjd", "TMID_BJD", "mjd_obs", "BJD - 2457000", "JD (UTC)"]
)
def test_names_of_dates_are_times(name: str, tmp_path: Path) -> None:
    zero = 2_457_000.0 if "-" in name else 2_400_000.5 if "mjd" in name.lower() else 0.0
    Table({name: 2_458_000.0 - zero + DAYS, "flux": FLUX}).write(tmp_path / "a.csv", format="ascii.csv")
    assert first_mjd(read_frames(tmp_path / "a.csv")) == pytest.approx(57_999.5, abs=1e-8)


def test_units_of_other_kinds_raise(tmp_path: Path) -> None:
    Table({"name": ["a"], "ra": [10.5] * u.s, "dec": [3.0] * u.deg}).write(tmp_path / "a.ecsv")
    with refused("ra", "'s'"):
        read_targets(tmp_path / "a.ecsv")
    Table({"name": ["AU Mic"], "distance_pc": [9.7] * u.s}).write(tmp_path / "b.ecsv")
    with refused("distance_pc", "'s'"):
        read_targets(tmp_path / "b.ecsv")


@pytest.mark.parametrize("cell", ["", "null", "NULL", "nan", "NaN", "None", "N/A", "--", "---", "-"])
def test_cells_without_a_value_are_missing(cell: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f"name,ra,dec,V,sptype\nAU Mic,{cell},{cell},{cell},{cell}\nB,10.5,-3,8,K5V\n")
    first, second = read_targets(tmp_path / "a.csv")
    assert first == {"name": "AU Mic"}
    assert (second["magnitude"], second["spectral_type"]) == (8.0, "K5V")
    (tmp_path / "n.csv").write_text(f"source_id,separation,phot_g_mean_mag,teff_gspphot\n1,3,12,{cell}\n2,4,13,5000\n")
    stars, _ = read_neighbours(tmp_path / "n.csv")
    assert [star.temperature_k for star in stars] == [None, 5000.0]
    rows = "".join(f"{k * CADENCE_S},{cell if k == 3 else value}\n" for k, value in enumerate(FLUX))
    (tmp_path / "l.csv").write_text(f"time (s),flux\n{rows}")
    frames = read_frames(tmp_path / "l.csv")
    assert np.flatnonzero(frames.faults & Reason.NOT_FINITE).tolist() == [3]


@pytest.mark.parametrize(
    ("separator", "end", "head"), [(",", ",", ""), (",", ",", ","), (";", ";", ""), ("\t", "\t", "\t")]
)
def test_separators_at_the_end_of_lines_are_no_cells(separator: str, end: str, head: str, tmp_path: Path) -> None:
    rows = "".join(f"{k * CADENCE_S}{separator}{value}{end}\n" for k, value in enumerate(FLUX))
    (tmp_path / "a.csv").write_text(f"time (s){separator}flux{head}\n{rows}")
    np.testing.assert_array_equal(read_frames(tmp_path / "a.csv").flux, FLUX)
    # An empty column that has a name is one.
    (tmp_path / "b.csv").write_text(f"time (s){separator}flux{separator}note\n{rows}")
    np.testing.assert_array_equal(read_frames(tmp_path / "b.csv").flux, FLUX)
    with refused("column", "flux, note"):
        read_frames(tmp_path / "b.csv", FrameMapping(time="time (s)", flux="another"))


def test_rows_of_units_below_the_names_count(tmp_path: Path) -> None:
    rows = "".join(f"{day},{value},2\n" for day, value in zip(DAYS, FLUX, strict=True))
    (tmp_path / "a.csv").write_text(f"time,flux [ct/s],flux_err\ndays,,\n{rows}")
    found = read_frames(tmp_path / "a.csv")
    assert (found.n_frames, found.unit) == (N, "ct/s")
    assert found.cadence_s == pytest.approx(CADENCE_S, abs=1e-3)
    assert found.error is not None
    (tmp_path / "t.csv").write_text("name,ra,dec,distance\n,hourangle,deg,kpc\nB,0.7,-3,0.02\n")
    (one,) = read_targets(tmp_path / "t.csv")
    assert (one["coordinates"], one["distance_pc"]) == ("10.5 -3.0", 20.0)
    # Names that are units as well stay rows.
    (tmp_path / "n.csv").write_text("name,V\nm,8\ns,9\n")
    assert [one["name"] for one in read_targets(tmp_path / "n.csv")] == ["m", "s"]


def test_names_that_differ_in_case_are_told_apart(tmp_path: Path) -> None:
    columns = {"TIME": DAYS * 86_400, "Flux": FLUX, "FLUX": 2 * FLUX}
    Table(columns).write(tmp_path / "a.csv", format="ascii.csv")
    Table(columns).write(tmp_path / "a.ecsv")
    for name, factor in (("Flux", 1), ("FLUX", 2)):
        for ending in ("csv", "ecsv"):
            found = read_frames(tmp_path / f"a.{ending}", FrameMapping(time="time", time_unit="s", flux=name))
            np.testing.assert_allclose(found.flux, factor * FLUX)
    with refused("column", "'flux'", "Flux, FLUX"):
        read_frames(tmp_path / "a.csv", FrameMapping(time="time", time_unit="s", flux="flux"))
    with refused("flux", "'Flux'", "'FLUX'"):
        read_frames(tmp_path / "a.csv")


@pytest.mark.parametrize(
    "name", ["mag", "Magnitude", "Vmag", "V_mag", "mag_V", "INST_MAG", "Gmag", "MAG1", "kepmag", "KpMag", "log_flux",
             "ln_flux", "delta mag"],
)  # fmt: skip
def test_magnitudes_and_logarithms_are_not_linear_light(name: str, tmp_path: Path) -> None:
    Table({"time (s)": DAYS * 86_400, name: FLUX}).write(tmp_path / "a.csv", format="ascii.csv")
    with refused("flux", name):
        read_frames(tmp_path / "a.csv", FrameMapping(time="time (s)", flux=name))
    assert read_frames(tmp_path / "a.csv", FrameMapping(time="time (s)", flux=name, flux_unit="ct")).n_frames == N


@pytest.mark.parametrize("name", ["flux", "image", "magnetic", "imager_flux", "rate", "logistic"])
def test_other_names_are_linear_light(name: str) -> None:
    assert not is_magnitude(name)


PER_FREQUENCY = ["f_nu", "fnu", "F_nu", "FLUX_NU", "flux_nu", "Fν", "f_ν", "S_nu", "I_nu", "flux_density_nu",
                 "flux_freq", "FLUX_FREQUENCY", "flux_hz"]  # fmt: skip
PER_WAVELENGTH = ["f_lambda", "flam", "FLUX_LAMBDA", "flux_lam", "flux", "S_lambda", "flux_wl"]


@pytest.mark.parametrize("name", [*PER_FREQUENCY, *PER_WAVELENGTH])
def test_names_say_whether_a_flux_is_per_frequency(name: str, tmp_path: Path) -> None:
    nu = STAR * NM**2  # proportional to F_nu
    Table({"wavelength_nm": NM, name: nu}).write(tmp_path / "a.csv", format="ascii.csv")
    found = read_spectrum(tmp_path / "a.csv")
    wanted = STAR if name in PER_FREQUENCY else nu
    np.testing.assert_allclose(found.flux_flam / found.flux_flam[100], wanted / wanted[100], rtol=1e-9)
    if name.isascii():
        hdu = fits.table_to_hdu(Table({"WAVELENGTH": NM * 10, name: nu}))
        hdu.writeto(tmp_path / "a.fits")
        found = read_spectrum(tmp_path / "a.fits")
        np.testing.assert_allclose(found.flux_flam / found.flux_flam[100], wanted / wanted[100], rtol=1e-9)


def test_descriptors_of_votable_say_whether_a_flux_is_per_frequency() -> None:
    assert role_of("value", None, "phot.flux.density;em.freq").per_frequency
    assert not role_of("value", None, "phot.flux.density;em.wl").per_frequency


WORDS: dict[str, tuple[Any, ...]] = {
    "air": ("air", "AIR", "in air", "Air wavelengths"),
    "vacuum": ("vac", "vacuum", "VACUUM"),
}
TRUTHS: dict[bool, tuple[Any, ...]] = {True: (True, 1, "T", "true", "yes"), False: (False, 0, "F", "no")}
MEDIA = [(name, value, medium) for name in NAMED for medium, values in WORDS.items() for value in values] + [
    (name, value, medium if truth else {"air": "vacuum", "vacuum": "air"}[medium])
    for name, medium in LOGICAL.items()
    for truth, values in TRUTHS.items()
    for value in values
]


@pytest.mark.parametrize("medium", ["air", "vacuum"])
def test_keywords_say_air_or_vacuum(medium: str, tmp_path: Path) -> None:
    for k, (name, value, said) in enumerate(MEDIA):
        if said != medium:
            continue
        hdu = fits.table_to_hdu(Table({"WAVELENGTH": NM * 10, "FLUX": STAR}))
        if len(name) <= 8:
            hdu.header[name] = value
            hdu.writeto(tmp_path / f"{k}.fits")
        table = Table({"wavelength": NM * u.nm, "flux": STAR * u.Unit("erg / (s cm2 AA)")}, meta={name.lower(): value})
        table.write(tmp_path / f"{k}.ecsv")
        text = f"# {name} = {value}\n# wavelength (nm), flux\n" + "".join(
            f"{x} {y}\n" for x, y in zip(NM, STAR, strict=True)
        )
        (tmp_path / f"{k}.txt").write_text(text)
        for path in tmp_path.glob(f"{k}.*"):
            nm = read_spectrum(path).wavelength_nm[160]
            assert nm == pytest.approx(AIR_500 if medium == "air" else 500.0, abs=1e-4), (path.suffix, name, value)


@pytest.mark.parametrize("where", ["comment of the name", "TCOMM", "description", "COMMENT"])
def test_words_beside_a_column_say_air(where: str, tmp_path: Path) -> None:
    path = tmp_path / ("a.ecsv" if where == "description" else "a.fits")
    table = Table({"wavelength": NM * u.nm, "flux": STAR * u.Unit("erg / (s cm2 AA)")})
    if where == "description":
        table["wavelength"].info.description = "wavelength in air"
        table.write(path)
    else:
        hdu = fits.table_to_hdu(table)
        if where == "comment of the name":
            hdu.header.comments["TTYPE1"] = "wavelength in air"
        else:
            hdu.header["TCOMM1" if where == "TCOMM" else "COMMENT"] = "wavelength in air"
        hdu.writeto(path)
    assert read_spectrum(path).wavelength_nm[160] == pytest.approx(AIR_500, abs=1e-4)


@pytest.mark.parametrize("unit", ["Angstrom air", "nm (air)", "nm_air", "Angstrom (in air)"])
def test_units_say_air(unit: str, tmp_path: Path) -> None:
    hdu = fits.table_to_hdu(Table({"W": NM * (1 if unit.startswith("nm") else 10), "FLUX": STAR}))
    hdu.columns[0].unit = unit
    hdu.columns[0].name = "WAVELENGTH"
    hdu.writeto(tmp_path / "a.fits")
    assert read_spectrum(tmp_path / "a.fits").wavelength_nm[160] == pytest.approx(AIR_500, abs=1e-4)


def test_keywords_that_contradict_each_other_raise(tmp_path: Path) -> None:
    hdu = fits.table_to_hdu(Table({"WAVELENGTH": NM * 10, "FLUX": STAR}))
    hdu.header["AIRORVAC"] = "air"
    hdu.header["VACUUM"] = True
    hdu.writeto(tmp_path / "a.fits")
    with refused("wavelength_unit", "AIRORVAC says air", "VACUUM says vacuum"):
        read_spectrum(tmp_path / "a.fits")
    found = read_spectrum(tmp_path / "a.fits", wavelength_unit="Angstrom air")
    assert found.wavelength_nm[160] == pytest.approx(AIR_500, abs=1e-4)
    hdu.header["VACUUM"] = "perhaps"
    hdu.writeto(tmp_path / "b.fits")
    with refused("VACUUM", "perhaps"):
        read_spectrum(tmp_path / "b.fits")


def test_keywords_say_the_medium_of_frames(tmp_path: Path) -> None:
    spectra = RNG.normal(1000, 5, (N, NM.size))
    primary = fits.PrimaryHDU(spectra)
    primary.header.update({"CTYPE1": "LINEAR", "CRVAL1": 180.0, "CDELT1": 2.0, "CRPIX1": 1, "CUNIT1": "nm"})
    times = fits.BinTableHDU.from_columns([fits.Column("T", "D", "s", array=DAYS * 86_400)])
    for k, (header, nm) in enumerate([({}, 500.0), ({"AIRORVAC": "air"}, AIR_500), ({"CTYPE1": "AWAV"}, AIR_500),
                                      ({"CTYPE1": "WAVE"}, 500.0)]):  # fmt: skip
        primary.header.update(header)
        fits.HDUList([primary, times]).writeto(tmp_path / f"{k}.fits")
        primary.header.remove("AIRORVAC", ignore_missing=True)
        found = read_frames(tmp_path / f"{k}.fits", FrameMapping(time="T", flux="0", wavelength="wcs"))
        assert found.wavelength_nm is not None
        assert found.wavelength_nm[160] == pytest.approx(nm, abs=1e-4), header


#: Format, TSCAL, TZERO and TNULL of a column of integers.
SCALED = [("J", 1e-17, 0.0, 99_999_999), ("I", 1e-17, 1e-14, -32_768), ("I", None, 32_768, 32_767),
          ("B", 1e-16, 0.0, 255), ("K", 1e-17, 5e-14, -(2**60))]  # fmt: skip


@pytest.mark.parametrize(("form", "scale", "zero", "null"), SCALED)
def test_marks_of_missing_values_are_compared_before_scaling(
    form: str, scale: float | None, zero: float, null: int, tmp_path: Path
) -> None:
    kinds = {"J": np.int32, "I": np.int16, "B": np.uint8, "K": np.int64}
    stored = (np.arange(N) % 100 + 1).astype(kinds[form])
    stored[7] = null
    hdu = fits.BinTableHDU.from_columns(
        [fits.Column("TIME", "D", "s", array=DAYS * 86_400), fits.Column("FLUX", form, array=stored, null=null)]
    )
    # As bytes: astropy would scale the numbers when it writes them.
    if scale is not None:
        hdu.header["TSCAL2"] = scale
    hdu.header["TZERO2"] = zero
    with io.BytesIO() as buffer:
        fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(buffer)
        content = buffer.getvalue()
    (tmp_path / "a.fits").write_bytes(content)
    found = read_frames(tmp_path / "a.fits")
    assert np.flatnonzero(~np.isfinite(found.flux)).tolist() == [7]
    good = np.arange(N) != 7
    np.testing.assert_allclose(found.flux[good], stored[good] * (scale or 1.0) + zero, rtol=1e-6)


def test_marks_of_missing_values_in_tables_of_text(tmp_path: Path) -> None:
    """Compare with TNULL of an ASCII table, which astropy reads as zero, and with BLANK of an image."""
    flux = [f"{value:10.3f}" for value in FLUX]
    columns = [fits.Column("TIME", "F12.3", unit="s", array=DAYS * 86_400, ascii=True),
               fits.Column("FLUX", "F10.3", array=FLUX, null="---", ascii=True)]  # fmt: skip
    hdu = fits.TableHDU.from_columns(columns)
    hdu.writeto(tmp_path / "a.fits")
    content = (tmp_path / "a.fits").read_bytes()
    assert content.count(flux[7].encode()) == 1
    (tmp_path / "a.fits").write_bytes(content.replace(flux[7].encode(), b"       ---"))
    found = read_frames(tmp_path / "a.fits")
    assert np.flatnonzero(~np.isfinite(found.flux)).tolist() == [7]


def test_dates_of_tables_of_astropy_keep_scale_and_epoch(tmp_path: Path) -> None:
    when = Time(58_000.0 + DAYS, format="mjd", scale="tdb")
    for form in ("jd", "mjd", "isot", "unix", "decimalyear"):
        table = Table({"time": Time(when, format=form), "flux": FLUX})
        table.write(tmp_path / f"{form}.ecsv")
        found = read_frames(tmp_path / f"{form}.ecsv")
        assert first_mjd(found) == pytest.approx(58_000.0, abs=1e-6)
        assert found.scale == "tdb"
