"""Study section for observed frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from mauvecl.schema.fields import Flag, Help
from mauvecl.schema.section import Section


class DataChoice(Section):
    """Observed frames that `analyse` reads."""

    file: Annotated[
        Path | None, Help("Observed frames: FITS, ECSV or CSV; the verb's argument stands for it"), Flag("--data")
    ] = None
    mapping: Annotated[Path | None, Help("Where time, flux and error are in that file (TOML)"), Flag("--mapping")] = (
        None
    )
    report: Annotated[Literal["pdf", "html"], Help("Form of the report"), Flag("--report")] = "html"

    barycentric: Annotated[
        str | None,
        Help("Target for which times are converted to the Solar System's barycentre (TDB)", "name or coordinates"),
        Flag("--barycentric"),
    ] = None
