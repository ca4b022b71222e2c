"""The flags that verbs share: what each is called, what it says, and the key of the study that it sets."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from mauvecl.cli.values import amplitudes_of, axis_of, frames_of, gap_of, lines_of, names_of

StudyFile = Annotated[
    Path | None,
    typer.Argument(
        help="Study (TOML), the ECSV table of an answer, or a star as for --star; flags override it.",
        show_default=False,
    ),
]
DeviceFlag = Annotated[
    str | None,
    typer.Option(metavar="TEXT", help="OpenCL device: number or part of its name [PoCL].", show_default=False),
]
JsonFlag = Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")]
QuietFlag = Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress and no file names.")]


WavelengthUnitFlag = Annotated[
    str | None,
    typer.Option(
        metavar="TEXT", help="Of a spectrum file's wavelengths, as in Angstrom, or 'nm air'.", show_default=False
    ),
]
FluxUnitFlag = Annotated[
    str | None,
    typer.Option(metavar="TEXT", help="Of a spectrum file's fluxes, as in 'W m-2 nm-1'.", show_default=False),
]
ExtendFlag = Annotated[
    str | None,
    typer.Option(
        metavar="TEXT",
        help="Library spectrum that goes on where a spectrum file ends, scaled to it.",
        show_default=False,
    ),
]


class Flag(NamedTuple):
    """A flag, and the key of the study that it sets; `convert` makes the key's value of the flag's."""

    name: str
    kind: Any
    section: str = ""
    key: str = ""
    convert: Callable[[Any], Any] | None = None


def flag(kind: Any, names: str, text: str, sets: str = "", convert: Callable[[Any], Any] | None = None) -> Flag:
    """A flag that nobody must give.

    Parameters
    ----------
    kind : type
        Of its value: ``list[...]`` for one that may be repeated.
    names : str
        As in ``--exposure -t``; the first is its parameter's.
    text : str
        What `--help` says of it; a default in brackets is the study's.
    sets : str
        The key of the study, as in ``observation.exposure_s``; nothing where the verb puts it together with others.
    convert : callable, optional
        Makes the key's value of the flag's.
    """
    first = names.split()[0]
    section, _, key = sets.rpartition(".")
    option = typer.Option(*names.split(), help=text, show_default=False, metavar=_metavar(kind))
    return Flag(
        first.partition("/")[0].lstrip("-").replace("-", "_"), Annotated[kind | None, option], section, key, convert
    )


def _metavar(kind: Any) -> str | None:
    return {str: "TEXT", list[str]: "TEXT", Path: "FILE"}.get(kind)


def group(*flags: Flag) -> dict[str, Flag]:
    """Flags by their names."""
    return {one.name: one for one in flags}


#: What every verb takes; those without a key are put together by `question.stars_of` and `question.sky_of`.
OBSERVATION = group(
    flag(list[str], "--star -s", "Library name or spectrum file; may be repeated, as in G2V,M3V."),
    flag(list[float], "--magnitude -m", "Magnitude, one for all stars or one each, as in 7,8."),
    flag(str, "--band", "Band of the magnitude [V]."),
    flag(str, "--magnitude-system", "What it means: catalogue, vega (Vega is 0 in every band), or ab [catalogue]."),
    flag(float, "--ebv", "Dust before the star, E(B-V), mag (needs mauvecl[extinction])."),
    Flag("wavelength_unit", WavelengthUnitFlag),
    Flag("flux_unit", FluxUnitFlag),
    Flag("extend", ExtendFlag),
    flag(float, "--bin-nm", "Bin the spectrum to this width, nm."),
    flag(float, "--exposure -t", "Seconds, rounded up to 5 s frames [50].", "observation.exposure_s"),
    flag(
        str,
        "--instrument",
        "mauve (as the paper), mauve-electrons (for planning), or your own TOML file [mauve].",
        "observation.instrument",
    ),
    flag(float, "--temperature", "Detector temperature, deg C [21].", "observation.temperature_c"),
    flag(str, "--sky", "Sky brightness, V mag/arcsec^2, or none [22.1]."),
    flag(str, "--target", "Coordinates, with --time: the zodiacal light there and then."),
    flag(str, "--time", "UTC of the observation, with --target."),
)
FLARE = group(
    flag(
        Path,
        "--flares",
        "Amplitudes from a table of flares (CSV, ECSV, FITS; AltaiPony's ampl_rec).",
        "flare.amplitudes",
        amplitudes_of,
    ),
    flag(list[float], "--amplitude -a", "Flare amplitude, 0.24 is 24 %; may be repeated.", "flare.amplitudes"),
    flag(float, "--flare-temperature", "Flare temperature, K [10000].", "flare.temperature_k"),
    flag(str, "--flare-band", "Band of the amplitude [Kepler].", "flare.band"),
    flag(str, "--geometry", "A flare is added to the star, or replaces part of its photosphere [added].",
         "flare.geometry"),
    flag(float, "--photosphere-temperature", "Of the star, K, where a flare replaces some of it.",
         "flare.photosphere_temperature_k"),
)  # fmt: skip
#: The light of a flare in place of one blackbody.
SPECTRUM = group(
    flag(float, "--balmer-jump", "Flux of the flare below the Balmer edge over that above [1].",
         "flare.spectrum.balmer_jump"),
    flag(float, "--second-temperature", "Of a second blackbody of the flare, K, with --second-area.",
         "flare.spectrum.second_temperature_k"),
    flag(float, "--second-area", "Area of the second blackbody over that of the first.", "flare.spectrum.second_area"),
    flag(list[str], "--line", "Emission line as a fraction of the continuum in 200-700 nm, as in 'Mg II=0.05'; may be "
         "repeated.", "flare.spectrum.lines", partial(lines_of, flag="--line")),
    flag(list[str], "--line-flux", "Emission line in erg/s/cm2 at the telescope, as in '280=1e-12'; may be repeated.",
         "flare.spectrum.line_fluxes", partial(lines_of, flag="--line-flux")),
    flag(Path, "--flare-file", "Spectrum of an observed or computed flare.", "flare.spectrum.file"),
    flag(Path, "--flare-quiescent", "Spectrum of its star without the flare, to subtract.", "flare.spectrum.quiescent"),
    flag(str, "--flare-wavelength-unit", "Of these files' wavelengths.", "flare.spectrum.wavelength_unit"),
    flag(str, "--flare-flux-unit", "Of these files' fluxes.", "flare.spectrum.flux_unit"),
    flag(float, "--continue-at", "Temperature of a blackbody that continues the flare's file where it ends, K.",
         "flare.spectrum.continue_at_k"),
)  # fmt: skip
FLARE = FLARE | SPECTRUM
DRAWS = group(
    flag(int, "--realisations -n", "Noise realisations [1000000].", "run.realisations"),
    flag(int, "--seed", "Seed [1].", "run.seed"),
)
#: Where a verb asks for fewer realisations than a detection, unless told.
FEWER = 100_000
FEWER_DRAWS = DRAWS | group(
    flag(int, "--realisations -n", f"Noise realisations [{FEWER}, or the study's].", "run.realisations")
)
DETECTION = group(
    flag(
        list[str],
        "--statistic",
        "chi2, chi2_element, chi2_pair, matched, uv_excess, paper, or all; may be repeated.",
        "run.statistics",
        names_of,
    ),
    flag(float, "--fap", "False-alarm probability per test [0.001].", "run.fap"),
    flag(
        str,
        "--tails",
        "Thresholds with fewer than 100 draws beyond them: counted refuses them, sampled finds them by importance "
        "sampling [counted].",
        "run.tails",
    ),
    flag(
        str,
        "--reference",
        "Compared with: template (noise-free), exposure (noisy), or stack:N of them [template].",
        "run.reference",
    ),
    flag(str, "--variances", "model, or estimated from the counts as an observer must [model].", "run.variances"),
)
CAMPAIGN = group(
    flag(int, "--campaign", "Frames of a whole search: what one test means for all of it.", "campaign.frames"),
    flag(int, "--campaign-step", "Frames from one stack of it to the next [a stack].", "campaign.step"),
    flag(float, "--campaign-fap", "Wanted chance of any false alarm in it: what a test may have.", "campaign.fap"),
    flag(float, "--campaign-alarms", "Wanted number of false alarms in it: what a test may have.", "campaign.alarms"),
)
WITH_UNKNOWNS = flag(
    bool,
    "--with-unknowns",
    "Draw the documented unknowns of this question, and marginalise over them.",
    "nuisances.usual",
)
NUISANCES = group(
    flag(
        list[str],
        "--nuisance",
        "Marginalise over dark, light, sky, tilt or a file's spectrum, with a standard deviation or free, as in "
        "dark=0.1 or stray.txt=free; may be repeated.",
    ),
    WITH_UNKNOWNS,
)
TEMPLATE = group(
    flag(
        list[float],
        "--template",
        "Look also for flares of this temperature, K: what a wrong template costs; may be repeated.",
        "run.template_temperatures_k",
    )
)
#: What verbs take that tell an S/N.
COUNTED = group(
    flag(
        str,
        "--signal",
        "In an S/N: net (the star alone) or paper (zodiacal light counts too) [net].",
        "observation.signal",
    )
)
SHAPES = "Of flares: davenport2014, tovarmendoza2022, fiducial [davenport2014]."
STARE = group(
    flag(float, "--duration", "Of the stare, s [5680, an orbit].", "stare.duration_s"),
    flag(
        list[str],
        "--gap",
        "Nothing is recorded from:to, s, as in 1000:2000; may be repeated.",
        "stare.gaps",
        lambda texts: [gap_of(text) for text in texts],
    ),
    flag(float, "--orbit-gap", "Gap at the end of every orbit, s [0].", "stare.orbit_gap_s"),
    flag(
        float,
        "--thermal",
        "Known thermal cycle of the orbit, +- deg C [0].",
        "stare.thermal",
        lambda half: {"amplitude": half},
    ),
    flag(float, "--half-width", "Of the flares, s [60].", "stare.half_width_s"),
    flag(str, "--shape", SHAPES, "stare.shape"),
    flag(
        list[float],
        "--energy",
        "Bolometric energy of a flare, erg, in place of amplitudes; may be repeated.",
        "stare.energies_erg",
    ),
    flag(bool, "--search/--no-search", "Search the stare for flares, as [search] has it [search].", "stare.search"),
    WITH_UNKNOWNS,
)
#: How far away or large the star is: keys of a star, which `question.stars_of` puts together.
SIZE = group(
    flag(float, "--distance", "Of the star, pc, for energies.", "distance_pc"),
    flag(float, "--radius", "Of the star, solar radii, for energies.", "radius_rsun"),
    flag(float, "--star-temperature", "Effective temperature of the star, K, for energies.", "effective_temperature_k"),
)
SIGNAL = group(
    flag(float, "--snr", "Wanted signal-to-noise ratio.", "signal.snr"),
    flag(float, "--at", "Wavelength, nm.", "signal.wavelength_nm"),
    flag(str, "--per", "element (10.5 nm) or pixel [element].", "signal.per"),
)
AT = {"at": SIGNAL["at"]}
LIMIT = group(
    flag(str, "--of", "magnitude, amplitude or exposure [magnitude].", "limit.of"),
    flag(float, "--power", "Wanted detection probability [0.9].", "limit.power"),
)
MAP = group(
    flag(str, "--x", "Such as magnitude:4:10:16, or exposure=5,50,600.", "map.x", partial(axis_of, flag="--x")),
    flag(str, "--y", "Such as amplitude:0.01:1:16:log.", "map.y", partial(axis_of, flag="--y")),
)
UNKNOWN = group(
    flag(int, "--unknown", "Average over so many draws of what is unknown of the instrument [0].", "unknowns.draws"),
    flag(
        list[str],
        "--known",
        "What of it is known after all, as in temperature_c,light_loss.",
        "unknowns.known",
        names_of,
    ),
)
SWEEP = group(
    flag(
        list[str],
        "--sweep",
        "Values of a quantity, as in exposure=5,50,600 or magnitude:4:10:7; several give every combination.",
        "sweep.axes",
        lambda texts: [axis_of(text, "--sweep") for text in texts],
    ),
    flag(
        bool,
        "--as-list",
        "Sweep side by side instead of every combination.",
        "sweep.how",
        lambda wanted: "list" if wanted else None,
    ),
)
MEASURE = group(
    flag(list[str], "--model", "Fitted: blackbody, balmer, lines [the flare's, and simpler ones]; may be repeated.",
         "measure.models", names_of),
    flag(list[str], "--fit-line", "Line that the model 'lines' fits [the flare's]; may be repeated.", "measure.lines",
         names_of),
    flag(int, "--fits", "Simulated exposures of each flare [1000].", "measure.fits"),
    flag(float, "--snr-per-bin", "Measure the flares of the stare, too, against time, in bins of this S/N.",
         "measure.snr_per_bin"),
)  # fmt: skip
BULK = group(
    flag(
        str,
        "--frames",
        "stack (an exposure's sum), all, or numbers of frames such as 0,4,9 [stack].",
        "bulk.frames",
        frames_of,
    ),
    flag(bool, "--components", "Keep also mean star, sky and noise of each pixel.", "bulk.components"),
)
SETTINGS = group(flag(list[str], "--set", "Any key of the study, as in run.fap=0.01; may be repeated."))


def output_flag(usual: str) -> Any:
    """Where a verb writes, and where unless told."""
    return Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="PATH", help=f"Where to write [{usual}].", show_default=False),
    ]


#: How much a verb says, and who draws for it: values of its `Session`, with their defaults.
TELLING = {"as_json": (JsonFlag, False), "quiet": (QuietFlag, False)}
PICTURES = {
    "pictures": (
        Annotated[bool, typer.Option("--pictures/--no-pictures", help="Draw pictures (needs mauvecl[plot]).")],
        True,
    )
}


def _worker(kind: Any, name: str, text: str, **how: Any) -> Any:
    return Annotated[kind, typer.Option(name, help=text, metavar=_metavar(kind), show_default=False, **how)]


WORKERS = {
    "device": (
        _worker(
            str | None,
            "--device",
            "OpenCL device: number or part of its name [PoCL; 0,1 for several together].",
        ),
        None,
    ),
    "cluster": (
        _worker(
            str | None,
            "--cluster",
            "Draw on Dask workers: local:N, tcp://host:8786, or a scheduler file (needs mauvecl[cluster]).",
        ),
        None,
    ),
    "resume": (_worker(bool, "--resume", "Go on with the unfinished run in the output folder."), False),
    "restart": (_worker(bool, "--restart", "Forget the unfinished run in the output folder."), False),
    "keep_after": (
        _worker(
            float | None,
            "--keep-after",
            "Seconds after which finished parts of the work are kept on the disk [20].",
            min=0.0,
        ),
        None,
    ),
    "insist": (
        _worker(bool, "--insist", "Begin even what would take more than a year, or more than the disk has room for."),
        False,
    ),
}
#: Of verbs that can be resumed, and draw no realisations.
RESUMING = {name: WORKERS[name] for name in ("resume", "restart", "keep_after")}
