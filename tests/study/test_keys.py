"""Keys of studies: their units and ranges wherever a value can be given, their paths, and older files."""

import tomllib
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, get_args

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table
from refusals import refused
from study_keys import NUMERIC, ends, fields, metadata, outside

from mauvecl import BalmerFlare, InputError, Instrument, Sky, Source, Study, TwoBlackbodies, expect

FIELDS = dict(fields())
STAR = Source.from_library("G2V")
STUDIES = Path(__file__).parents[1] / "data" / "studies"
VALUES = tomllib.loads((STUDIES / "values.toml").read_text(encoding="utf-8"))["values"]


@pytest.mark.parametrize(("key", "value", "plain"), VALUES)
def test_values_in_range_are_plain_numbers(key: str, value: str, plain: str) -> None:
    given, wanted = (eval(text, {"u": u}) for text in (value, plain))
    section, *_, name = key.split(".")
    data = [{"library": "G2V", name: given}] if section == "star" else {name: given}
    study = Study.build({section: data}, "test")
    found = getattr(study.star[0] if section == "star" else getattr(study, section), name)
    assert type(found) is type(wanted)
    if wanted is not None:
        np.testing.assert_allclose(found, wanted, rtol=1e-9)


#: Python functions that take the quantity; lines cannot be scaled by an argument.
CALLS: dict[str, Callable[[float], Any]] = {
    "magnitude": lambda v: STAR.at_magnitude(v),
    "amplitude": lambda v: STAR.flaring(v),
    "flare_temperature": lambda v: STAR.flaring(0.1, v),
    "balmer_jump": lambda v: BalmerFlare(1e4, v),
    "second_temperature": lambda v: TwoBlackbodies(1e4, v, 0.1),
    "second_area": lambda v: TwoBlackbodies(1e4, 2e4, v),
    "exposure": lambda v: expect(STAR.at_magnitude(7.0), Instrument.load("mauvesim"), exposure=v),
    "detector_temperature": lambda v: Instrument.load("mauvesim").with_(temperature_c=v),
    "sky": Sky.of_brightness,
}


def refuses(call: Callable[[], Any]) -> bool:
    try:
        call()
    except InputError as error:
        # Other errors, such as one of a spectrum that needs another key, do not name a range.
        return any(word in str(error) for word in ("between", "above", "at least", "up to"))
    return False


@pytest.mark.parametrize("name", NUMERIC)
def test_keys_sweeps_maps_and_arguments_have_the_range(name: str) -> None:
    key = ".".join(NUMERIC[name]).replace("star.", "star.0.")
    for value in outside(name):
        text = f"[{value!r}]" if name == "amplitude" else repr(value)
        assert refuses(lambda: Study().with_settings([f"{key}={text}"])), (key, value)  # noqa: B023
        for axis, place in (
            (f"sweep.axes=[{{quantity={name!r},values=[{value!r}]}}]", "sweep.axes.0"),
            (f"map.x={{quantity={name!r},values=[{value!r}]}}", "map.x"),
        ):
            with refused(f"{place}.values", repr(value).removesuffix(".0")):
                Study().with_settings(["map.y={quantity='star',values=['G2V']}", axis])
        if name != "line_scale":
            assert refuses(lambda: Study().at(name, value))  # noqa: B023
            assert refuses(lambda: CALLS[name](value))  # noqa: B023
    for value in ends(name):
        swept = Study().with_settings([f"sweep.axes=[{{quantity={name!r},values=[{value!r}]}}]"])
        assert swept.sweep.axes[0].points() == (value,)
        assert name == "line_scale" or not refuses(lambda: CALLS[name](value))  # noqa: B023


def test_keywords_of_another_kind_are_refused_or_taken() -> None:
    """No keyword of a study fails with anything but a refusal on one line."""
    names = {flag.parameter for _, field in fields() for flag in metadata(field, "Flag", every=True)}
    for name, value in product(names, (7, 0.5, object(), [object()], [None], {"a": 1}, Path("x"), np.ones(2))):
        try:
            Study.of(**({"star": "G2V"} | {name: value}))
        except InputError as error:
            assert "\n" not in str(error), (name, value)  # noqa: PT017


