"""The options that verbs share, and the study that they make."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, get_type_hints

import typer

from mauvecl.cli.values import amplitudes_of, as_text, axis_of, frames_of, gap_of, names_of

if TYPE_CHECKING:
    from mauvecl.study.study import Study

StudyFile = Annotated[
    Path | None,
    typer.Argument(help="Study (TOML), or the ECSV table of an answer; flags override it.", show_default=False),
]
StarFlag = Annotated[
    list[str] | None,
    typer.Option("--star", "-s", help="Library name or spectrum file; may be repeated.", show_default=False),
]
MagnitudeFlag = Annotated[
    list[float] | None,
    typer.Option("--magnitude", "-m", help="Magnitude, one for all stars or one each.", show_default=False),
]
BandFlag = Annotated[str | None, typer.Option(help="Band of the magnitude [V].", show_default=False)]
MagnitudeSystemFlag = Annotated[
    str | None,
    typer.Option(
        help="What it means: catalogue, vega (Vega is 0 in every band), or ab [catalogue].", show_default=False
    ),
]
EbvFlag = Annotated[
    float | None,
    typer.Option(help="Dust before the star, E(B-V), mag (needs mauvecl[extinction]).", show_default=False),
]
WavelengthUnitFlag = Annotated[
    str | None,
    typer.Option(help="Of a spectrum file's wavelengths, as in Angstrom, or 'nm air'.", show_default=False),
]
FluxUnitFlag = Annotated[
    str | None, typer.Option(help="Of a spectrum file's fluxes, as in 'W m-2 nm-1'.", show_default=False)
]
ExtendFlag = Annotated[
    str | None,
    typer.Option(help="Library spectrum that goes on where a spectrum file ends, scaled to it.", show_default=False),
]
BinFlag = Annotated[
    float | None, typer.Option("--bin-nm", help="Bin the spectrum to this width, nm.", show_default=False)
]
ExposureFlag = Annotated[
    float | None, typer.Option("--exposure", "-t", help="Seconds, rounded up to 5 s frames [50].", show_default=False)
]
InstrumentFlag = Annotated[
    str | None,
    typer.Option(
        help="mauve (as the paper), mauve-electrons (for planning), or your own TOML file [mauve].", show_default=False
    ),
]
TemperatureFlag = Annotated[float | None, typer.Option(help="Detector temperature, deg C [21].", show_default=False)]
SkyFlag = Annotated[
    str | None, typer.Option(help="Sky brightness, V mag/arcsec^2, or none [22.1].", show_default=False)
]
TargetFlag = Annotated[str | None, typer.Option(help="Coordinates, with --time: zodiacal light.", show_default=False)]
TimeFlag = Annotated[str | None, typer.Option("--time", help="UTC of the observation.", show_default=False)]
SignalFlag = Annotated[
    str | None,
    typer.Option(
        "--signal",
        help="In an S/N: net (the star alone) or paper (zodiacal light counts too) [net].",
        show_default=False,
    ),
]
AmplitudeFlag = Annotated[
    list[float] | None,
    typer.Option("--amplitude", "-a", help="Flare amplitude, 0.24 is 24 %; may be repeated.", show_default=False),
]
FlaresFlag = Annotated[
    Path | None,
    typer.Option(
        "--flares",
        help="Amplitudes from a table of flares (CSV, ECSV, FITS; AltaiPony's ampl_rec).",
        show_default=False,
    ),
]
FlareTemperatureFlag = Annotated[float | None, typer.Option(help="Flare temperature, K [10000].", show_default=False)]
FlareBandFlag = Annotated[str | None, typer.Option(help="Band of the amplitude [Kepler].", show_default=False)]
GeometryFlag = Annotated[
    str | None,
    typer.Option(
        "--geometry",
        help="A flare is added to the star, or replaces part of its photosphere [added].",
        show_default=False,
    ),
]
PhotosphereFlag = Annotated[
    float | None,
    typer.Option(
        "--photosphere-temperature", help="Of the star, K, where a flare replaces some of it.", show_default=False
    ),
]
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
TailsFlag = Annotated[
    str | None,
    typer.Option(
        "--tails",
        help="Thresholds beyond what is drawn: counted (refused), or sampled with importance [counted].",
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
NuisanceFlag = Annotated[
    list[str] | None,
    typer.Option(
        "--nuisance",
        help="Marginalise over dark, light, sky, tilt or a file's spectrum, with a standard deviation or free, as in "
        "dark=0.1 or stray.txt=free; may be repeated.",
        show_default=False,
    ),
]
WithUnknownsFlag = Annotated[
    bool | None,
    typer.Option(
        "--with-unknowns",
        help="Draw the documented unknowns of this question, and marginalise over them.",
        show_default=False,
    ),
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
CampaignFlag = Annotated[
    int | None,
    typer.Option("--campaign", help="Frames of a whole search: what one test means for all of it.", show_default=False),
]
CampaignStepFlag = Annotated[
    int | None,
    typer.Option("--campaign-step", help="Frames from one stack of it to the next [a stack].", show_default=False),
]
CampaignFapFlag = Annotated[
    float | None,
    typer.Option(
        "--campaign-fap", help="Wanted chance of any false alarm in it: what a test may have.", show_default=False
    ),
]
CampaignAlarmsFlag = Annotated[
    float | None,
    typer.Option(
        "--campaign-alarms", help="Wanted number of false alarms in it: what a test may have.", show_default=False
    ),
]
SetFlag = Annotated[
    list[str] | None,
    typer.Option("--set", help="Any key of the study, as in run.fap=0.01; may be repeated.", show_default=False),
]
SweepFlag = Annotated[
    list[str] | None,
    typer.Option(
        "--sweep",
        help="Values of a quantity, as in exposure=5,50,600 or magnitude:4:10:7; several give every combination.",
        show_default=False,
    ),
]
AsListFlag = Annotated[
    bool | None, typer.Option("--as-list", help="Sweep side by side instead of every combination.", show_default=False)
]
OfFlag = Annotated[str | None, typer.Option(help="magnitude, amplitude or exposure [magnitude].", show_default=False)]
PowerFlag = Annotated[float | None, typer.Option(help="Wanted detection probability [0.9].", show_default=False)]
DurationFlag = Annotated[
    float | None, typer.Option("--duration", help="Of the stare, s [5680, an orbit].", show_default=False)
]
GapFlag = Annotated[
    list[str] | None,
    typer.Option("--gap", help="Nothing is recorded from:to, s, as in 1000:2000; may be repeated.", show_default=False),
]
OrbitGapFlag = Annotated[
    float | None, typer.Option("--orbit-gap", help="Gap at the end of every orbit, s [0].", show_default=False)
]
ThermalFlag = Annotated[
    float | None,
    typer.Option("--thermal", help="Known thermal cycle of the orbit, +- deg C [0].", show_default=False),
]
HalfWidthFlag = Annotated[float | None, typer.Option("--half-width", help="Of the flares, s [60].", show_default=False)]
ShapeFlag = Annotated[
    str | None,
    typer.Option(
        "--shape", help="Of flares: davenport2014, tovarmendoza2022, fiducial [davenport2014].", show_default=False
    ),
]
EnergyFlag = Annotated[
    list[float] | None,
    typer.Option(
        "--energy",
        help="Bolometric energy of a flare, erg, in place of amplitudes; may be repeated.",
        show_default=False,
    ),
]
SearchFlag = Annotated[
    bool | None,
    typer.Option(
        "--search/--no-search", help="Search the stare for flares, as [search] has it [search].", show_default=False
    ),
]
DistanceFlag = Annotated[
    float | None, typer.Option("--distance", help="Of the star, pc, for energies.", show_default=False)
]
RadiusFlag = Annotated[
    float | None, typer.Option("--radius", help="Of the star, solar radii, for energies.", show_default=False)
]
StarTemperatureFlag = Annotated[
    float | None,
    typer.Option("--star-temperature", help="Effective temperature of the star, K, for energies.", show_default=False),
]
SnrFlag = Annotated[float | None, typer.Option(help="Wanted signal-to-noise ratio.", show_default=False)]
AtFlag = Annotated[float | None, typer.Option(help="Wavelength, nm.", show_default=False)]
PerFlag = Annotated[str | None, typer.Option(help="element (10.5 nm) or pixel [element].", show_default=False)]
UnknownFlag = Annotated[
    int | None,
    typer.Option(
        "--unknown", help="Average over so many draws of what is unknown of the instrument [0].", show_default=False
    ),
]
KnownFlag = Annotated[
    list[str] | None,
    typer.Option("--known", help="What of it is known after all, as in temperature_c,light_loss.", show_default=False),
]
XFlag = Annotated[str | None, typer.Option(help="Such as magnitude:4:10:16, or exposure=5,50,600.", show_default=False)]
YFlag = Annotated[str | None, typer.Option(help="Such as amplitude:0.01:1:16:log.", show_default=False)]
FramesFlag = Annotated[
    str | None,
    typer.Option(
        help="stack (an exposure's sum), all, or numbers of frames such as 0,4,9 [stack].", show_default=False
    ),
]
ComponentsFlag = Annotated[
    bool | None,
    typer.Option("--components", help="Keep also mean star, sky and noise of each pixel.", show_default=False),
]
DeviceFlag = Annotated[
    str | None,
    typer.Option(
        help="OpenCL device: number or part of its name; 0,1 for several together [PoCL].", show_default=False
    ),
]
ClusterFlag = Annotated[
    str | None,
    typer.Option(
        help="Draw on Dask workers: local:N, tcp://host:8786, or a scheduler file (needs mauvecl[cluster]).",
        show_default=False,
    ),
]
InsistFlag = Annotated[
    bool, typer.Option("--insist", help="Begin even what would take more than a year, or than the disk has room for.")
]
ResumeFlag = Annotated[bool, typer.Option("--resume", help="Go on with the unfinished run in the output folder.")]
RestartFlag = Annotated[bool, typer.Option("--restart", help="Forget the unfinished run in the output folder.")]
OutputFlag = Annotated[
    Path | None,
    typer.Option("--output", "-o", help="Folder for tables and pictures [mauvecl-VERB].", show_default=False),
]
JsonFlag = Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")]
QuietFlag = Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress and no file names.")]
PicturesFlag = Annotated[bool, typer.Option("--pictures/--no-pictures", help="Draw pictures (needs mauvecl[plot]).")]

KeepAfterFlag = Annotated[
    float | None,
    typer.Option(
        "--keep-after",
        min=0.0,
        help="Seconds after which finished shares are kept on the disk [20].",
        show_default=False,
    ),
]


class Option(NamedTuple):
    """A flag, and the key of the study that it sets; `convert` makes the key's value of the flag's."""

    kind: Any
    section: str = ""
    key: str = ""
    convert: Callable[[Any], Any] | None = None


#: What every verb takes; the first ones are put together by `_stars` and `_sky`.
OBSERVATION = {
    "star": Option(StarFlag),
    "magnitude": Option(MagnitudeFlag),
    "band": Option(BandFlag),
    "magnitude_system": Option(MagnitudeSystemFlag),
    "ebv": Option(EbvFlag),
    "wavelength_unit": Option(WavelengthUnitFlag),
    "flux_unit": Option(FluxUnitFlag),
    "extend": Option(ExtendFlag),
    "bin_nm": Option(BinFlag),
    "exposure": Option(ExposureFlag, "observation", "exposure_s"),
    "instrument": Option(InstrumentFlag, "observation", "instrument"),
    "temperature": Option(TemperatureFlag, "observation", "temperature_c"),
    "sky": Option(SkyFlag),
    "target": Option(TargetFlag),
    "when": Option(TimeFlag),
}
FLARE = {
    "flares": Option(FlaresFlag, "flare", "amplitudes", amplitudes_of),
    "amplitude": Option(AmplitudeFlag, "flare", "amplitudes"),
    "flare_temperature": Option(FlareTemperatureFlag, "flare", "temperature_k"),
    "flare_band": Option(FlareBandFlag, "flare", "band"),
    "geometry": Option(GeometryFlag, "flare", "geometry"),
    "photosphere_temperature": Option(PhotosphereFlag, "flare", "photosphere_temperature_k"),
}
DRAWS = {
    "realisations": Option(RealisationsFlag, "run", "realisations"),
    "seed": Option(SeedFlag, "run", "seed"),
}
DETECTION = {
    "statistic": Option(StatisticFlag, "run", "statistics", names_of),
    "fap": Option(FapFlag, "run", "fap"),
    "tails": Option(TailsFlag, "run", "tails"),
    "reference": Option(ReferenceFlag, "run", "reference"),
    "variances": Option(VariancesFlag, "run", "variances"),
}
CAMPAIGN = {
    "campaign": Option(CampaignFlag, "campaign", "frames"),
    "campaign_step": Option(CampaignStepFlag, "campaign", "step"),
    "campaign_fap": Option(CampaignFapFlag, "campaign", "fap"),
    "campaign_alarms": Option(CampaignAlarmsFlag, "campaign", "alarms"),
}
NUISANCES = {"nuisance": Option(NuisanceFlag), "with_unknowns": Option(WithUnknownsFlag, "nuisances", "usual")}
TEMPLATE = {"template": Option(TemplateFlag, "run", "template_temperatures_k")}
#: What verbs take that tell an S/N.
COUNTED = {"signal": Option(SignalFlag, "observation", "signal")}
STARE = {
    "duration": Option(DurationFlag, "stare", "duration_s"),
    "gap": Option(GapFlag, "stare", "gaps", lambda texts: [gap_of(text) for text in texts]),
    "orbit_gap": Option(OrbitGapFlag, "stare", "orbit_gap_s"),
    "thermal": Option(ThermalFlag, "stare", "thermal", lambda half: {"amplitude": half}),
    "half_width": Option(HalfWidthFlag, "stare", "half_width_s"),
    "shape": Option(ShapeFlag, "stare", "shape"),
    "energy": Option(EnergyFlag, "stare", "energies_erg"),
    "search": Option(SearchFlag, "stare", "search"),
    "with_unknowns": Option(WithUnknownsFlag, "nuisances", "usual"),
}
#: How far or large the star is; put together by `_stars`.
SIZE = {
    "distance": Option(DistanceFlag),
    "radius": Option(RadiusFlag),
    "star_temperature": Option(StarTemperatureFlag),
}
SIGNAL = {
    "snr": Option(SnrFlag, "signal", "snr"),
    "at": Option(AtFlag, "signal", "wavelength_nm"),
    "per": Option(PerFlag, "signal", "per"),
}
AT = {"at": SIGNAL["at"]}
LIMIT = {"of": Option(OfFlag, "limit", "of"), "power": Option(PowerFlag, "limit", "power")}
MAP = {
    "x": Option(XFlag, "map", "x", partial(axis_of, flag="--x")),
    "y": Option(YFlag, "map", "y", partial(axis_of, flag="--y")),
}
UNKNOWN = {
    "unknown": Option(UnknownFlag, "unknowns", "draws"),
    "known": Option(KnownFlag, "unknowns", "known", names_of),
}
SWEEP = {
    "sweep": Option(SweepFlag, "sweep", "axes", lambda texts: [axis_of(text, "--sweep") for text in texts]),
    "as_list": Option(AsListFlag, "sweep", "how", lambda wanted: "list" if wanted else None),
}


BULK = {
    "frames": Option(FramesFlag, "bulk", "frames", frames_of),
    "components": Option(ComponentsFlag, "bulk", "components"),
}
SETTINGS = {"settings": Option(SetFlag)}
#: Where a verb writes and how much it says, and who draws for it: values of its `Session`, with their defaults.
OUTPUT = {"output": (OutputFlag, None), "as_json": (JsonFlag, False), "quiet": (QuietFlag, False)}
PICTURES = {"pictures": (PicturesFlag, True)}
WORKERS = {
    "device": (DeviceFlag, None),
    "cluster": (ClusterFlag, None),
    "resume": (ResumeFlag, False),
    "restart": (RestartFlag, False),
    "keep_after": (KeepAfterFlag, None),
    "insist": (InsistFlag, False),
}
#: Where a verb asks for fewer realisations than a detection, unless told.
FEWER = 100_000


def takes_study(
    *groups: Mapping[str, Option],
    name: str = "",
    without: str = "",
    fewer: bool = False,
    default: Callable[[dict[str, Any]], Study] | None = None,
    draws: bool = True,
    pictures: bool = True,
    observation: Mapping[str, Option] = OBSERVATION,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Let a verb take a study file and flags, and hand it the study and the session that they make.

    Parameters
    ----------
    *groups : mapping of Option
        Flags beside those of the observation.
    name : str
        The verb's, where it is not the function's.
    without : str
        A flag of the observation that the verb does not take.
    fewer : bool
        Whether `FEWER` realisations are the default.
    default : callable, optional
        Makes the study where no file is given, from the flags; the paper's question by default.
    draws, pictures : bool
        Whether the verb draws realisations, and pictures.
    observation : mapping of Option
        In place of the flags of an observation. Where one is called `targets`, a table may stand for the study file.

    Returns
    -------
    callable
        A decorator for functions whose first parameters are the study and the session. One named `given` receives the
        flags; others are options of its own.
    """
    options = {n: o for group in (observation, *groups, SETTINGS) for n, o in group.items() if n != without}
    around = OUTPUT | (PICTURES if pictures else {}) | (WORKERS if draws else {})

    def decorate(verb: Callable[..., None]) -> Callable[..., None]:
        kinds = get_type_hints(verb, localns={"Study": Any, "Session": Any}, include_extras=True)
        _, _, *own = inspect.signature(verb).parameters.values()

        def command(study_file: Path | None = None, **values: Any) -> None:
            from mauvecl.cli.foresight import question_time, question_values
            from mauvecl.cli.session import Session

            for key, (flag, read) in readers.items():
                if values.get(key) is not None and not isinstance(values[key], int | float):
                    values[key] = read(values[key], flag)
            given = {key: values.pop(key, None) for key in options}
            if "targets" in options and study_file is not None and study_file.suffix.lower() == ".csv":
                given["targets"], study_file = study_file, None
            if fewer and study_file is None and given["realisations"] is None:
                given["realisations"] = FEWER
            how = {key: values.pop(key, usual) for key, (_, usual) in around.items()}
            if "given" in kinds:
                values["given"] = given
            study = _study(study_file, given, options, default)
            question_values(study, detects="fap" in options)
            if draws:
                question_time(study, **{key: how[key] for key in ("device", "cluster", "insist")})
            with Session(name or verb.__name__, study, **how) as session:
                verb(study, session, **values)

        named = inspect.Parameter.KEYWORD_ONLY
        parameters = [
            inspect.Parameter("study_file", named, default=None, annotation=StudyFile),
            *(inspect.Parameter(key, named, default=None, annotation=o.kind) for key, o in options.items()),
            *(p.replace(kind=named, annotation=kinds[p.name]) for p in own if p.name != "given"),
            *(inspect.Parameter(key, named, default=usual, annotation=kind) for key, (kind, usual) in around.items()),
        ]
        readers = {}
        for place, parameter in enumerate(parameters):
            # Numbers come as text: whatever is wrong with one is told in one style.
            kind, flag, read = as_text(parameter.annotation)
            if read is not None:
                readers[parameter.name] = flag or "--" + parameter.name.replace("_", "-"), read
                default_text = None if parameter.default is None else f"{parameter.default:g}"
                parameters[place] = parameter.replace(annotation=kind, default=default_text)
        command.__name__, command.__doc__ = verb.__name__, verb.__doc__
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {p.name: p.annotation for p in parameters}
        return command

    return decorate


