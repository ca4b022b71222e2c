"""Study sections of stares and of searches for flares in them, and the frames and flares of a stare at a star."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mauvecl import flares
from mauvecl.flares import HALF_WIDTHS_S, SHAPE_NAMES, WINDOW_S, Cooling, CoolingLaw, Curve, Per, ShapeName
from mauvecl.noise.disturbances import Normal, PointingDrifts, Prior
from mauvecl.noise.unknowns import CHANGING, COURSES, DEFAULT_SPREADS, PROCESSES, Changing, Course, NuisanceName
from mauvecl.schema import fields
from mauvecl.schema.errors import InputError, Message, counted, shortened
from mauvecl.schema.fields import DAY_S, Flag, Help, Range, Unit
from mauvecl.schema.section import Section, check_one, read_ranges, setting
from mauvecl.study.observation import Spread, sd_of

if TYPE_CHECKING:
    from mauvecl.flares.stare import Event, Stare
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.noise.unknowns import Processes
    from mauvecl.search.search import Bank, Baseline
    from mauvecl.study.plan import OrbitQuestion, PlanQuestion
    from mauvecl.study.star import Flare

#: Orbital period rounded down to a multiple of the frame time, s.
ORBIT_FRAMES_S = 5680.0

#: Known changes during a stare.
KNOWN_CHANGES = ("thermal", "variability", "throughput", "sky")
Spreads = dict[Changing, fields.Positive]


class StareQuestion(Section):
    """Duration and gaps of a stare, known and unknown changes during it, and its flares unless `events` are given."""

    duration_s: fields.Duration = setting(ORBIT_FRAMES_S, "Duration of the stare", flag="--duration")
    gaps: Annotated[tuple[tuple[float, float], ...], Unit("s")] = setting(
        (),
        "Gap without recorded frames, from:to; as in 1000:2000",
        flag=Flag(
            "--gap", kind=list[str], read=partial(read_ranges, expected="two times in s, such as 1000:2000", unit="s")
        ),
    )
    orbit_s: fields.Duration = setting(flares.ORBIT_S, "Orbital period")
    orbit_gap_s: Annotated[float, Unit("s"), Range(0)] = setting(
        0.0, "Gap at the end of every orbit", flag="--orbit-gap"
    )
    along_orbit: bool = setting(False, "Whether gaps and detector temperature follow the orbit of the section orbit")
    thermal: Curve | None = setting(
        None,
        "Known change of the detector temperature, deg C",
        flag=Flag(
            "--thermal",
            kind=float,
            read=lambda half, _: {"amplitude": half},
            help=Help("Half the range of the known thermal cycle of the orbit, deg C", default="0"),
        ),
    )
    variability: Curve | None = setting(None, "Known relative change of the star's light")
    throughput: Curve | None = setting(None, "Known relative change of the throughput")
    sky: Curve | None = setting(None, "Known relative change of the sky")
    jitters: Spreads = setting(dict, "Standard deviations of unknown changes that differ in each frame")
    offsets: Spreads = setting(dict, "Standard deviations of unknown constant changes")
    drifts: Spreads = setting(dict, "Standard deviations of unknown drifts per hour")
    cycles: Spreads = setting(dict, "Standard deviations of unknown cycles of the orbit")
    pointing: PointingDrifts | None = setting(
        None,
        "Drifts out of the fibre, each ended by a re-acquisition, all of it assumed",
        flag=Flag(
            "--pointing-drifts",
            kind=float,
            read=lambda rate, _: {"rate_per_h": rate},
            help=Help("Drifts out of the fibre per hour, with assumed depth and duration", default="none"),
        ),
    )
    number: Annotated[int, Range(0, 2**32 - 1)] = setting(0, "Number of the drawn stare")
    half_width_s: fields.Duration = setting(60.0, "Half-width of the flares", flag="--half-width")
    shape: ShapeName = setting("davenport2014", "Shape of flares", flag="--shape", choices=SHAPE_NAMES)
    energies_erg: tuple[fields.Energy, ...] = setting(
        (), "Bolometric energy of a flare; instead of amplitudes", flag="--energy"
    )
    search: bool = setting(True, "Search the stare for flares, as the section search says", flag="--search/--no-search")
    bands_nm: tuple[tuple[fields.Wavelength, fields.Wavelength], ...] = setting(
        ((200.0, 300.0), (300.0, 400.0), (400.0, 550.0), (550.0, 700.0)), "Wavelength ranges of light curves"
    )

    def _check_values(self) -> None:
        if self.orbit_gap_s >= self.orbit_s:
            expected = f"shorter than the orbit of {self.orbit_s:g} s"
            raise InputError.of("stare.orbit_gap_s", self.orbit_gap_s, expected, unit="s")
        for low, high in self.bands_nm:
            if not 0 < low < high:
                raise InputError.of("stare.bands_nm", (low, high), "ascending wavelengths", unit="nm")
        for start, end in self.gaps:
            if not start < end:
                raise InputError.of("stare.gaps", (start, end), "two times, ascending", unit="s")


#: Keys of the size of an event.
SIZES = ("amplitude", "peak", "equivalent_duration_s", "energy_erg")


class EventChoice(Section):
    """A flare of a study, with one of several measures of size; other values are the study's by default.

    At most one of `amplitude`, `peak`, `equivalent_duration_s` and `energy_erg` is given. An energy needs the star's
    size: see `Case.events`.
    """

    peak_s: Annotated[float, Unit("s"), Help("Time of the peak after the start of the stare")]
    half_width_s: fields.Duration | None = setting(None, "Half-width of the shape", usual="the stare's")
    amplitude: fields.Amplitude | None = setting(None, "Amplitude of the shape", usual="the flare's")
    peak: fields.Amplitude | None = setting(None, "Maximum of the shape, instead of its amplitude")
    equivalent_duration_s: fields.Duration | None = setting(None, "Equivalent duration, instead of an amplitude")
    energy_erg: fields.Energy | None = setting(None, "Energy, instead of an amplitude")
    energy: Literal["bolometric", "band"] = setting("bolometric", "Meaning of the energy")
    temperature_k: fields.Temperature | None = setting(None, "Temperature", usual="the flare's")
    cooling: CoolingLaw | None = setting(None, "Exponential cooling from that temperature")
    shape: ShapeName | None = setting(None, "Shape", usual="the stare's", choices=SHAPE_NAMES)
    shape_file: Path | None = setting(None, "File of a shape with two columns, time in half-widths and value")

    def _check_values(self) -> None:
        check_one(self, "an event", *SIZES)
        check_one(self, "an event", "shape", "shape_file")

    def event(self, flare: Flare, stare: StareQuestion) -> Event:
        """Return the flare, with amplitude 1 if its energy is given."""
        from mauvecl.flares.shapes import TableShape, shape_of
        from mauvecl.flares.stare import Event
        from mauvecl.host.tables.text_tables import read_columns

        file, cooling = self.shape_file, self.cooling
        shape = shape_of(self.shape or stare.shape)
        if file is not None:
            columns = read_columns("flare shape", "values", file)
            shape = TableShape(columns[:, 0], columns[:, 1], file.stem, shortened(file.name))
        if cooling is not None and flare.spectrum.file is not None:
            fault = "events.cooling needs a flare that has a temperature, but its spectrum is from a file"
            raise InputError(fault, key="events.cooling")
        kelvin = flare.temperature_k if self.temperature_k is None else self.temperature_k
        arguments: dict[str, Any] = {
            "peak_s": self.peak_s,
            "half_width_s": stare.half_width_s if self.half_width_s is None else self.half_width_s,
            "temperature": kelvin if cooling is None else Cooling(kelvin, cooling.end_k, cooling.fold_s),
            "shape": shape,
        }
        if self.peak is not None:
            return Event.of_peak(self.peak, **arguments)
        if self.equivalent_duration_s is not None:
            return Event.of_equivalent_duration(self.equivalent_duration_s, **arguments)
        amplitude = flare.amplitudes[0] if self.energy_erg is None else 1.0
        return Event(amplitude=amplitude if self.amplitude is None else self.amplitude, **arguments)


#: Window, in orbits, of a baseline with the orbital cycle. Shorter ones cannot separate the cycle from a flare.
CYCLE_ORBITS = 3.0


class SearchChoice(Section):
    """Search of a stare for flares, and its rate of false alarms."""

    shape: ShapeName = setting("davenport2014", "Shape of flares", flag="--shape", choices=SHAPE_NAMES)
    half_widths_s: tuple[fields.Duration, ...] = setting(
        HALF_WIDTHS_S, "Half-widths of the template bank", min_length=1
    )
    sums: Annotated[int, Range(1, 8)] = setting(flares.RANK, "Largest number of weighted sums per frame")
    offset: bool = setting(True, "Whether to marginalise over the offset of the baseline")
    slope: bool = setting(True, "Whether to marginalise over the slope of the baseline")
    cycle: bool | None = setting(
        None, "Whether to marginalise over the orbital cycle", usual="if the stare has an unknown cycle"
    )
    window_s: Annotated[float, Unit("s"), Range(0)] | None = setting(
        None, "Window of the baseline", usual="1800, or three orbits with a cycle"
    )
    frame: dict[NuisanceName, Spread] = setting(
        dict, "Standard deviations of nuisance parameters of each frame, in addition to the stare's jitters"
    )
    false_alarms: fields.Positive = setting(
        1.0,
        "False alarms of the search per star-day, star-month or star-year",
        flag="--false-alarms",
        hint="Expected number of detections that are only noise, in the time that the next field states.",
    )
    per: Per = setting(
        "month",
        "Star-time of frames for the false alarms",
        flag="--alarms-per",
        label="False alarms per",
        hint="Observing time of one star to which the number of false alarms refers.",
    )
    null: Literal["sampled", "counted"] = setting(
        "sampled", "Threshold from importance sampling of normal noise, or counted in simulated stares"
    )
    nulls: Annotated[int, Range(0, 1_000_000)] = setting(100, "Simulated stares without a flare")
    points: Annotated[int, Range(1, 100)] = setting(3, "Consecutive frames of the conventional rule, for comparison")
    sigma: fields.Positive = setting(3.0, "Threshold of the conventional rule, in standard deviations")

    def _check_values(self) -> None:
        if list(self.half_widths_s) != sorted(set(self.half_widths_s)):
            raise InputError.of("search.half_widths_s", list(self.half_widths_s), "ascending times")
        if self.slope and not self.offset:
            raise InputError("search.slope needs search.offset = true as well", key="slope")

    @property
    def rate(self) -> float:
        """False alarms per star-day."""
        return self.false_alarms / flares.DAYS[self.per]

    @property
    def rate_text(self) -> str:
        """The false alarms as text, such as "1 false alarm per star-month"."""
        return f"{counted(self.false_alarms, 'false alarm', spec='g')} per star-{self.per}"

    def white_bank(self, frame_s: float) -> Bank:
        """Return the template bank of the closed form: one sum per frame and no cycle."""
        from mauvecl.flares.shapes import shape_of
        from mauvecl.search.search import Baseline, white_bank

        baseline = Baseline(self.offset, self.slope, False, WINDOW_S if self.window_s is None else self.window_s)
        return white_bank(self.half_widths_s, shape_of(self.shape), frame_s, baseline)

    def baseline(self, stare: Stare, orbit_s: float) -> Baseline:
        """Return the baseline of flares in a stare; a cycle is in it by default if the stare has an unknown one."""
        from mauvecl.search.search import Baseline

        cycle = self.cycle if self.cycle is not None else any("cosine" in u.name for u in stare.unknowns)
        window = self.window_s if self.window_s is not None else CYCLE_ORBITS * orbit_s if cycle else WINDOW_S
        return Baseline(self.offset, self.slope, cycle, window)

    def spreads(self) -> dict[str, float]:
        """Return the standard deviations of the parameters of `frame`; infinite for "free"."""
        return {name: sd_of(sd) for name, sd in self.frame.items()}


#: Measures of the size of injected flares.
Size = Literal["amplitude", "duration", "energy", "band_energy"]


class InjectionQuestion(Section):
    """Grid of sizes and half-widths of injected flares, which have the study's flare temperature and band."""

    of: Size | None = setting(
        None,
        "Measure of the size of injected flares; durations in s, energies in erg",
        flag="--size",
        usual="energy if the star's size is known, else amplitude",
    )
    low: fields.Positive | None = setting(None, "Smallest size", flag="--smallest", usual="0.3 of what is found")
    high: fields.Positive | None = setting(None, "Largest size", flag="--largest", usual="3 times what is found")
    sizes: Annotated[int, Range(2, 256)] = setting(16, "Number of sizes, evenly spaced in the logarithm")
    widths: Annotated[int, Range(1, 256)] = setting(16, "Number of half-widths, evenly spaced in the logarithm")
    half_width_low_s: fields.Duration = setting(10.0, "Smallest half-width")
    half_width_high_s: fields.Duration = setting(1800.0, "Largest half-width")
    count: Annotated[int, Range(10, 10**8)] = setting(
        2_000, "Injections of each size and half-width", flag="--injections -n"
    )
    positions: Annotated[int, Range(2, 100_000)] = setting(40, "Peak times in the stare")
    fitted: Annotated[int, Range(0, 100_000)] = setting(
        40, "Injections of each size and half-width that are fitted if they are detected"
    )

    def _check_values(self) -> None:
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise InputError.of("injections.low", self.low, f"below high = {self.high:g}")
        if self.half_width_low_s > self.half_width_high_s:
            expected = f"below half_width_high_s = {self.half_width_high_s:g}"
            raise InputError.of("injections.half_width_low_s", self.half_width_low_s, expected)

    @property
    def half_widths_s(self) -> tuple[float, ...]:
        """Half-widths of injected flares, evenly spaced in the logarithm."""
        import numpy as np

        return tuple(float(w) for w in np.geomspace(self.half_width_low_s, self.half_width_high_s, self.widths))


