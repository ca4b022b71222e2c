"""Study section for observed frames."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mauvecl.schema.fields import Flag, Help
from mauvecl.schema.section import Section

if TYPE_CHECKING:
    from mauvecl.study.study import Study


class DataChoice(Section):
    """Observed frames that `analyse` reads."""

    file: Annotated[
        Path | None, Help("Observed frames: FITS, ECSV or CSV; the verb's argument stands for it"), Flag("--data")
    ] = None
    mapping: Annotated[Path | None, Help("Where time, flux and error are in that file (TOML)"), Flag("--mapping")] = (
        None
    )
    report: Annotated[Literal["html", "pdf"], Help("Form of the report"), Flag("--report")] = "html"

    barycentric: Annotated[
        str | None,
        Help("Target for which times are converted to the Solar System's barycentre (TDB)", "name or coordinates"),
        Flag("--barycentric"),
    ] = None


def resolve_data_paths(data: dict[str, Any], folder: Path) -> None:
    """Resolve the paths of observed frames against a folder, in place."""
    section = data.get("data")
    for key in ("file", "mapping"):
        if isinstance(section, dict) and isinstance(section.get(key), str):
            section[key] = str(folder / section[key])


def drop_default_data(data: dict[str, Any], study: Study) -> None:
    """Remove an empty section from a study's data and make its paths absolute, in place."""
    if study.data == DataChoice():
        del data["data"]
    else:
        resolve_data_paths(data, Path.cwd())
