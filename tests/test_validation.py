"""Every public function validates every argument, and bad input is refused in one sentence.

Cases follow from the annotations: values that these refuse are refused; those that fit an annotation and cannot be
right, such as a name that is unknown or an array of a wrong shape, are answered, or refused by the function itself.
Others, of all verbs and functions, are in data/refusals, whose README says what an entry may hold.
"""

from __future__ import annotations

import inspect
import pickle
import re
import shlex
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Column, MaskedColumn
from astropy.time import TimeDelta
from astropy.utils.masked import Masked
from commands import ended
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel
from refusals import refused, says_what_is_accepted
from scenes import study_of_g2v
from study_keys import metadata

import mauvecl
from mauvecl import InputError, bulk

#: Modules below the validation, and the inner interface of statistics, whose methods public classes inherit.
INNER = ("mauvecl.schema", mauvecl.Linear.__module__)
#: Other units in which a parameter of each unit is given.
EQUIVALENT = {"nm": ("um", "THz"), "K": ("kK", "deg_C"), "deg_C": ("K",), "s": ("min",), "mag": ("mmag",)}


def public_functions() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Yield all functions, constructors and methods of the public names that are defined in the package."""
    for name in mauvecl.__all__:
        thing = getattr(mauvecl, name)
        if inspect.isfunction(thing):
            yield name, thing
        elif inspect.isclass(thing) and thing is not InputError:
            if not issubclass(thing, BaseModel) or "__init__" in vars(thing):
                yield name, thing.__init__
            for method in dir(thing):
                found = inspect.getattr_static(thing, method)
                found = found.__func__ if isinstance(found, classmethod | staticmethod) else found
                inside = inspect.isfunction(found) and found.__module__.startswith("mauvecl")
                if inside and not method.startswith("_") and not found.__module__.startswith(INNER):
                    yield f"{name}.{method}", found
    for name, thing in vars(bulk).items():
        if inspect.isfunction(thing) and thing.__module__ == bulk.__name__ and not name.startswith("_"):
            yield f"bulk.{name}", thing


FUNCTIONS = dict(public_functions())


def arguments(function: Callable[..., Any]) -> list[inspect.Parameter]:
    return [
        p
        for p in inspect.signature(function).parameters.values()
        if p.name not in ("self", "cls") and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    ]


PARAMETERS = [(path, p.name) for path, function in FUNCTIONS.items() for p in arguments(function)]


@cache
def annotation(path: str, name: str) -> Any:
    return FUNCTIONS[path].__validated__[name].annotation()  # type: ignore[attr-defined]


def is_array(hint: Any) -> bool:
    return hint == ArrayLike or get_origin(hint) is get_origin(NDArray[np.float64])


def parts(hint: Any) -> Iterator[Any]:
    """Yield an annotation and all that it consists of, metadata included."""
    yield hint
    if get_origin(hint) in (Union, UnionType) and type(None) in get_args(hint):
        yield type(None)
        hint = Union[tuple(one for one in get_args(hint) if one is not type(None))]  # noqa: UP007
        yield hint
    if is_array(hint):
        return
    for part in get_args(hint):
        yield from parts(part)


def named(kind: str, hint: Any) -> list[Any]:
    return [part for part in parts(hint) if type(part).__name__ == kind]


def accepted(hint: Any, *kinds: Any) -> bool:
    return any(part in kinds or get_origin(part) in kinds for part in parts(hint) if part.__hash__)


def anything(hint: Any) -> bool:
    return accepted(hint, Any, object) or any(getattr(part, "_is_protocol", False) for part in parts(hint))


def holds_arrays(hint: Any) -> bool:
    return any(is_array(part) for part in parts(hint))


def having(condition: Callable[[Any], bool]) -> list[tuple[str, str]]:
    return [(path, name) for path, name in PARAMETERS if condition(annotation(path, name))]


def wrong_values(path: str, name: str) -> Iterator[Any]:
    """Yield values that a parameter must refuse, by its annotation."""
    hint, arrays = annotation(path, name), holds_arrays(annotation(path, name))
    if anything(hint):
        return
    yield from (object(), [1, object()])
    if not named("AnyUnit", hint):
        yield 3 * u.kg
    if not accepted(hint, str, Path):
        yield "no such thing"
    if not arrays:
        yield from (np.nan, np.ones((2, 3)))
        if not accepted(hint, bool):
            yield True
        if not accepted(hint, int):
            # A number beyond the largest float.
            yield 10**400
    # Verbs have a default study, which their own code does not see.
    if not accepted(hint, type(None)) and inspect.signature(FUNCTIONS[path]).parameters[name].default is not None:
        yield None
    for part in parts(hint):
        if inspect.isclass(part) and part.__module__.startswith("mauvecl"):
            # A class of the same name.
            yield type(part.__name__, (), {})()


def test_every_public_function_is_validated() -> None:
    assert len(PARAMETERS) > 300
    assert not [path for path, f in FUNCTIONS.items() if arguments(f) and not hasattr(f, "__validated__")]
    # Arguments that are missing, or too many, are refused as everywhere in Python.
    star = mauvecl.Source.from_library("G2V")
    for call, given in ((star.flaring, ()), (star.binned, (1.0, 2.0)), (type(mauvecl.Study().run), (5,))):
        with pytest.raises(TypeError, match="argument"):
            call(*given)


@pytest.mark.parametrize("path", [path for path, f in FUNCTIONS.items() if arguments(f)])
def test_wrong_arguments_raise(path: str) -> None:
    """The wrong argument is given alone: it is refused before others are missed."""
    function = FUNCTIONS[path]
    own = [None] if next(iter(inspect.signature(function).parameters)) in ("self", "cls") else []
    for name in (name for there, name in PARAMETERS if there == path):
        for value in wrong_values(path, name):
            with refused(name):
                function(*own, **{name: value})


def example(hint: Any) -> Any:
    """Return a plain number in the middle of a parameter's range, or an array where it takes one."""
    low, high = next(((max(part.low, -1e3), min(part.high, 1e6)) for part in named("Range", hint)), (1.0, 3.0))
    middle = low + (high - low) / 3
    return np.array([middle, middle]) if holds_arrays(hint) else middle