#: Smallest distance of a prior's cuts from its mean, in standard deviations, for a normal distribution to replace it:
#: 6e-7 of the values lie beyond.
NEGLIGIBLE_CUT_SD = 5.0


def _stare_prior(name: str, prior: Prior, instrument: Instrument) -> tuple[Course, Changing, float, float]:
    """Return the course of a process of exposures in a stare, what it changes, and its standard deviation and mean.

    The stare's quiescent level is measured in the stare itself, so the mean is a known factor on light or sky, or shift
    of the temperature in deg C; the standard deviation is relative to it, or in deg C.
    """
    import numpy as np

    if not isinstance(prior, Normal) or not prior.is_wide(NEGLIGIBLE_CUT_SD):
        prior_of_stare = f"a normal prior whose cuts are {NEGLIGIBLE_CUT_SD:g} sd or more from its mean"
        remedy = f"give {prior_of_stare}, or jitters, offsets, drifts or cycles in [stare]"
        fault = f"processes.{name} is drawn from a normal distribution in a stare"
        raise InputError(f"{fault}; {remedy}", key=f"processes.{name}")
    process = PROCESSES[name]
    course: Course = "jitters" if process.when == "frame" else "offsets"
    if process.of == "dark":
        return course, "temperature", prior.sd, prior.mean - instrument.temperature_c
    at = {"light_loss": instrument.light_loss, "pointing_loss": instrument.pointing_loss}
    # The factors on light and sky are linear in their values.
    mean, upper = (1.0 + float(process.change(at, np.array(x))) for x in (prior.mean, prior.mean + prior.sd))
    return course, process.of, abs(upper - mean) / mean, mean


