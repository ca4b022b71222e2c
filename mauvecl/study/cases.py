"""Cases of a study: each star at each combination of swept values, with its labels, messages and assumptions."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Any, Literal, Self, cast

import numpy as np

from mauvecl.noise.drawing import Cumulants, stack_is_exact
from mauvecl.noise.unknowns import COURSES, PROCESSES, Processes, default_processes
from mauvecl.schema.columns import Column, percent
from mauvecl.schema.errors import InputError, Message, of_kind
from mauvecl.schema.fields import as_typed
from mauvecl.study.questions import QUANTITIES, Sweep
from mauvecl.study.star import Star
from mauvecl.study.stare import KNOWN_CHANGES, EventChoice, stare_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mauvecl.detection.nuisances import Nuisances
    from mauvecl.detection.statistics import Setting
    from mauvecl.flares.energies import EnergyScale, Kind
    from mauvecl.flares.frames import StareExpectation
    from mauvecl.flares.stare import Event, Stare
    from mauvecl.host.exposure.background import Neighbours, Sky
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.stars.source import Source
    from mauvecl.study.observation import Observation, SkyLight
    from mauvecl.study.study import Study

#: Parts of a study that answers use.
Use = Literal[
    "instrument", "sky", "flare", "orbit", "processes", "nuisances", "stare", "values", "templates", "sweep", "seed"
]  # fmt: skip
#: Parts that hold unknowns: processes of draws, nuisance parameters of statistics, changes during a stare, and
#: instrument values that are averaged over.
UNKNOWN_USES: tuple[Use, ...] = ("processes", "nuisances", "stare", "values")


def assumptions_of(study: Study, uses: Collection[Use], varied: Collection[str] = ()) -> list[str]:
    """Return the assumptions of a study about the parts that an answer uses, one clause each.

    The answer varies the quantities `varied` in addition to those of the sweep, if it uses that.
    """
    axes, clauses = study.sweep.axes, []
    swept = {axis.quantity for axis in axes if "sweep" in uses} | set(varied)
    if "instrument" in uses:
        clauses.append(_instrument(study, swept, uses))
    if "sky" in uses:
        clauses.append("sky as swept" if "sky" in swept else study.sky.describe())
    if "flare" in uses:
        clauses.append(_flare(study, swept, uses))
    if "orbit" in uses:
        elements, limits = study.orbit.tle, study.orbit.limits
        angles = {"Earth's limb": limits.earth_limb_deg, "Sun": limits.sun_deg, "Moon": limits.moon_deg}
        least = ", ".join(f"{name} {value:g} deg" for name, value in angles.items() if value is not None) or "none"
        clauses.append(f"orbit of {elements.name if elements else 'embedded elements'}; least angles: {least}")
    if {*UNKNOWN_USES} & {*uses}:
        clauses.append(_unknowns(study, uses))
    if "templates" in uses:
        clauses.append(f"flares of the shape {study.search.shape}; noise as measured")
    if "seed" in uses:
        clauses.append(f"seed {study.run.seed}")
    unused = [key for use, keys in _given_unknowns(study).items() if use not in uses for key in keys]
    unused += ["sweep.axes"] if axes and "sweep" not in uses else []
    # Verbs of an orbit look at targets, not at the study's star.
    observes = "instrument" in uses and "orbit" not in uses
    unused += ["star.neighbours"] if not observes and any(star.neighbours for star in study.star) else []
    return [*clauses, f"not used: {', '.join(unused)}"] if unused else clauses


def _instrument(study: Study, swept: set[str], uses: Collection[str]) -> str:
    """Return the clause on the instrument."""
    o = study.observation
    text = f"instrument {o.instrument}"
    if o.changes:
        text += f" with another {', '.join(o.changes)}"
    if "detector_temperature" in swept:
        return f"{text}, detector temperature as swept"
    if "orbit" in uses and study.plan.along_orbit and o.temperature_c is None:
        return f"{text}, detector temperature along the orbit"
    if "orbit" not in uses and "stare" in uses and study.stare.along_orbit:
        return f"{text}, detector temperature of the stare along the orbit"
    return f"{text}, detector at {o.load_instrument().temperature_c:g} deg C"


def _flare(study: Study, swept: set[str], uses: Collection[str]) -> str:
    """Return the clause on the flares."""
    f, replaces = study.flare, "replacing photosphere"
    temperature = "of swept temperature" if "flare_temperature" in swept else f"of {f.light().describe()}"
    if "stare" in uses and any(event.temperature_k is not None for event in study.events):
        temperature += " or as events state"
    if f.geometry == "replaces" and f.photosphere_temperature_k is not None:
        replaces += f" of {f.photosphere_temperature_k:g} K"
    geometry = "added to the star" if f.geometry == "added" else replaces
    size = "as bright as observed" if f.spectrum.as_observed else f"amplitudes in the {f.band} band"
    return f"flares {temperature}, {geometry}, {size}"


def _given_unknowns(study: Study) -> dict[Use, dict[str, str]]:
    """Return the study's unknowns in words, by the parts that hold them and by key."""
    n, s, draws = study.nuisances, study.stare, study.unknowns.draws
    changes = {f"stare.{name}": name for name in KNOWN_CHANGES if getattr(s, name) is not None}
    changes |= {f"stare.{course}": f"{course} of {', '.join(of)}" for course in COURSES if (of := getattr(s, course))}
    if s.pointing is not None:
        changes["stare.pointing"] = f"{s.pointing.label} (assumed)"
    return {
        "processes": {
            f"processes.{name}": name.replace("_", " ") for name, value in study.processes if value is not None
        },
        "nuisances": {f"nuisances.{name}": name for name in n.spreads()}
        | {f"nuisances.own.{name}": name for name in n.own},
        "stare": changes,
        "values": {"unknowns.draws": f"{draws} draws of the instrument's unknowns"} if draws else {},
    }