@pytest.mark.parametrize(("path", "name"), having(lambda hint: bool(named("Unit", hint))))
def test_quantities_are_plain_numbers(path: str, name: str) -> None:
    check = FUNCTIONS[path].__validated__[name]  # type: ignore[attr-defined]
    hint = annotation(path, name)
    unit = named("Unit", hint)[0].name
    value: Any = example(hint)
    if accepted(hint, tuple):
        value = (value, value)
        if accepted(hint, Sequence):
            value = (value,)
    plain = check(value)
    for other in (unit, *EQUIVALENT.get(unit, ())):
        equivalent = u.spectral() if unit == "nm" else u.temperature()
        given = (np.asarray(value) * u.Unit(unit)).to(u.Unit(other), equivalent)
        columns = (Column(given.value, unit=given.unit),) if given.shape else ()
        durations = (TimeDelta(given),) if given.unit.is_equivalent(u.s) else ()
        for quantity in (given, *columns, *durations):
            taken = np.asarray(check(quantity), float)
            np.testing.assert_allclose(taken, np.asarray(plain, float), rtol=1e-9, atol=1e-9)
        if holds_arrays(hint):
            for masked in (
                Masked(given, mask=[True, False]),
                MaskedColumn(given.value, unit=other, mask=[True, False]),
            ):
                np.testing.assert_allclose(np.asarray(check(masked), float), [np.nan, plain[1]], rtol=1e-9)


@pytest.mark.parametrize(
    ("path", "name"),
    having(lambda hint: int in (hint, *get_args(hint)) and float not in get_args(hint) and get_origin(hint) != Mapping),
)
def test_whole_numbers_may_be_floats(path: str, name: str) -> None:
    check = FUNCTIONS[path].__validated__[name]  # type: ignore[attr-defined]
    for value in (7.0, np.int64(7), np.float32(7), 7 * u.one):
        assert check(value) == 7
        assert type(check(value)) is int
    with pytest.raises(InputError):
        check(7.5)


@pytest.mark.parametrize(
    "name", [n for n, f in mauvecl.Instrument.model_fields.items() if f.annotation in (float, int)]
)
def test_instruments_take_quantities(name: str) -> None:
    mauve = mauvecl.Instrument.load("mauvesim")
    value = getattr(mauve, name)
    unit = metadata(mauvecl.Instrument.model_fields[name], "Unit")
    quantity = value * (u.one if unit is None else u.Unit(unit.name))
    assert getattr(mauve.with_(**{name: quantity}), name) == pytest.approx(value)
    with refused(name):
        mauve.with_(**{name: 3 * u.kg})


@pytest.mark.parametrize(("quantity", "value", "plain"), [
    ("magnitude", 7000 * u.mmag, 7.0), ("exposure", 2 * u.min, 120.0), ("detector_temperature", 300.15 * u.K, 27.0),
    ("flare_temperature", 12 * u.kK, 12_000.0), ("sky", 22 * u.mag / u.arcsec**2, 22.0),
])  # fmt: skip
def test_studies_take_quantities(quantity: str, value: Any, plain: float) -> None:
    study = mauvecl.Study()
    assert study.at(quantity, value) == study.at(quantity, plain)
    for wrong in (3 * u.kg, np.nan, "x"):
        with refused("value" if wrong is np.nan else quantity):
            study.at(quantity, wrong)