def stare_of(
    question: StareQuestion,
    instrument: Instrument,
    processes: Processes,
    *,
    orbit: OrbitQuestion,
    plan: PlanQuestion,
    usual: bool,
) -> Stare:
    """Return the stare of a study's sections; `usual` adds the documented set of unknowns."""
    from mauvecl.flares.stare import Stare

    priors = [_stare_prior(name, getattr(processes, name), instrument) for name, _ in processes.modulations]
    spreads: dict[Course, dict[Changing, float]] = {course: dict(getattr(question, course)) for course in COURSES}
    for course, changing, sd, _ in priors:
        # Independent normal amplitudes of the same change add in quadrature.
        spreads[course][changing] = math.hypot(spreads[course].get(changing, 0.0), sd)
    spreads = {course: {name: sds[name] for name in CHANGING if name in sds} for course, sds in spreads.items()}
    if usual:
        spreads = {course: documented | spreads[course] for course, documented in DEFAULT_SPREADS.items()}

    names = (*KNOWN_CHANGES, "pointing", "orbit_s")
    changes: dict[str, Any] = {name: getattr(question, name) for name in names} | spreads
    changes["frame_s"] = instrument.frame_s
    if question.along_orbit:
        stare = _along_orbit(question, orbit, plan, changes)
    else:
        n_orbits = math.ceil(question.duration_s / question.orbit_s) if question.orbit_gap_s else 0
        ends = [(n + 1) * question.orbit_s for n in range(n_orbits)]
        gaps = [*question.gaps, *((end - question.orbit_gap_s, end) for end in ends)]
        stare = Stare.of(question.duration_s, temperature_c=instrument.temperature_c, gaps=gaps, **changes)
    for _, changing, _, mean in priors:
        name = "temperature_c" if changing == "temperature" else changing
        value: Any = getattr(stare, name)
        stare = replace(stare, **{name: value + mean if changing == "temperature" else value * mean})
    return stare