def test_keys_of_one_kind_share_a_range() -> None:
    """All temperatures of stars and flares have one range, and the detector's its own, wherever it is a key."""
    found: dict[str, set[tuple[float, float]]] = {"K": set(), "deg_C": set()}
    for field in FIELDS.values():
        unit, one = metadata(field, "Unit"), metadata(field, "Range")
        if one is not None and unit is not None and unit.name in found:
            found[unit.name].add((one.low, one.high))
    assert found == {"K": {(1_000, 200_000)}, "deg_C": {(-40, 65)}}


def holds_path(kind: Any) -> bool:
    return kind is Path or any(map(holds_path, get_args(kind)))


#: Every key that holds a path.
FILES = (STUDIES / "paths.toml").read_text(encoding="utf-8")


def test_paths_are_relative_to_the_study_file_and_absolute_in_its_text(tmp_path: Path) -> None:
    keys = {".".join(path) for path, field in FIELDS.items() if holds_path(field.annotation)}
    (tmp_path / "study.toml").write_text(FILES.replace('"F"', '"there/f.txt"'))
    (tmp_path / "there").mkdir()
    light = np.transpose([np.linspace(150.0, 1200.0, 500), np.ones(500)])
    np.savetxt(tmp_path / "there" / "f.txt", light)
    study = Study.read(tmp_path / "study.toml")
    absolute = tomllib.loads(study.toml())
    assert str(absolute).count(str(tmp_path / "there" / "f.txt")) == len(keys) == FILES.count('"F"')
    # Read elsewhere, the text gives the same study.
    assert Study.build(absolute, "elsewhere") == study
    # An answer's table names the files by their content, and is read next to them or in a folder there.
    assert (study.text().count("_sha256"), study.text().count(str(tmp_path))) == (len(keys), 0)
    for table in (tmp_path / "there" / "table.ecsv", tmp_path / "there" / "out" / "table.ecsv"):
        table.parent.mkdir(exist_ok=True)
        Table({"x": [1.0]}, meta={"study": study.text()}).write(table, format="ascii.ecsv")
        assert Study.read(table) == study
    np.savetxt(tmp_path / "there" / "f.txt", 2 * light)
    with pytest.raises(InputError, match=r"its file 'f.txt' with sha256 .* has changed"):
        Study.read(table)


@pytest.mark.parametrize("settings", [
    {"at": 300.0}, {"per": "pixel"}, {"snr": 10.0},
    {"sweep": {"how": "list", "axes": [{"quantity": "magnitude", "values": [6.0, 9.0]},
                                       {"quantity": "exposure", "values": ["5 s", 50.0]}]},
     "unknowns": {"draws": 4, "known": ["qe_scale"]}},
])  # fmt: skip
def test_text_of_a_study_gives_the_study(settings: dict[str, Any]) -> None:
    """That of `snr --at 300`, in which no S/N is wanted, keeps the wavelength."""
    study = Study.build(settings, "test") if "sweep" in settings else Study.of(**settings)
    for text in (study.text(), study.toml()):
        assert Study.build(tomllib.loads(text), "text") == study
    assert "signal" not in tomllib.loads(Study().toml())


def test_study_of_an_older_version_is_read_and_keeps_its_keys() -> None:
    """Read a study of the version in which limits, curves and cooling had classes for their text."""
    given, now = (tomllib.loads((STUDIES / f"{name}.toml").read_text("utf-8")) for name in ("older", "older-now"))
    study = Study.build(given, "text")
    written = tomllib.loads(study.toml())
    found = written["stare"] | written["orbit"] | {"events": written["events"]}
    assert {name: found[name] for name in now} == now
    assert Study.build(written, "text") == study