def test_columns_of_amplitudes_and_temperatures_of_priors_keep_their_unit() -> None:
    assert mauvecl.Study.of(star="G2V", amplitude=Column([10.0, 20.0], unit="percent")).flare.amplitudes == (0.1, 0.2)
    prior = mauvecl.Normal(20 * u.deg_C, 1.0, 283.15 * u.K, 30 * u.deg_C)
    assert (prior.mean, prior.low, prior.high) == pytest.approx((20.0, 10.0, 30.0))
    with refused("high"):
        mauvecl.Uniform(20 * u.deg_C, 3 * u.kg)


def records(record: type[BaseModel] = BaseModel) -> Iterator[type[BaseModel]]:
    """Yield all records of mauvecl, but for those with a constructor of their own, which is a public function."""
    for one in record.__subclasses__():
        if one.__module__.startswith("mauvecl"):
            if one.model_fields and not inspect.isabstract(one) and "__init__" not in vars(one):
                yield one
            yield from records(one)


def types(hint: Any) -> set[Any]:
    """Return the types of single values in an annotation."""
    inner = get_args(hint)[:1] if hasattr(hint, "__metadata__") else get_args(hint)
    return set().union(*map(types, inner)) if inner else {hint}


@pytest.mark.parametrize("record", sorted(records(), key=lambda one: one.__name__), ids=lambda one: one.__name__)
def test_wrong_fields_of_records_raise(record: type[BaseModel]) -> None:
    """Errors of pydantic never leave a section of a study or an instrument, and truths are no numbers."""
    wrong = (3 * u.kg, np.nan, [1, "a"], "no such thing", object(), np.ones((2, 3)), None)
    truths = (True, False, np.True_, [True], [0.5, True], (False,))
    for field in (*record.model_fields, "no_such_key"):
        hint = record.model_fields[field].annotation if field in record.model_fields else None
        numeric = {int, float} & types(hint) and bool not in types(hint)
        for value in (*wrong, *truths):
            refusal = None
            try:
                record(**{field: value})
            except InputError as error:
                refusal = str(error)
            if refusal is None:
                assert type(value) is not object or hint is Any, field
                assert not numeric or not any(value is one for one in truths), (field, value)
            else:
                assert "\n" not in refusal
                assert says_what_is_accepted(refusal), refusal


#: Values of required parameters that are text, by name of the parameter.
WORDS = {
    "band": "Kepler", "quantity": "magnitude", "statistic": "matched", "target": "290.0 -11.2",
    "time": "2027-01-01", "instrument": "mauvesim", "path": "no such file", "file": "x.fits",
}  # fmt: skip
#: What the package calls with arrays that it has made, which nothing checks again in a loop.
IN_LOOPS = (
    "BalmerFlare.", "Blackbody.", "FlareWithLines.", "Frames.shifted", "Normal.quantile", "Nuisances.finite",
    "Nuisances.rows", "ObservedFlare.flux", "ObservedFlare.grid", "Pool.realise", "Stares.", "TableShape.",
    "TwoBlackbodies.", "Uniform.quantile", "bulk.unfinished",
)  # fmt: skip


@cache
def instances() -> dict[type, Any]:
    """Return an instance of each class that functions take or whose methods are called."""
    star = mauvecl.Source.from_library("G2V").at_magnitude(7.4)
    part = mauvecl.Instrument.load("mauvesim").with_(output_min_nm=300.0, output_max_nm=306.0)
    quiet, flare = (mauvecl.expect(one, part, exposure=5) for one in (star, star.flaring(0.5)))
    study = study_of_g2v(observation={"changes": {"output_min_nm": 300.0, "output_max_nm": 306.0}})
    made = (
        star, part, quiet, study, mauvecl.FlareModel.of(star, part, quiet), mauvecl.Engine(),
        mauvecl.Engine().detect(quiet, [flare], realisations=500, seed=1), mauvecl.Cooling(1e4, 5000.0, 300.0),
        mauvecl.Event(0.0, 60.0, 0.1), mauvecl.Nuisances.of(quiet, {"dark": 0.1}), mauvecl.Stare.of(60.0),
        mauvecl.PixelMap.made_up(5, seed=1), mauvecl.BalmerFlare(9000.0), mauvecl.Sinusoid(0.1),
        mauvecl.EnergyScale.of_blackbody(1.0, 5772.0), mauvecl.Frames.of(5.0 * np.arange(30), np.ones(30)),
    )  # fmt: skip
    return {type(one): one for one in made}