def _unknowns(study: Study, uses: Collection[Use]) -> str:
    """List the unknowns that an answer draws, marginalises over or averages over."""
    words = {use: [*of_key.values()] if use in uses else [] for use, of_key in _given_unknowns(study).items()}
    treatments = {"drawn": {"processes", "stare"}, "marginalised": {"nuisances", "stare"}}
    usual = " and ".join(treatment for treatment, of in treatments.items() if of & {*uses})
    clauses = [f"the usual unknowns {usual}"] if study.nuisances.usual else []
    known = [name for name in words["stare"] if name in KNOWN_CHANGES]
    drawn = words["processes"] + [change for change in words["stare"] if change not in known]
    clauses += [f"drawn: {', '.join(drawn)}"] if drawn else []
    clauses += [f"marginalised: {', '.join(words['nuisances'])}"] if words["nuisances"] else []
    text = "; ".join(clauses + words["values"]) or "everything known but the noise"
    return f"{text}; known changes of the stare: {', '.join(known)}" if known else text


def star_label(star: Star, x: Expectation) -> str:
    """Return a star's name and magnitude, for tables and plots."""
    name = star.library or x.name
    system = {"catalogue": "", "vega": " (Vega = 0)", "ab": " (AB)"}[star.magnitude_system]
    return name if star.magnitude is None else f"{name} {star.band} = {star.magnitude:g}{system}"


def place_columns(sweep: Sweep, *own: str) -> tuple[Column, ...]:
    """Return the columns of the star and of the swept quantities, for rows with the values `at` a cell of the sweep.

    `own` names quantities for which a table has separate columns.
    """
    return (star_column("label"), *(quantity_column(axis.quantity) for axis in sweep.axes if axis.quantity not in own))


def star_column(get: str = "star") -> Column:
    """Return the column of a star's label."""
    return Column("star", get, description=QUANTITIES["star"].description, heading="star", kind=str)


def quantity_column(name: str, get: str | Callable[[Any], Any] = "", description: str = "") -> Column:
    """Return the column of a quantity, by default of its value `at` a cell of the sweep."""
    quantity, cell = QUANTITIES[name], Column("at")
    get = get or (lambda row: cell.value(row)[name])
    return Column(name, get, quantity.unit, description or quantity.description, name, as_typed)


def amplitude_column(get: str | Callable[[Any], Any] = "amplitude", description: str = "") -> Column:
    """Return the column of a flare's amplitude, which people read in per cent."""
    return replace(quantity_column("amplitude", get, description), heading="flare", format=percent("g"))


def full_label(name: str, at: Mapping[str, float | str]) -> str:
    """Return a star's label with the swept values that the label does not contain, for plots."""
    values = (
        f"{key.replace('_', ' ')} {value:g}{QUANTITIES[key].suffix}"
        for key, value in at.items()
        if key not in ("magnitude", "star")
    )
    return ", ".join([name, *values])


