"""Every key of a study that holds a path is relative to the study file, and absolute in the study's text."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, get_args, get_origin

import pytest

from mauvecl.schema.section import fields_of
from mauvecl.study.study import Study
from mauvecl.study.study_text import with_paths


def holds_path(kind: Any) -> bool:
    return kind is Path or any(map(holds_path, get_args(kind)))


PATHS = [path for path, field in fields_of(Study) if holds_path(field.annotation)]


def nested(path: tuple[str, ...], kind: Any, file: str) -> Any:
    """Return data with a file at a path of keys, within lists and tables of records where the fields hold these."""
    if get_origin(kind) is dict:
        return {"one": nested(path, get_args(kind)[1], file)}
    if get_origin(kind) is tuple:
        return [nested(path, get_args(kind)[0], file)]
    if not path:
        return file
    models = [one for one in (kind, *get_args(kind)) if hasattr(one, "model_fields")]
    return {path[0]: nested(path[1:], models[0].model_fields[path[0]].annotation, file)}


@pytest.mark.parametrize("path", PATHS, ids=".".join)
def test_paths_of_every_key_change(path: tuple[str, ...]) -> None:
    data = nested(path, Study, "file.txt")
    assert with_paths(data, Study, lambda file: Path("folder") / file) == nested(
        path, Study, str(Path("folder/file.txt"))
    )


def test_paths_are_relative_to_the_study_file(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(
        '[[star]]\nfile = "star.txt"\nneighbours = "near.csv"\n[run.weights]\nown = "weights.txt"\n'
        '[nuisances.own.stray]\nfile = "stray.txt"\nsd = 0.1\n[stare.thermal]\nfile = "curve.txt"\n'
        '[[plan.targets]]\nname = "AU Mic"\nrates_file = "rates.csv"\n'
    )
    study = Study.read(tmp_path / "study.toml")
    assert study.star[0].file == tmp_path / "star.txt"
    assert study.run.weights == {"own": tmp_path / "weights.txt"}
    assert study.nuisances.own["stray"].file == tmp_path / "stray.txt"
    assert study.stare.thermal is not None
    assert study.stare.thermal.file == tmp_path / "curve.txt"
    assert study.plan.targets[0].rates_file == tmp_path / "rates.csv"
    assert tomllib.loads(study.toml())["star"][0]["neighbours"] == str((tmp_path / "near.csv").resolve())


@pytest.mark.parametrize("data", [{"star": 3}, {"star": [3]}, {"run": {"weights": []}}, {"stare": {"thermal": 2.0}}, 3])
def test_invalid_data_are_left_to_validation(data: Any) -> None:
    assert with_paths(data, Study, lambda file: Path("folder") / file) == data