def fitting(path: str, name: str) -> Any:
    """Return a value for a required parameter, by its annotation."""
    hint = annotation(path, name)
    for kind, one in instances().items():
        if accepted(hint, *(base for base in kind.__mro__ if base.__module__.startswith("mauvecl"))):
            return (one,) if accepted(hint, Sequence, tuple, list) else one
    if accepted(hint, str, Path):
        word = WORDS.get(name, "x")
        return (word,) if accepted(hint, tuple) else word
    if holds_arrays(hint) or accepted(hint, float):
        value = example(hint)
        return (value,) if accepted(hint, tuple, Sequence) else value
    return 3 if accepted(hint, int) else None


def fitting_mistakes(path: str, name: str) -> list[Any]:
    """Return values that fit the annotation of a parameter and cannot be right."""
    hint = annotation(path, name)
    if anything(hint):
        return []
    arrays = [np.ones((2, 3)), np.full(4, np.nan), np.empty(0)] if holds_arrays(hint) else []
    return arrays + (["no such thing"] if accepted(hint, str, Path) else [])


#: Names of functions with a parameter that is tried. Methods need an instance of their class.
TRIED = sorted({path for path, name in PARAMETERS if not path.startswith(IN_LOOPS) and fitting_mistakes(path, name)})


@pytest.mark.long
@pytest.mark.parametrize("path", TRIED)
def test_wrong_name_or_array_raises(path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    owner, _, method = path.partition(".")
    call = thing = getattr(mauvecl, owner)
    if method:
        static = isinstance(inspect.getattr_static(thing, method, None), classmethod | staticmethod)
        call = getattr(thing if static or not inspect.isclass(thing) else instances()[thing], method)
    good = {p.name: fitting(path, p.name) for p in arguments(FUNCTIONS[path]) if p.default is p.empty}
    for name in (name for there, name in PARAMETERS if there == path):
        for value in fitting_mistakes(path, name):
            try:
                call(**good | {name: value})
            except InputError:
                pass
            except RuntimeError as error:
                assert error.kind, "a device's failure states its kind"  # type: ignore[attr-defined]  # noqa: PT017


TABLES = Path(__file__).parent / "data" / "refusals"
CONTENT = {path: tomllib.loads(path.read_text(encoding="utf-8")) for path in sorted(TABLES.glob("*.toml"))}
ROWS = [
    pytest.param(path, row, id=f"{path.stem}: {row.get('run') or row['call']}")
    for path, table in CONTENT.items()
    for row in table["refusal"]
]


@cache
def _names(path: Path) -> dict[str, Any]:
    """Return the public names, and what the table's setup makes of them."""
    names = {name: getattr(mauvecl, name) for name in mauvecl.__all__} | {"mauvecl": mauvecl, "np": np, "u": u}
    exec(CONTENT[path].get("setup", ""), names)
    return names


@pytest.mark.parametrize(("path", "row"), ROWS)
def test_bad_input_is_refused(path: Path, row: dict[str, Any], tmp_path: Path) -> None:
    for name, text in (CONTENT[path].get("files", {}) | row.get("files", {})).items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    if "call" in row:
        with refused(row.get("key"), *row["says"]):
            eval(row["call"], _names(path) | {"folder": tmp_path})
        return
    code, out, reported = ended(*shlex.split(row["run"]), folder=tmp_path)
    assert code == 2, out + reported
    sentence = reported.removeprefix("mauvecl: ").strip()
    for fact in (row["key"], *row["says"]):
        assert fact in sentence, sentence
    # Notes on what was assumed may precede the sentence.
    assert not re.search(r"Traceback|internal error", reported), reported
    if path.stem in ("cli", "cli-limits"):
        # One sentence, in which parameters are named by their flags.
        assert (out, reported.count("\n"), reported[:9]) == ("", 1, "mauvecl: ")
        assert "`" not in re.sub(r"`mauvecl [^`]*`", "", reported), reported


def test_errors_of_values_have_a_key_a_place_and_a_unit() -> None:
    error = InputError.of("flare amplitude", -1.0, "at least 0", unit="s", where="a.toml")
    for one in (error.within("star.txt"), pickle.loads(pickle.dumps(error.within("star.txt")))):
        assert (str(one), one.key) == (
            "star.txt: a.toml: flare amplitude must be at least 0, not -1.0 s", "flare_amplitude"
        )  # fmt: skip

    # Values are shown on one short line.
    shown = {r"'a\nb'": "a\nb", "2.5": np.float64(2.5), "3.0 m": 3 * u.m, "[1, 2]": [1, 2],
             "'" + "x" * 56 + "..." + "x" * 19 + "'": "x" * 500}  # fmt: skip
    for text, value in shown.items():
        assert str(InputError.of("key", value, "another")) == f"key must be another, not {text}"
