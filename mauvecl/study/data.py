"""Study section for observed frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from mauvecl.schema.fields import Flag, Help, Widget
from mauvecl.schema.section import Section


class DataChoice(Section):
    """Observed frames that `analyse` reads."""

    file: Annotated[
        Path | None,
        Help("Observed frames: FITS, ECSV or CSV; the verb's argument stands for it"),
        Flag("--data"),
        Widget(
            label="Frames",
            hint="A light curve or a sequence of spectra: FITS, ECSV or CSV of at most 16 MiB; the command line reads "
            "larger ones. Files of mauvecl, TESS, Kepler and lightkurve need no mapping.",
            group="Frames",
            name="frames",
            kind="upload",
        ),
    ] = None
    mapping: Annotated[
        Path | None,
        Help("Where time, flux and error are in that file (TOML)"),
        Flag("--mapping"),
        Widget(
            label="Mapping",
            hint="Other files need a short TOML file that names the columns of time, flux and error, such as "
            "time = 'TIME', flux = 'RATE'; the documentation has one for each layout.",
            group="Frames",
            place=1,
            kind="upload",
        ),
    ] = None
    quality_bits: Annotated[
        str | None,
        Help(
            "Bits of the quality flag that exclude a frame",
            "numbers and names as in 'Desat,128', or all, or none",
            default="lightkurve's default for Kepler and K2, for TESS without ImpulsiveOutlier, else all",
        ),
        Flag("--quality-bits"),
        Widget(
            label="Quality bits",
            hint="Bits of the quality flag that exclude a frame: numbers and names as in Desat,128, or all, or none. "
            "Without them lightkurve's default applies to Kepler and K2, its default without ImpulsiveOutlier to TESS, "
            "and all bits to other files.",
            group="Frames",
            place=2,
        ),
    ] = None
    ignore_checksum: Annotated[
        bool, Help("Read FITS files although their CHECKSUM or DATASUM differs"), Flag("--ignore-checksum")
    ] = False
    report: Annotated[Literal["pdf", "html"], Help("Form of the report"), Flag("--report")] = "html"

    barycentric: Annotated[
        str | None,
        Help("Target for which times are converted to the Solar System's barycentre (TDB)", "name or coordinates"),
        Flag("--barycentric"),
    ] = None