#: Number of stars whose spectra a study's cases keep, since a sweep may have any number of them.
MAX_SOURCES = 16


class Loader:
    """Stars, instruments and skies that the cases of a study share; each is loaded once.

    `source` returns the spectrum of a star, by default that of the study's section.
    """

    def __init__(self, source: Callable[[Star], Source] | None = None) -> None:
        self._given = source
        self.source: Callable[[Star], Source] = lru_cache(MAX_SOURCES)(source or (lambda star: star.source()))
        self.sky: Callable[[SkyLight], Sky] = lru_cache(MAX_SOURCES)(lambda light: light.sky())
        self.near: Callable[[Star], Neighbours | None] = lru_cache(MAX_SOURCES)(lambda star: star.near())
        self._instruments: dict[str, Instrument] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle no caches, which are filled again."""
        return Loader, (self._given,)

    def instrument(self, observation: Observation) -> Instrument:
        """Return the instrument of an observation."""
        from mauvecl.host.instrument.instrument import Instrument

        file, loaded = observation.instrument, self._instruments
        key = repr((file, observation.temperature_c, sorted(observation.changes.items())))
        if key not in loaded:
            # A file is read once, since each draw of unknowns and each temperature of a sweep changes it.
            loaded[file] = loaded.get(file) or Instrument.load(file)
            loaded[key] = observation.changed(loaded[file])
        return loaded[key]


@dataclass(frozen=True, eq=False)
class Case:
    """One star at one combination of sweep values.

    Everything is loaded or computed when it is first used, and only once.

    Examples
    --------
    >>> from mauvecl import Study
    >>> from mauvecl.study.cases import cases
    >>> first, second = cases(Study())
    >>> first.label, round(first.quiet.exposure_s), len(first.flares)
    ('K3V V = 3.7', 50, 4)
    """

    study: Study  # with this star alone, at these values, without a sweep
    at: Mapping[str, float | str] = field(default_factory=dict)  # sweep values by quantity
    loader: Loader = field(default_factory=Loader, compare=False, repr=False)

    @property
    def star(self) -> Star:
        """The study's section of the star."""
        return self.study.star[0]

    @property
    def amplitudes(self) -> tuple[float, ...]:
        """Amplitudes of the flares."""
        return self.study.flare.amplitudes

    @cached_property
    def label(self) -> str:
        """Name and magnitude of the star, for tables and plots."""
        return star_label(self.star, self.quiet)

    @property
    def source(self) -> Source:
        """Spectrum of the star without a flare."""
        return self.loader.source(self.star)

    @property
    def neighbours(self) -> Neighbours | None:
        """Neighbours of the star, or None."""
        # They do not depend on the star's magnitude.
        return self.loader.near(self.star.model_copy(update={"magnitude": None}))

    @property
    def instrument(self) -> Instrument:
        """The instrument, with the study's changes and detector temperature."""
        return self.loader.instrument(self.study.observation)

    @cached_property
    def quiet(self) -> Expectation:
        """Expectation of the star without a flare."""
        return self.expect(self.source)[0]

    @cached_property
    def flares(self) -> list[Expectation]:
        """Expectations of the star with each of the study's flares."""
        return self.expect(*map(self.flaring, self.amplitudes))

    @property
    def expectations(self) -> list[Expectation]:
        """Expectations without a flare and with each flare."""
        return [self.quiet, *self.flares]

    @cached_property
    def processes(self) -> Processes:
        """Noise processes to draw: those given and, with the usual unknowns, those of the documented set."""
        processes = self.study.processes
        documented = default_processes(self.instrument.temperature_c) if self.study.nuisances.usual else {}
        missing = {name: prior for name, prior in documented.items() if getattr(processes, name) is None}
        return cast("Processes", processes.model_copy(update=missing))

    @property
    def draw_options(self) -> dict[str, Any]:
        """Arguments of the engine's methods: mode, recipe and processes."""
        o = self.study.observation
        return {"mode": o.mode, "recipe": o.recipe, "processes": self.processes}

    def flaring(self, amplitude: float, temperature_k: float | None = None) -> Source:
        """Return the star with a flare, by default of the study's temperature."""
        flare = self.study.flare
        return self.source.flaring(
            amplitude,
            spectrum=flare.light(temperature_k),
            band=flare.band,
            geometry=flare.geometry,
            photosphere_temperature=flare.photosphere_temperature_k,
        )

    def expect(self, *sources: Source) -> list[Expectation]:
        """Compute the expectations of sources for the instrument, sky and exposure."""
        from mauvecl.host.exposure.expectation import expect

        o, sky = self.study.observation, self.loader.sky(self.study.sky)
        options: dict[str, Any] = {"exposure": o.exposure_s, "order": o.order, "signal": o.signal}
        options |= {"sky": sky, "neighbours": self.neighbours}
        return [expect(source, self.instrument, **options) for source in sources]

    def unknowns(self, quiet: Expectation | None = None) -> Nuisances | None:
        """Return the nuisance parameters that statistics are marginalised over, or None.

        Their spectra are those of `quiet`, by default the star without a flare.
        """
        return self.study.nuisances.marginalised(self.quiet if quiet is None else quiet)

    def unknowns_of_fits(self, quiet: Expectation | None = None, stare: Stare | None = None) -> Nuisances | None:
        """Return the nuisance parameters of fits of flares, or None; `quiet` as for `unknowns`.

        The factor on all light has the mean and, unless the study states another, the standard deviation of what is
        drawn; those of a stare are of the stare. The documented set leaves the star's own level free as well.
        """
        from mauvecl.noise.scene import WEIGHTS, drawn_factors

        quiet = self.quiet if quiet is None else quiet
        unknown, light_sd = self.unknowns(quiet), self.study.nuisances.light
        if unknown is None or "light" not in unknown.names or light_sd == "free":
            return unknown
        if light_sd is None and "star" not in unknown.names:
            unknown = unknown.with_spectrum("star", quiet.net_source_dn, math.inf)
        light = drawn_factors(self.processes, quiet).get("light") if stare is None else None
        if light is None:
            return unknown.without(["light"]) if light_sd is None else unknown
        if light_sd is not None:
            return unknown.with_prior("light", light.mean - 1.0, light_sd)
        unknown = unknown.with_prior("light", light.mean - 1.0, light.sd)
        if light.normal:
            return unknown
        return replace(unknown, factor_prior=np.array([(light.values - light.mean) / light.sd, WEIGHTS]))

    def detect_options(self, quiet: Expectation | None = None) -> dict[str, Any]:
        """Return all arguments of `Engine.detect` except expectations and seed; `quiet` as for `unknowns`."""
        run = self.study.run
        options = {"realisations": run.realisations, "statistics": run.statistics, "tails": run.tails}
        return self.draw_options | options | {"nuisances": self.unknowns(quiet), "comparison": run.comparison()}

    def setting(self, quiet: Expectation, *flares: Expectation) -> Setting:
        """Return the input of statistics for closed forms."""
        from mauvecl.detection.statistics import Setting

        comparison = self.study.run.comparison()
        return Setting(quiet, ~quiet.saturated, comparison, flares, self.unknowns(quiet), self.processes)

    def with_value(self, quantity: str, value: float | str) -> Self:
        """Return the case at another value of a quantity of `questions.QUANTITIES`."""
        return replace(self, study=self.study.at(quantity, value))

    def with_sections(self, **sections: Any) -> Self:
        """Return the case with other sections of the study, such as ``flare``."""
        case = replace(self, study=self.study.model_copy(update=sections))
        if sections.keys() == {"nuisances"}:
            # No expectation depends on them.
            vars(case).update({name: vars(self)[name] for name in ("quiet", "flares") if name in vars(self)})
        return case

    def at_observed_brightness(self) -> Self:
        """Return the case with the amplitude at which the flare has the flux of its file at the telescope."""
        from mauvecl.host.stars.flare import added_light, check_scales

        flare, star, observed = self.study.flare, self.source, self.study.flare.light()
        check_scales(observed)
        geometry = flare.geometry, flare.photosphere_temperature_k
        light = added_light(star.wavelength_nm, star.flux_flam, observed, flare.band, *geometry)
        scaled = flare.spectrum.model_copy(update={"as_observed": False})
        return self.with_sections(flare=flare.model_copy(update={"amplitudes": (1.0 / light.hot,), "spectrum": scaled}))

    @cached_property
    def one_frame(self) -> Self:
        """The same case with an exposure of a single frame."""
        exposure = {"exposure_s": self.instrument.frame_s}
        return self.with_sections(observation=self.study.observation.model_copy(update=exposure))

    def flare_electrons(self, temperatures_k: NDArray[np.float64] | tuple[float, ...]) -> NDArray[np.float64]:
        """Return the electrons that flares of unit amplitude add to an exposure, shape (n_temperature, n_pixel)."""
        from mauvecl.host.stars.flare import check_scales

        check_scales(self.study.flare.light())
        # A flare that replaces photosphere is linear in its amplitude, but an amplitude of 1 may exceed the whole disc.
        unit = 1.0 if self.study.flare.geometry == "added" else 0.01
        flaring = self.expect(*(self.flaring(unit, float(k)) for k in temperatures_k))
        electrons = [(x.source_electrons - self.quiet.source_electrons) / unit for x in flaring]
        return np.reshape(electrons, (len(temperatures_k), self.quiet.wavelength_nm.size))

    @cached_property
    def stare(self) -> Stare:
        """The study's stare."""
        s = self.study
        return stare_of(s.stare, self.instrument, s.processes, orbit=s.orbit, plan=s.plan, usual=s.nuisances.usual)

    @cached_property
    def stare_expectation(self) -> StareExpectation:
        """Expectation of the stare at the star, with its flares."""
        from mauvecl.flares.frames import StareExpectation
        from mauvecl.flares.stare import check_contributions, coefficients, temperatures_of

        stare, events, frame = self.stare, self.events, self.one_frame
        check_contributions(events, stare.start_s, stare.frame_s)
        kelvin = temperatures_of(events)
        amplitudes = coefficients(events, stare.start_s, stare.frame_s, kelvin)
        return StareExpectation(frame.quiet, stare, frame.flare_electrons(kelvin), amplitudes)

    @cached_property
    def events(self) -> list[Event]:
        """Flares in the stare: the study's, or one per energy or amplitude, evenly spaced."""
        from mauvecl.flares.stare import temperatures_of

        choices, q, flare = self.study.events, self.study.stare, self.study.flare
        if not choices:
            sizes = [{"energy_erg": e} for e in q.energies_erg] or [{"amplitude": a} for a in flare.amplitudes]
            # The time before the first flare equals the spacing.
            step = q.duration_s / (len(sizes) + 1)
            choices = tuple(EventChoice(peak_s=step * (n + 1), **size) for n, size in enumerate(sizes))
        events = [choice.event(flare, q) for choice in choices]
        # The spectrum of a cooling flare is interpolated between the temperatures of all flares.
        kelvin = temperatures_of(events)
        for n, (choice, event) in enumerate(zip(choices, events, strict=True)):
            if choice.energy_erg is not None:
                energy = self.energy(event, choice.energy, kelvin)
                if math.isnan(energy):
                    fault = f"the amplitude of a flare of {choice.energy_erg:g} erg on {self.source.name} needs the"
                    needed = "star's distance_pc, or radius_rsun and effective_temperature_k"
                    raise InputError(f"{fault} {needed}", key="events.energy_erg")
                # The energy is linear in the amplitude.
                events[n] = replace(event, amplitude=choice.energy_erg / energy)
        return events

    def energy_scale(self, kind: Kind, temperature_k: float | None = None) -> EnergyScale | None:
        """Return the energy of flares per second of equivalent duration, by default at the study's temperature.

        It follows from the star's distance or else from its radius and temperature; None if neither is known.
        """
        from mauvecl.flares.energies import EnergyScale

        star, flare = self.star, self.study.flare
        options: dict[str, Any] = {
            "band": flare.band, "flare": flare.light(temperature_k), "kind": kind, "geometry": flare.geometry,
            "photosphere_k": flare.photosphere_temperature_k,
        }  # fmt: skip
        if star.distance_pc is not None:
            return EnergyScale.of_star(self.source, star.distance_pc, **options)
        if star.radius_rsun is not None and star.effective_temperature_k is not None:
            return EnergyScale.of_blackbody(star.radius_rsun, star.effective_temperature_k, **options)
        return None

    def energy(self, event: Event, kind: Kind, temperatures_k: NDArray[np.float64] | None = None) -> float:
        """Return the energy of a flare, erg, as `Event.total_energy`; NaN if the star's size is unknown."""
        scale_of = partial(self.energy_scale, kind)
        if scale_of(event.hottest_k) is None:
            return float("nan")
        return event.total_energy(cast("Callable[[float], EnergyScale]", scale_of), temperatures_k)


