"""Invalid values in studies: booleans as numbers, and files without keys."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import numpy as np
import pytest
from pydantic import BaseModel, ValidationError
from refusals import refused

import mauvecl
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.schema.records import Record
from mauvecl.study.study import Study


def records(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    """Yield a model and all models of its fields."""
    yield model
    for field in model.model_fields.values():
        for inner in models_in(field.annotation):
            yield from records(inner)


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from models_in(part)


def plain(annotation: Any) -> set[Any]:
    """Return the types of single values in an annotation."""
    if get_origin(annotation) is Annotated:
        return plain(get_args(annotation)[0])
    parts = get_args(annotation)
    return set().union(*map(plain, parts)) if parts else {annotation}


NUMERIC = sorted(
    {
        (model, name)
        for root in (Study, Instrument)
        for model in records(root)
        for name, field in model.model_fields.items()
        if plain(field.annotation) & {int, float} and bool not in plain(field.annotation)
    },
    key=lambda one: (one[0].__name__, one[1]),
)


def test_numeric_keys_are_found() -> None:
    names = {f"{model.__name__}.{name}" for model, name in NUMERIC}
    assert {"Star.bin_nm", "Flare.amplitudes", "Run.seed", "Instrument.read_noise_dn", "Axis.values"} <= names
    assert len(names) > 100


@pytest.mark.parametrize("model", sorted({model for model, _ in NUMERIC}, key=lambda one: one.__name__))
def test_booleans_as_numbers_raise(model: type[Record]) -> None:
    """All numeric keys of studies and instruments reject booleans of Python and NumPy, alone and in lists."""
    for name in (name for one, name in NUMERIC if one is model):
        for value in (True, False, np.True_, [True], [0.5, True], (False,)):
            with pytest.raises(ValidationError) as error:
                model.model_validate({name: value})
            assert any(fault["loc"][0] == name for fault in error.value.errors()), (name, value)


def test_booleans_of_instruments_raise() -> None:
    with refused("observation.changes"):
        Study().with_settings(["observation.changes.read_noise_dn=true"]).observation.load_instrument()
    # Boolean keys accept booleans.
    assert Study().with_settings(["orbit.simbad=true"]).orbit.simbad


@pytest.mark.parametrize("text", ["", "\n\n", "# only a remark\n", "[flare]\n", "[run]\n[run.weights]\n"])
def test_study_file_without_keys_raises(tmp_path: Path, text: str) -> None:
    """Only verbs without a study file and `Study()` use the default study."""
    study = tmp_path / "empty.toml"
    study.write_text(text, encoding="utf-8")
    with refused("study_file", value="empty.toml"):
        Study.read(study)
    study.write_text("[run]\nseed = 1\n", encoding="utf-8")
    assert Study.read(study) == mauvecl.Study()