def _along_orbit(question: StareQuestion, orbit: OrbitQuestion, plan: PlanQuestion, changes: dict[str, Any]) -> Stare:
    """Return the stare at the target of the study's ``orbit``, with gaps and temperatures along the orbit."""
    from mauvecl.flares.stare import stare_along
    from mauvecl.study.plan import targets_of

    if question.gaps or question.orbit_gap_s or question.thermal is not None:
        fault = "stare.along_orbit needs neither gaps nor a thermal curve, since both follow from the orbit"
        raise InputError(fault, key="stare.along_orbit")
    targets, duration_s = targets_of(orbit, plan), question.duration_s
    if len(targets) != 1:
        fault = f"stare.along_orbit needs a single target in orbit.targets, but has {len(targets)}"
        raise InputError(fault, key="stare.along_orbit")
    return stare_along(orbit.orbit(), targets[0], orbit.start, duration_s, limits=orbit.limits, **changes).stare


def orbit_lines(question: StareQuestion, orbit: OrbitQuestion, frame_s: float) -> list[str]:
    """Return messages about the orbit of a stare with `along_orbit`."""
    from mauvecl.host.orbit.orbit import TimeGrid

    if not question.along_orbit:
        return []
    times = TimeGrid(orbit.start, question.duration_s / DAY_S, frame_s)
    assumed = "Limits, temperatures and windows of a stare along the orbit are assumptions"
    return [*orbit.orbit().messages(times), f"{assumed}; stray light is not modelled."]


def threshold_line(title: str, threshold: float) -> str:
    """Return the message for a threshold that is raised because of trends that the search does not remove."""
    return Message(
        f"FALSE ALARMS of {title} come from what is unknown of the stare, too: the search does not marginalise over "
        "all of it (see search.cycle, slope, offset and window_s). The threshold of "
        f"{threshold:.2f} allows for it, so that alarms are as often as asked for to a factor of 1.5.",
        "false alarms",
    )
