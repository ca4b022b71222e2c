"""Detectors whose pixels differ: effects of a map, and its files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mauvecl import Expectation, Instrument, PixelMap, Source, expect


def seen(payload: Instrument) -> Expectation:
    return expect(Source.from_library("G2V").at_magnitude(6.0), payload, exposure=5.0)


def test_each_column_changes_its_own_quantity() -> None:
    mauve = Instrument.load("mauve")
    plain = seen(mauve)
    n = np.arange(2048)
    given = PixelMap(
        response=1 + n / 4096, dark=1 + n / 1024, gain=1 - n / 8192, bias_dn=500.0 + n, read_noise_dn=10 + n / 500
    )
    uneven = seen(mauve.with_(pixel_map=given))
    part = mauve.read_pixels
    assert (part.start, part.stop - part.start) == (76, plain.wavelength_nm.size)
    np.testing.assert_allclose(uneven.source_electrons, plain.source_electrons * given.response[part], rtol=1e-12)
    np.testing.assert_allclose(uneven.dark_dn, plain.dark_dn * given.dark[part], rtol=1e-12)
    np.testing.assert_allclose(uneven.gain_dn_per_electron, plain.gain_dn_per_electron * given.gain[part], rtol=1e-12)
    np.testing.assert_array_equal(uneven.bias_dn, given.bias_dn[part])
    np.testing.assert_array_equal(uneven.read_noise_dn, given.read_noise_dn[part])
    only_dark = seen(mauve.with_(pixel_map=PixelMap(dark=given.dark)))
    np.testing.assert_array_equal(only_dark.source_electrons, plain.source_electrons)
    assert mauve.with_(pixel_map=given).digest != mauve.digest


def test_written_maps_are_read_back(tmp_path: Path) -> None:
    made = PixelMap.made_up(2048, seed=3, hot_share=0.01, hot_dark=50.0)
    assert 5 < np.sum(made.dark > 10) < 50
    made.write(tmp_path / "map.ecsv")
    again = PixelMap.read(tmp_path / "map.ecsv")
    assert again.digest == made.digest
    assert again.source == "A: made up, seed 3"
    (tmp_path / "own.toml").write_text('extends = "mauve"\nname = "own"\npixel_map = "map.ecsv"\n')
    payload = Instrument.load(tmp_path / "own.toml")
    assert payload.pixel_map is not None
    assert payload.pixel_map.digest == made.digest
    assert payload.sources["pixel_map"] == made.source
