"""The registry of verbs: the questions that mauvecl answers, by one name in Python and on the command line."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

if TYPE_CHECKING:
    from mauvecl.study.study import Keyword, Study

#: Function that is called as ``progress(done, total)``; it may raise to stop the work.
Progress = Callable[[int, int], None] | None

#: Headings of the command line's list of commands and of the page's tabs, by the group of a verb.
GROUPS = {
    "plan": "Plan observations",
    "simulate": "Simulate observations",
    "analyse": "Analyse observations",
    "tools": "Tools",
}

#: Default of verbs that need fewer realisations than a detection.
FEWER = {"run.realisations": 100_000}

# Keys of a study whose flags verbs take, in the order of `--help`.

#: Keys of a star's spectrum, brightness and neighbours.
STAR = (
    *("library", "magnitude", "band", "magnitude_system", "ebv", "wavelength_unit", "flux_unit", "extend"),
    *("ignore_checksum", "bin_nm", "neighbours", "neighbours_of", "neighbour_share"),
)
INSTRUMENT = ("observation.instrument", "observation.temperature_c")
#: Keys of every verb that observes.
OBSERVATION = (*(f"star.{key}" for key in STAR), "observation.exposure_s", *INSTRUMENT, "sky")
WITHOUT_EXPOSURE = tuple(key for key in OBSERVATION if key != "observation.exposure_s")
SIZE = ("star.distance_pc", "star.radius_rsun", "star.effective_temperature_k")
SIGNAL = ("observation.signal",)
DRAWS = ("run.realisations", "run.seed")
DETECTION = ("run.statistics", "run.fap", "run.tails", "run.reference", "run.variances")
#: Whether everything but the noise is known.
USUAL = "nuisances.usual"
NUISANCES = ("nuisances.own", USUAL)
UNKNOWN = ("unknowns.draws", "unknowns.known")
FRAMES = ("stare.duration_s", "stare.gaps", "stare.orbit_gap_s", "stare.thermal", "stare.pointing")
STARE = (*FRAMES, "stare.half_width_s", "stare.shape", "stare.energies_erg", "stare.search", USUAL)
FLARE_LIGHT = tuple(
    f"flare.{key}" for key in ("temperature_k", "band", "geometry", "photosphere_temperature_k", "spectrum")
)
ALARMS = ("search.false_alarms", "search.per")
#: Keys of the orbit, apart from the targets, which `TARGETS` has.
ORBIT = (*(f"orbit.{key}" for key in ("start", "days", "step_s", "tle", "kind", "simbad")), "orbit.limits")
TARGETS = ("orbit.targets", "plan.targets")
#: Flags that `--help` shows of every verb that has them; `--help-all` shows all.
COMMON = ("star", "magnitude", "exposure", "amplitude", "paper", "output")


@dataclass(frozen=True)
class Verb:
    """A question, answered by the function of the same name: ``verb(study, engine=None, progress=None) -> Answer``."""

    name: str
    help: str  # help text of the command, with examples
    keys: tuple[str, ...]  # keys and sections of the study whose flags the command takes, in the order of `--help-all`
    # Key of `GROUPS`: where `mauvecl` lists the command, and the page its tabs.
    group: str = "plan"
    common: tuple[str, ...] = ()  # parameters of flags that `--help` shows in addition to `COMMON`
    counts: str = ""  # what the command line's progress bar counts; empty if a closed form answers at once
    # Values of keys where neither a study file nor a flag is given, if they differ from the study's.
    defaults: Mapping[str, Any] | None = None
    # Makes the study from the flags where no file is given; the paper's question by default.
    default: Callable[[dict[str, Any]], Study] | None = None
    # Whether the page has a tab for the answer; a tab without a class of its own shows the answer's first view.
    tab: bool = False

    def accepts(self, key: str) -> bool:
        """Return whether the command has the flags of a key or section of the study."""
        return any(key == prefix or key.startswith(f"{prefix}.") for prefix in self.keys)

    def study_of(
        self, values: dict[str, Any], keywords: Mapping[str, Keyword], study: Study | None, where: str
    ) -> tuple[Study, list[str]]:
        """Return the study that keywords of the verb ask for, with messages on what they do not state.

        `values` has that of each keyword, or None, and also ``paper``, and ``setting``, texts of any keys. They
        change the study or, without one, the verb's default; `where` names their origin in messages.
        """
        from mauvecl.study.study import Study, with_keywords

        is_default = study is None
        if study is None:
            for name, keyword in keywords.items():
                if values[name] is None:
                    values[name] = (self.defaults or {}).get(keyword.path)
            study = self.default(values) if self.default else Study()
        study = with_keywords(study, values, keywords, where, is_default=is_default)
        if values.get("setting"):
            study = study.with_settings(values["setting"], where)
        if not is_default or values.get("tails", study) is not None:
            return study, []
        # Maps and limits would sample a tail in each cell or step, which takes longer than more realisations.
        return study.with_enough_tails(sampled=self.counts != "cells", raised=self.counts in ("cells", "steps"))

    @property
    def ask(self) -> Callable[..., Any]:
        """The function that answers, whose module is imported at the first use."""
        function: Callable[..., Any] = getattr(import_module("mauvecl"), self.name)
        return function


def _budgets_or_star(values: dict[str, Any]) -> Study:
    """Return the study of the paper's noise budgets if no flag names a star, else the default one."""
    from mauvecl.study.study import PAPER_BUDGETS, Study

    return Study() if any(values[name] for name in ("star", "magnitude", "exposure", "sweep")) else PAPER_BUDGETS


