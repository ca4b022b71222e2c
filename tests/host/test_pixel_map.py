"""Detectors whose pixels differ: effects of a map, its files, and refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from refusals import refused

from mauvecl.host.expectation import Expectation, expect
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.host.instrument.pixel_map import PixelMap
from mauvecl.host.stars.source import Source


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


def test_files_that_are_not_maps_raise(tmp_path: Path) -> None:
    path = tmp_path / "map.ecsv"
    for text, refusal in (
        (None, ("file",)),
        ("nonsense", ("file",)),
        ("# %ECSV 1.0\n# ---\n# datatype:\n# - {name: heat, datatype: float64}\nheat\n1.0\n", ("pixel_map", "'heat'")),
        ("# %ECSV 1.0\n# ---\n# datatype:\n# - {name: pixel, datatype: int64}\npixel\n0\n", ("pixel_map",)),
        (
            "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: pixel, datatype: int64}\n# - {name: dark, datatype: float64}\n"
            "pixel dark\n1 1.0\n",
            ("pixel", "0", "1", "2"),
        ),
        (
            "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: dark, unit: K, datatype: float64}\ndark\n1.0\n",
            ("dark", "'K'"),
        ),
    ):
        if text is not None:
            path.write_text(text)
        with refused(*refusal):
            PixelMap.read(path)
    PixelMap(dark=np.ones(7)).write(path)
    with refused("pixel_map", "7", "2048"):
        Instrument.load("mauve").with_(pixel_map=path)