def _study(
    file: Path | None,
    given: dict[str, Any],
    options: Mapping[str, Option],
    default: Callable[[dict[str, Any]], Study] | None,
) -> Study:
    """A study file, or the default, with the flags on top, and ``--set`` on top of those."""
    from mauvecl.host.errors import InputError
    from mauvecl.study.study import Study

    study = Study.read(file) if file is not None else default(given) if default else Study()
    changes: dict[str, dict[str, Any]] = {"sky": _sky(given)}
    setting: dict[tuple[str, str], str] = {}
    for name, option in options.items():
        if option.section:
            value = given[name]
            if value is not None:
                other = setting.setdefault((option.section, option.key), name)
                if other != name:
                    raise InputError(
                        f"--{other} and --{name} are both given, expected one of them: both set "
                        f"{option.section}.{option.key}"
                    )
                changes.setdefault(option.section, {})[option.key] = option.convert(value) if option.convert else value
    if given.get("nuisance"):
        changes.setdefault("nuisances", {}).update(_nuisances(study, given["nuisance"]))
    changed = study.with_changes(changes, _stars(study, given))
    return changed.with_settings(given["settings"]) if given["settings"] else changed


def _sky(given: dict[str, Any]) -> dict[str, Any]:
    from mauvecl.host.errors import InputError

    if "when" not in given:
        return {}
    found: dict[str, Any] = {"target": given["target"], "time": given["when"]}
    text = given["sky"]
    if text is not None and text.strip().lower() == "none":
        found["none"] = True
    elif text is not None:
        try:
            found["surface_brightness"] = float(text)
        except ValueError as error:
            raise InputError(f"--sky {text!r}, expected V mag/arcsec^2 or none") from error
    return found