def _formula_grid(values: dict[str, Any]) -> Study:
    """Return a study that sweeps what no flag states: magnitudes, exposures, or both."""
    from mauvecl.study.questions import Axis, Sweep
    from mauvecl.study.study import Study

    magnitudes = [] if values["magnitude"] else [Axis(quantity="magnitude", values=(4.0, 6.0, 8.0, 10.0, 12.0))]
    exposures = (5.0, 50.0, 600.0) if values["exposure"] is None else (values["exposure"],)
    return Study(sweep=Sweep(axes=(*magnitudes, Axis(quantity="exposure", values=exposures))))


#: Verbs by name, in the order of `mauvecl --help`: for one star, for flares, for hours and for campaigns.
VERBS: dict[str, Verb] = {
    verb.name: verb
    for verb in (
        Verb(
            "simulate",
            """Simulate one observation, and show what it consists of.

    Star, sky, photon noise, dark, bias, read noise, and the closed-form S/N.

    Example: mauvecl simulate --star G2V --magnitude 7.4 --exposure 50 --amplitude 0.24
    """,
            (*OBSERVATION, "flare", *SIGNAL, "run.seed"),
            group="simulate",
            common=("flare_temperature", "sky", "seed"),
        ),
        Verb(
            "snr",
            """Compute signal-to-noise ratios and noise budgets.

    Of each pixel and of each resolution element (10.5 nm for Mauve).

    The signal is the star's alone: the sky is subtracted, and its photons are noise (`--signal paper`: signal as well).

    Without arguments: the three stars of the paper's noise budgets, 50 s and 600 s.

    Examples: mauvecl snr --star B2IV --magnitude 3.03 --exposure 5

    mauvecl snr --star G2V --sweep magnitude=4,6,8,10 --sweep exposure=5,50,600
    """,
            (*OBSERVATION, *DRAWS, *SIGNAL, "signal.wavelength_nm", "sweep"),
            group="simulate",
            common=("realisations", "at", "signal", "sky", "sweep"),
            counts="realisations",
            defaults=FEWER,
            default=_budgets_or_star,
        ),
        Verb(
            "exposure",
            """Find the shortest exposure with a wanted S/N at a wavelength.

    By the closed form, in whole frames; `mauvecl snr` goes the other way.

    Example: mauvecl exposure --snr 10 --at 300 --star G2V --magnitude 7.4
    """,
            (*WITHOUT_EXPOSURE, "signal", *SIGNAL),
            common=("snr", "at", "per", "sky"),
        ),
        Verb(
            "detect",
            """Tell whether flares would be seen: thresholds, probabilities.

    Without arguments: the paper's K3V star of V = 3.7 and G2V star of V = 7.4 with flares of 0.76, 2, 8.1 and 24 %,
    50 s, one million realisations.

    Example: mauvecl detect --star K5V --magnitude 6 --amplitude 0.05 --amplitude 0.1 --exposure 30
    """,
            (*OBSERVATION, "flare", *DRAWS, *DETECTION, "campaign", *NUISANCES, "run.template_temperatures_k", "sweep"),
            common=("flare_temperature", "realisations", "fap", "with_unknowns", "sweep"),
            counts="realisations",
        ),
        Verb(
            "limit",
            """Find the limiting magnitude, smallest amplitude or exposure.

    Of a star or flare that is seen with a wanted probability.

    Starts from the closed form, settles it by simulation, and simulates the answer again with a fresh seed.

    Example: mauvecl limit --star G2V --amplitude 0.24 --exposure 50
    """,
            (*OBSERVATION, "limit", "flare", *DRAWS, *DETECTION, *NUISANCES, *UNKNOWN, "sweep"),
            common=("of", "power", "realisations", "fap", "with_unknowns"),
            counts="steps",
            tab=True,
        ),
        Verb(
            "map",
            """Map the detection probability over two quantities, for one star.

    Quantities: magnitude, amplitude, flare_temperature, exposure, detector_temperature, sky, star. All cells are drawn
    with the same random numbers.

    Example: mauvecl map --star G2V --x magnitude:4:10:16 --y amplitude:0.01:1:16:log
    """,
            (*OBSERVATION, "map", "flare", *DRAWS, *DETECTION, *NUISANCES, *UNKNOWN),
            common=("x", "y", "realisations", "fap", "with_unknowns"),
            counts="cells",
            defaults=FEWER,
        ),
        Verb(
            "gaussian",
            """Find where the usual root-of-N formula is wrong.

    Its S/N, intervals and false alarms are compared with those of realisations.

    Without a study or sweep: magnitudes from 4 to 12 and exposures of 5, 50 and 600 s, where --magnitude or --exposure
    states no others.

    Example: mauvecl gaussian --star G2V --sweep magnitude=6,10 --sweep exposure=5,50
    """,
            (*OBSERVATION, *DRAWS, *DETECTION, *SIGNAL, "sweep"),
            group="simulate",
            common=("realisations", "fap", "signal", "sweep"),
            counts="realisations",
            defaults=FEWER,
            default=_formula_grid,
        ),
        Verb(
            "measure",
            """Measure simulated spectra of flares, and how well that works.

    Temperature, area, energy, Balmer jump and lines: errors in advance, simulated fits with the coverage of their
    intervals, the same for flares that a search detects, and what a too simple model makes of the flare.

    Examples: mauvecl measure --star M3V -m 9 -a 0.5 --balmer-jump 2 --nuisance dark=free --nuisance light=free

    mauvecl measure --star M3V --magnitude 9 --amplitude 0.5 --sweep exposure=50,300 --distance 5 --radius 0.4

    mauvecl measure --star M3V --magnitude 9 --amplitude 2 --snr-per-bin 20 --joint-fit --duration 1800 --distance 5
    """,
            (*OBSERVATION, "flare", "measure", *STARE, *NUISANCES, *SIZE, "run.fap", "run.seed", "sweep"),
            common=("flare_temperature", "balmer_jump", "distance", "with_unknowns", "sweep"),
            counts="flares",
            tab=True,
        ),
        Verb(
            "stare",
            """Simulate a stare: light curves, spectra, flares, a search.

    Without arguments: the paper's two stars over one orbit, four flares each. The FITS files are read by lightkurve.

    Examples: mauvecl stare --star M3V --magnitude 9 --amplitude 0.5 --half-width 60 --thermal 0.5

    mauvecl stare --star G2V --magnitude 7.4 --distance 14.1 --energy 1e33 --energy 1e34 --orbit-gap 2100
    """,
            (*WITHOUT_EXPOSURE, "flare", *STARE, *SIZE, "run.seed", "sweep"),
            group="simulate",
            common=("duration", "orbit_gap", "half_width", "energy", "distance", "with_unknowns"),
            counts="stares",
        ),
        Verb(
            "inject",
            """Find which flares a search detects: completeness, false alarms.

    Over energy (or amplitude) and half-width, with the errors of recovered flares.

    Flares are injected into drawn stares and searched for with a bank of filters. The stare lasts a day by default.

    Examples: mauvecl inject --star G2V --magnitude 7.4 --distance 14.1 --false-alarms 1 --alarms-per month

    mauvecl inject --star M3V --magnitude 9 --orbit-gap 2100 --with-unknowns --sweep flare_temperature=7000,10000,15000
    """,
            (*WITHOUT_EXPOSURE, *FLARE_LIGHT, *FRAMES, USUAL, *SIZE, "search", "injections", "run.seed", "sweep"),
            common=("duration", "orbit_gap", "distance", "false_alarms", "alarms_per", "injections", "with_unknowns"),
            counts="injections",
            defaults={"stare.duration_s": 86_400.0},
        ),
        Verb(
            "analyse",
            """Flares in observed frames, with their false alarms.

    Reads light curves of mauvecl, TESS and Kepler as they are, and other tables through a mapping (TOML). Spectra of
    the instrument are searched with weights for flares, which are measured: name the star for energies. Nothing is
    deleted in silence: the table of frames states why a frame is not searched.

    Examples: mauvecl analyse light-curve-1.fits --false-alarms 1 --alarms-per month

    mauvecl analyse light-curve-1.fits --star M3V --magnitude 9 --distance 5
    """,
            (*WITHOUT_EXPOSURE, "data", "orbit.tle", "orbit.kind", *SIZE, "flare.temperature_k", *ALARMS, "run.seed"),
            group="analyse",
            common=("mapping", "quality_bits", "false_alarms", "alarms_per", "distance", "report"),
            counts="frames",
            tab=True,
        ),
        Verb(
            "change",
            """Find the smallest change between visits that can be seen.

    Of lines, bands, Balmer jump, colour, or of a spectrum from a file; with `--periods`, which periods are recovered
    from visits that the orbit allows.

    Examples: mauvecl change --star M3V -m 9 --exposure 600 --nuisance dark=free --nuisance light=0.02

    mauvecl change --star K5V -m 8 --exposure 300 --visits 40 --periods --look-at "eps Eri" --days 60
    """,
            (*OBSERVATION, "change", "limit.power", "run.fap", "run.seed", *NUISANCES, *ORBIT, *TARGETS, "sweep"),
            common=("change", "visits", "periods", "look_at", "days", "with_unknowns"),
            tab=True,
        ),
        Verb(
            "calibrate",
            """Fit an instrument to frames of standard stars and dark frames.

    Throughput with its covariance, dark current, gain, read noise, line width and wavelength zero point. The study
    names the observations; the instrument file that is written serves every verb.

    Example: mauvecl calibrate standards.toml
    """,
            ("observation.instrument", "sky", "calibrate"),
            group="analyse",
            common=("knots", "light_error", "spectrum_error"),
            tab=True,
        ),
        Verb(
            "visible",
            """Find when targets can be seen from the orbit.

    Windows, hours by day and month, the Sun's distance, zodiacal light, a calendar.

    Example: mauvecl visible --look-at "eps Eri" --look-at "AU Mic" --start 2027-01-01 --days 365
    """,
            (*ORBIT, *TARGETS),
            common=("look_at", "targets", "start", "days", "simbad"),
        ),
        Verb(
            "plan",
            """Plan a campaign: hours, expected flares, false alarms; a report.

    The table has a column name, and what is known of each star: ra and dec, V, spectral_type, distance_pc, mass_msun
    and age_myr, or other rates of flares. Stars of the embedded list need their names only.

    Example: mauvecl plan targets.csv --hours 200 --start 2027-01-01
    """,
            (*ORBIT, "plan", *ALARMS, *INSTRUMENT, "flare.temperature_k", "flare.band", "flare.spectrum", USUAL),
            common=("targets", "hours", "start", "days", "completeness", "report", "false_alarms"),
            counts="targets",
            tab=True,
        ),
    )
}

