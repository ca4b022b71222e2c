"""The options that verbs share, and the study that they make."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from mauvecl.study import Study

StudyFile = Annotated[Path | None, typer.Argument(help="Study file (TOML); flags override it.", show_default=False)]
StarFlag = Annotated[
    list[str] | None,
    typer.Option("--star", "-s", help="Library name or spectrum file; may be repeated.", show_default=False),
]
MagnitudeFlag = Annotated[
    list[float] | None,
    typer.Option("--magnitude", "-m", help="Magnitude, one for all stars or one each.", show_default=False),
]
BandFlag = Annotated[str | None, typer.Option(help="Band of the magnitude [V].", show_default=False)]
ExposureFlag = Annotated[
    float | None, typer.Option("--exposure", "-t", help="Seconds, rounded up to 5 s frames [50].", show_default=False)
]
InstrumentFlag = Annotated[
    str | None, typer.Option(help="mauve, mauve-electrons, or your own TOML file [mauve].", show_default=False)
]
TemperatureFlag = Annotated[float | None, typer.Option(help="Detector temperature, deg C [21].", show_default=False)]
SkyFlag = Annotated[
    str | None, typer.Option(help="Sky brightness, V mag/arcsec^2, or none [22.1].", show_default=False)
]
TargetFlag = Annotated[str | None, typer.Option(help="Coordinates, with --time: zodiacal light.", show_default=False)]
TimeFlag = Annotated[str | None, typer.Option("--time", help="UTC of the observation.", show_default=False)]
AmplitudeFlag = Annotated[
    list[float] | None,
    typer.Option("--amplitude", "-a", help="Flare amplitude, 0.24 is 24 %; may be repeated.", show_default=False),
]
FlareTemperatureFlag = Annotated[float | None, typer.Option(help="Flare temperature, K [10000].", show_default=False)]
FlareBandFlag = Annotated[str | None, typer.Option(help="Band of the amplitude [Kepler].", show_default=False)]
RealisationsFlag = Annotated[
    int | None, typer.Option("--realisations", "-n", help="Noise realisations [1000000].", show_default=False)
]
SeedFlag = Annotated[int | None, typer.Option(help="Seed [1].", show_default=False)]
StatisticFlag = Annotated[
    list[str] | None,
    typer.Option(
        "--statistic",
        help="chi2, chi2_element, chi2_pair, matched, uv_excess, paper, or all; may be repeated.",
        show_default=False,
    ),
]
ReferenceFlag = Annotated[
    str | None,
    typer.Option(help="Compared with: template, exposure (noisy), or stack:N of them [template].", show_default=False),
]
VariancesFlag = Annotated[
    str | None,
    typer.Option(help="model, or estimated from the counts as an observer must [model].", show_default=False),
]
TemplateFlag = Annotated[
    list[float] | None,
    typer.Option(
        "--template",
        help="Look also for flares of this temperature, K: what a wrong template costs; may be repeated.",
        show_default=False,
    ),
]
FapFlag = Annotated[float | None, typer.Option(help="False-alarm probability per test [0.001].", show_default=False)]
SetFlag = Annotated[
    list[str] | None,
    typer.Option("--set", help="Any key of the study, as in run.fap=0.01; may be repeated.", show_default=False),
]
DeviceFlag = Annotated[
    str | None, typer.Option(help="OpenCL device: number or part of its name [PoCL].", show_default=False)
]
OutputFlag = Annotated[
    Path | None,
    typer.Option("--output", "-o", help="Folder for tables and pictures [mauvecl-VERB].", show_default=False),
]
JsonFlag = Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")]
QuietFlag = Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress and no file names.")]
PicturesFlag = Annotated[bool, typer.Option("--pictures/--no-pictures", help="Draw pictures (needs mauvecl[plot]).")]


def study_from_flags(
    file: Path | None,
    *,
    star: list[str] | None,
    magnitude: list[float] | None,
    band: str | None,
    exposure: float | None,
    instrument: str | None,
    temperature: float | None,
    sky: str | None,
    target: str | None,
    when: str | None,
    settings: list[str] | None = None,
    **changes: dict[str, Any],
) -> Study:
    """A study file, or the default, with the flags on top, and ``--set`` on top of those."""
    from mauvecl.host.errors import InputError
    from mauvecl.study import Study

    study = Study.read(file) if file is not None else Study()
    skylight: dict[str, Any] = {"target": target, "time": when}
    if sky is not None:
        if sky.strip().lower() == "none":
            skylight["none"] = True
        else:
            try:
                skylight["surface_brightness"] = float(sky)
            except ValueError as error:
                raise InputError(f"--sky {sky!r}, expected V mag/arcsec^2 or none") from error
    sections = {
        "observation": {"exposure_s": exposure, "instrument": instrument, "temperature_c": temperature},
        "sky": skylight,
        **changes,
    }
    changed = study.with_changes(sections, _stars(study, star, magnitude, band))
    return changed.with_settings(settings) if settings else changed


def _stars(
    study: Study, names: list[str] | None, magnitudes: list[float] | None, band: str | None
) -> list[dict[str, Any]] | None:
    from mauvecl.host.errors import InputError

    if not (names or magnitudes or band):
        return None
    if names:
        # A name that is a file's is a file; anything else is looked up in the library.
        stars: list[dict[str, Any]] = [
            {"file": name} if Path(name).suffix or Path(name).exists() else {"library": name} for name in names
        ]
        for entry in stars:
            if "file" in entry and not Path(entry["file"]).exists() and Path(entry["file"]).suffix[1:].isupper():
                # "K2.5V" looks like a file's name and is not one.
                entry["library"] = entry.pop("file")
    else:
        stars = [entry.model_dump(exclude_none=True) for entry in study.star]
    if magnitudes:
        if len(magnitudes) not in (1, len(stars)):
            raise InputError(f"{len(magnitudes)} magnitudes for {len(stars)} stars, expected one for all or one each")
        for entry, value in zip(stars, magnitudes * (len(stars) if len(magnitudes) == 1 else 1), strict=True):
            entry["magnitude"] = value
    if band:
        for entry in stars:
            entry["band"] = band
    return stars