def cases(study: Study, *, swept: bool = True) -> list[Case]:
    """Return the cases of a study: every star at every combination of sweep values, or at the study's own values."""
    loader = Loader()
    all_cases = []
    for values in study.sweep.cells() if swept else ({},):
        cell = study.model_copy(update={"sweep": Sweep()})
        for quantity, value in values.items():
            cell = cell.at(quantity, value)
        stars = [Case(cell.model_copy(update={"star": (star,)}), values, loader) for star in cell.star]
        all_cases += [case.at_observed_brightness() for case in stars] if cell.flare.spectrum.as_observed else stars
    return all_cases


#: Read noise, DN, above which rounding acts like independent noise at any signal: it damps the first harmonic of the
#: rounding error to exp(-2 pi^2) = 3e-9.
NOISY_DN = 1.0
#: Tolerance for the rounding of a prior's limits.
TINY = 1e-9
#: Kind of messages on saturation, and their largest number in an answer.
SATURATED = "saturated"
MAX_SATURATED = 12


def collect_messages(expectations: list[Expectation], processes: Processes | None = None) -> list[str]:
    """Return the messages of expectations and on the validity of closed forms, in the order of `worst_first`."""
    saturated = {star for x in expectations if x.saturated.any() for star, flaring in [_star_of(x)] if not flaring}
    outside = off_centre(expectations, processes) if processes else []
    messages: list[str] = [Message(f"OUTSIDE THE PRIOR: {text}.", "outside the prior") for text in outside]
    for x in expectations:
        star, flaring = _star_of(x)
        pixels, electrons = x.wavelength_nm.size, float(np.sum(x.source_electrons)) * x.n_frames
        if electrons < 1.0:
            text = (
                f"NO LIGHT: {x.name} gives {electrons:.2g} electrons in all {pixels} pixels of an exposure of "
                f"{x.exposure_s:g} s: there is nothing to see of it, and its S/N is 0."
            )
            messages.append(Message(text, "no light"))
        # A flare saturates the pixels that its star saturates without it, which is one fact.
        reported = of_kind(x.messages, SATURATED) if flaring and star in saturated else []
        messages += [message for message in x.messages if message not in reported]
        quiet = float(np.min(x.read_noise_dn)) < NOISY_DN
        if quiet and (coarse := int(np.count_nonzero(~stack_is_exact(Cumulants.of(x, 1), x)))):
            text = (
                f"In {coarse} of {pixels} pixels of {x.name} a frame has too little noise for its rounding to whole DN "
                "to be like noise: closed forms treat it as noise and are wrong there; simulations round each frame."
            )
            messages.append(Message(text, "rounding"))
    return worst_first(messages)