Answered = TypeVar("Answered", covariant=True)


class Question(Protocol[Answered]):
    """Function of a verb, which takes a study or the keywords of one."""

    def __call__(
        self, study: Study | None = None, engine: Any = None, progress: Progress = None, **keywords: Any
    ) -> Answered: ...


#: End of the docstring of every verb.
COMMON_PARAMETERS = """

Other Parameters
----------------
study : Study, optional
    By default that of the command line.
engine : Engine, Stares or Pool, optional
    What draws, if anything is drawn; by default that of the default device. A pool's checkpoint keeps finished work.
progress : callable, optional
    Called as ``progress(done, total)`` in {parts}; may raise to stop the work.
**keywords
    Flags of the command, as in ``star="M4V"``, ``magnitude=11``: they change the study, or the default. ``ideal=True``
    asks with everything known but the noise, and ``paper=True`` with the conventions of the MauveSim paper.
"""


def by_keywords(parts: str) -> Callable[[Callable[..., Answered]], Question[Answered]]:
    """Return a decorator that lets the function of a verb take keywords, named as the flags of its command.

    It also validates the arguments, and describes those that all verbs have; `parts` is what progress counts.
    """
    from mauvecl.schema.calls import validated

    def decorate(function: Callable[..., Answered]) -> Question[Answered]:
        checked = validated(function)
        checks = vars(checked)["__validated__"]

        @wraps(checked)
        def ask(study: Any = None, *arguments: Any, **keywords: Any) -> Any:
            arguments_by_name = {key: keywords.pop(key) for key in tuple(keywords) if key in checks}
            if study is None or keywords:
                from mauvecl.study.study import keys_of, values_of

                verb, where = VERBS[function.__name__], f"{function.__name__}()"
                flags = {keyword.name: keyword for keyword in keys_of(verb.keys)}
                values, given_study = values_of(keywords, flags, where), study and checks["study"](study)
                study, messages = verb.study_of(values, flags, given_study, where)
                for message in messages:
                    warnings.warn(message, stacklevel=2)
            return checked(study, *arguments, **arguments_by_name)

        study, *parameters = inspect.signature(function).parameters.values()
        keywords = inspect.Parameter("keywords", inspect.Parameter.VAR_KEYWORD, annotation=Any)
        vars(ask)["__signature__"] = inspect.Signature([study.replace(default=None), *parameters, keywords])
        ask.__doc__ = f"{inspect.getdoc(function)}{COMMON_PARAMETERS.format(parts=parts)}"
        return ask

    return decorate