def _nuisances(study: Study, texts: list[str]) -> dict[str, Any]:
    """What is unknown, as words: dark=0.1, or a file's name, as in stray.txt=free."""
    from mauvecl.host.errors import InputError
    from mauvecl.host.files.bounded import shortened
    from mauvecl.statistics.names import NUISANCES

    found: dict[str, Any] = {}
    own = {name: one.model_dump(exclude_none=True) for name, one in study.nuisances.own.items()}
    for text in texts:
        name, _, sd = (part.strip() for part in text.rpartition("="))
        if not (name and sd):
            raise InputError(
                f"--nuisance {shortened(text)}, expected NAME=SD, with a name of {', '.join(NUISANCES)} or a file's, "
                "and a standard deviation or free"
            )
        if name in NUISANCES:
            found[name] = sd
        else:
            own[Path(name).stem] = {"file": Path(name), "sd": sd}
    return found | ({"own": own} if own else {})


def _stars(study: Study, given: dict[str, Any]) -> list[dict[str, Any]] | None:
    from mauvecl.host.errors import InputError

    if "star" not in given:
        return None
    names, magnitudes = given["star"], given["magnitude"]
    same = {key: given[key] for key in ("band", "magnitude_system", "ebv", "bin_nm") if given[key] is not None}
    sizes = {"distance_pc": "distance", "radius_rsun": "radius", "effective_temperature_k": "star_temperature"}
    same |= {key: given[flag] for key, flag in sizes.items() if given.get(flag) is not None}
    of_files = {key: given[key] for key in ("wavelength_unit", "flux_unit", "extend") if given[key] is not None}
    if not (names or magnitudes or same or of_files):
        return None
    if names:
        # A name that is a file's is a file; anything else is looked up in the library.
        stars: list[dict[str, Any]] = [{"file": name} if _is_file(name) else {"library": name} for name in names]
    else:
        stars = [entry.model_dump(exclude_none=True) for entry in study.star]
    if magnitudes:
        if len(magnitudes) not in (1, len(stars)):
            raise InputError(f"{len(magnitudes)} magnitudes for {len(stars)} stars, expected one for all or one each")
        for entry, value in zip(stars, magnitudes * (len(stars) if len(magnitudes) == 1 else 1), strict=True):
            entry["magnitude"] = value
    if of_files and not any("file" in entry for entry in stars):
        flags = " and ".join("--" + key.replace("_", "-") for key in of_files)
        raise InputError(f"{flags} without a spectrum file among the stars, expected --star FILE")
    return [entry | same | (of_files if "file" in entry else {}) for entry in stars]


def _is_file(name: str) -> bool:
    from mauvecl.host.spectra.formats import without_columns

    try:
        file, _ = without_columns(name)
        if file.exists():
            return True
    except (OSError, ValueError):
        # What no file name can be is refused as one.
        return True
    # "K2.5V" looks like a file's name and is not one.
    return bool(file.suffix) and not file.suffix[1:].isupper()