def _star_of(x: Expectation) -> tuple[tuple[object, ...], bool]:
    """Return a key of an expectation's star and exposure, the same with and without a flare, and whether it has one."""
    steps = [step for step in x.provenance.get("source history", "").split("; ") if step]
    quiet = tuple(step for step in steps if not step.startswith("flare"))
    return (x.name, quiet, x.frame_s, x.n_frames), len(quiet) < len(steps)


def off_centre(expectations: list[Expectation], processes: Processes) -> list[str]:
    """Return a clause for each prior that excludes the value of an expectation."""
    clauses = []
    for name, _ in processes.modulations:
        first, last = getattr(processes, name).quantile(np.array([0.0, 1.0]))
        expected = PROCESSES[name].expected
        values = {x.conditions[expected] if isinstance(expected, str) else expected for x in expectations}
        outside = sorted(value for value in values if not first - TINY <= value <= last + TINY)
        if outside:
            clauses.append(
                f"{name} is drawn from {first:g} to {last:g}, and the expectation, which is "
                f"subtracted, has {', '.join(f'{value:g}' for value in outside)}: every exposure differs from it, and "
                "thresholds hold that difference"
            )
    return clauses


def worst_first(messages: Iterable[str]) -> list[str]:
    """Remove duplicates, put messages on saturation first, and summarise these beyond `MAX_SATURATED`."""
    messages = dict.fromkeys(messages)
    saturated = of_kind(messages, SATURATED)
    n_more = len(saturated) - MAX_SATURATED
    more = f"SATURATED: pixels of {n_more} more stars, flares or exposures of this answer saturate."
    summary = [Message(more, SATURATED)] if n_more > 0 else []
    return [*saturated[:MAX_SATURATED], *summary, *(text for text in messages if text not in saturated)]
