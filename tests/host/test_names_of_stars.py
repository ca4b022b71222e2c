"""Names of stars, wherever a star can be given."""

from __future__ import annotations

import pytest
from refusals import refused

from mauvecl.host.orbit.targets import Target
from mauvecl.host.sky.helioecliptic import parse_position
from mauvecl.host.sky.zodiacal import Sky
from mauvecl.host.stars import catalogue, well_known
from mauvecl.host.stars.source import Source
from mauvecl.host.stars.star_names import all_names, near_names, resolve, spectrum_name
from mauvecl.host.tables.times import offline


@pytest.mark.parametrize(
    ("text", "name", "spectrum", "magnitude"),
    [
        ("M3", "M3V", "M3V", None),  # without luminosity class
        ("m3v", "M3V", "M3V", None),
        ("K3V", "K2.5V", "K2.5V", None),  # an alias
        ("K2.5", "K2.5V", "K2.5V", None),
        ("gj581", "GJ 581", "M3V", 10.57),  # a star with its own spectrum and an entry in the list
        ("HD 40307", "HD 40307", "K2.5V", 7.17),
        ("GX And", "GX And", "M1V", 8.09),  # the library has it as GJ 15A
        ("AU Mic", "AU Mic", None, 8.81),
        ("Proxima", "Proxima Cen", None, 11.01),
        ("HD 1835", "BE Cet", None, 6.39),
        ("GJ 354.1", "DX Leo", None, 7.05),  # a decimal point that counts
        ("epsilon Eridani", None, None, None),
        ("M3.5", "M3.5V", None, None),  # a type without a spectrum
        ("dM4.5", "M4.5V", None, None),
        ("M35", None, None, None),
        ("", None, None, None),
    ],
)
def test_names_are_resolved(text: str, name: str | None, spectrum: str | None, magnitude: float | None) -> None:
    star = resolve(text, own=False)
    assert (None if star is None else star.name) == name
    if star is not None:
        assert star.spectrum == spectrum
        assert (None if star.known is None else star.known.magnitude) == magnitude
        assert catalogue.embedded(star.nearest) is not None


def test_every_listed_name_is_found() -> None:
    for name in [*all_names(), *(other for star in well_known.stars() for other in star.others)]:
        assert resolve(name, own=False) is not None, name
    # No name stands for two stars.
    each = [well_known.name_key(name) for star in well_known.stars() for name in {star.name, *star.others}]
    assert len(each) == len(set(each))


def test_star_without_spectrum_is_proposed_another() -> None:
    with refused("star", "`star='M1V'` with `magnitude=8.81`", value="AU Mic"):
        spectrum_name("AU Mic")
    with refused("name", "`name='M1V'`", "`magnitude=8.81`", value="AU Mic"):
        Source.from_library("AU Mic")
    with refused("star", "`star='M3V'`", value="M3.5V"):
        spectrum_name("M3.5V")
    with refused("star", "AU Mic", value="AU Mik"):
        spectrum_name("AU Mik")


def test_near_names_have_coordinates_where_they_must() -> None:
    assert "G2V" in near_names("G2W")
    for name in near_names("G2W", stars_only=True):
        Target.of(name)


def test_sky_and_targets_know_the_same_stars() -> None:
    assert Sky.at("AU Mic", "2027-07-01").surface_brightness == pytest.approx(
        Sky.at("311.28971 -31.3409", "2027-07-01").surface_brightness, abs=1e-12
    )
    with offline():
        for star in well_known.stars():
            place = parse_position(star.name).icrs
            assert (place.ra.deg, place.dec.deg) == pytest.approx((star.ra_deg, star.dec_deg), abs=1e-9)
            assert Target.of(star.name).ra_deg == star.ra_deg
        with refused("target", "AU Mic", value="AU Mik"):
            parse_position("AU Mik")
