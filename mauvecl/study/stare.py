"""Study sections of stares and of searches for flares in them."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from mauvecl.flares.settings import (
    DAYS,
    HALF_WIDTHS_S,
    ORBIT_S,
    RANK,
    SHAPE_NAMES,
    WINDOW_S,
    CoolingLaw,
    Curve,
    Per,
    ShapeName,
)
from mauvecl.noise.disturbances import PointingDrifts
from mauvecl.noise.unknowns import Changing, NuisanceName
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, Help, Range, Unit, Widget
from mauvecl.schema.physical import Amplitude, Duration, Energy, Positive, Temperature, Wavelength
from mauvecl.schema.section import Section, check_one, given_keys, read_ranges
from mauvecl.study.observation import Spread, sd_of

if TYPE_CHECKING:
    from mauvecl.flares.stare import Stare
    from mauvecl.search.templates import Bank, Baseline

#: Orbital period rounded down to a multiple of the frame time, s.
ORBIT_FRAMES_S = 5680.0

#: Known changes during a stare.
KNOWN_CHANGES = ("thermal", "variability", "throughput", "sky")
Spreads = dict[Changing, Positive]
#: Shape of flares in stares and searches.
ShapeOfFlares = Annotated[ShapeName, Help("Shape of flares", choices=", ".join(SHAPE_NAMES)), Flag("--shape")]


class StareQuestion(Section):
    """Duration and gaps of a stare, known and unknown changes during it, and its flares unless `events` are given."""

    duration_s: Annotated[Duration, Help("Duration of the stare"), Flag("--duration")] = ORBIT_FRAMES_S
    gaps: Annotated[
        tuple[tuple[float, float], ...],
        Unit("s"),
        Help("Gap without recorded frames, from:to", "as in 1000:2000"),
        Flag(
            "--gap", kind=list[str], read=partial(read_ranges, expected="two times in s, such as 1000:2000", unit="s")
        ),
    ] = ()
    orbit_s: Annotated[Duration, Help("Orbital period")] = ORBIT_S
    orbit_gap_s: Annotated[float, Unit("s"), Range(0), Help("Gap at the end of every orbit"), Flag("--orbit-gap")] = 0.0
    along_orbit: Annotated[bool, Help("Whether detector temperature and sky follow the orbit of the section orbit")] = (
        False
    )
    thermal: Annotated[
        Curve | None,
        Help("Known change of the detector temperature, deg C"),
        Flag(
            "--thermal",
            kind=float,
            read=lambda half, _: {"amplitude": half},
            help=Help("Half the range of the known thermal cycle of the orbit, deg C", default="0"),
        ),
    ] = None
    variability: Annotated[Curve | None, Help("Known relative change of the star's light")] = None
    throughput: Annotated[Curve | None, Help("Known relative change of the throughput")] = None
    sky: Annotated[Curve | None, Help("Known relative change of the sky")] = None
    jitters: Annotated[Spreads, Help("Standard deviations of unknown changes that differ in each frame")] = Field(
        default_factory=dict
    )
    offsets: Annotated[Spreads, Help("Standard deviations of unknown constant changes")] = Field(default_factory=dict)
    drifts: Annotated[Spreads, Help("Standard deviations of unknown drifts per hour")] = Field(default_factory=dict)
    cycles: Annotated[Spreads, Help("Standard deviations of unknown cycles of the orbit")] = Field(default_factory=dict)
    pointing: Annotated[
        PointingDrifts | None,
        Help("Drifts out of the fibre, each ended by a re-acquisition, all of it assumed"),
        Flag(
            "--pointing-drifts",
            kind=float,
            read=lambda rate, _: {"rate_per_h": rate},
            help=Help("Drifts out of the fibre per hour, with assumed depth and duration", default="none"),
        ),
    ] = None
    number: Annotated[int, Range(0, 2**32 - 1), Help("Number of the drawn stare")] = 0
    half_width_s: Annotated[Duration, Help("Half-width of the flares"), Flag("--half-width")] = 60.0
    shape: ShapeOfFlares = "davenport2014"
    energies_erg: Annotated[
        tuple[Energy, ...], Help("Bolometric energy of a flare", "instead of amplitudes"), Flag("--energy")
    ] = ()
    search: Annotated[
        bool, Help("Search the stare for flares, as the section search says"), Flag("--search/--no-search")
    ] = True
    bands_nm: Annotated[tuple[tuple[Wavelength, Wavelength], ...], Help("Wavelength ranges of light curves")] = (
        (200.0, 300.0),
        (300.0, 400.0),
        (400.0, 550.0),
        (550.0, 700.0),
    )

    def _check_values(self) -> None:
        if self.orbit_gap_s >= self.orbit_s:
            expected = f"shorter than the orbit of {self.orbit_s:g} s"
            raise InputError.of("stare.orbit_gap_s", self.orbit_gap_s, expected, unit="s")
        for low, high in self.bands_nm:
            if not 0 < low < high:
                raise InputError.of("stare.bands_nm", (low, high), "ascending wavelengths", unit="nm")


#: Keys of the size of an event.
SIZES = ("amplitude", "peak", "equivalent_duration_s", "energy_erg")


class EventChoice(Section):
    """A flare of a study, with one of several measures of size; other values are the study's by default.

    At most one of `amplitude`, `peak`, `equivalent_duration_s` and `energy_erg` is given. The flare that follows, an
    `Event`, depends on the case: an energy needs the star's size, and sweeps change the study's values.
    """

    peak_s: Annotated[float, Unit("s"), Help("Time of the peak after the start of the stare")]
    half_width_s: Annotated[Duration | None, Help("Half-width of the shape", default="the stare's")] = None
    amplitude: Annotated[Amplitude | None, Help("Amplitude of the shape", default="the flare's")] = None
    peak: Annotated[Amplitude | None, Help("Maximum of the shape, instead of its amplitude")] = None
    equivalent_duration_s: Annotated[Duration | None, Help("Equivalent duration, instead of an amplitude")] = None
    energy_erg: Annotated[Energy | None, Help("Energy, instead of an amplitude")] = None
    energy: Annotated[Literal["bolometric", "band"], Help("Meaning of the energy")] = "bolometric"
    temperature_k: Annotated[Temperature | None, Help("Temperature", default="the flare's")] = None
    cooling: Annotated[CoolingLaw | None, Help("Exponential cooling from that temperature")] = None
    shape: Annotated[ShapeName | None, Help("Shape", default="the stare's", choices=", ".join(SHAPE_NAMES))] = None
    shape_file: Annotated[Path | None, Help("File of a shape with two columns, time in half-widths and value")] = None

    def _check_values(self) -> None:
        check_one(self, "an event", *SIZES)
        check_one(self, "an event", "shape", "shape_file")

    @property
    def sizes(self) -> list[str]:
        """Keys of the given sizes, at most one."""
        return given_keys(self, SIZES)


#: Window, in orbits, of a baseline with the orbital cycle. Shorter ones cannot separate the cycle from a flare.
CYCLE_ORBITS = 3.0


class SearchChoice(Section):
    """Search of a stare for flares, and its rate of false alarms."""

    shape: ShapeOfFlares = "davenport2014"
    half_widths_s: Annotated[tuple[Duration, ...], Field(min_length=1), Help("Half-widths of the template bank")] = (
        HALF_WIDTHS_S
    )
    sums: Annotated[int, Range(1, 8), Help("Largest number of weighted sums per frame")] = RANK
    offset: Annotated[bool, Help("Whether to marginalise over the offset of the baseline")] = True
    slope: Annotated[bool, Help("Whether to marginalise over the slope of the baseline")] = True
    cycle: Annotated[
        bool | None, Help("Whether to marginalise over the orbital cycle", default="if the stare has an unknown cycle")
    ] = None
    window_s: Annotated[
        Annotated[float, Unit("s"), Range(0)] | None,
        Help("Window of the baseline", default="1800, or three orbits with a cycle"),
    ] = None
    frame: Annotated[
        dict[NuisanceName, Spread],
        Help("Standard deviations of nuisance parameters of each frame, in addition to the stare's jitters"),
    ] = Field(default_factory=dict)
    false_alarms: Annotated[
        Positive,
        Help("False alarms of the search per star-day, star-month or star-year"),
        Flag("--false-alarms"),
        Widget(
            "False alarms", "Expected number of detections that are only noise, in the time that the next field states."
        ),
    ] = 1.0
    per: Annotated[
        Per,
        Help("Star-time of frames for the false alarms"),
        Flag("--alarms-per"),
        Widget("False alarms per", "Observing time of one star to which the number of false alarms refers."),
    ] = "month"
    null: Annotated[
        Literal["sampled", "counted"],
        Help("Threshold from importance sampling of normal noise, or counted in simulated stares"),
    ] = "sampled"
    nulls: Annotated[int, Range(0, 1_000_000), Help("Simulated stares without a flare")] = 100
    points: Annotated[int, Range(1, 100), Help("Consecutive frames of the conventional rule, for comparison")] = 3
    sigma: Annotated[Positive, Help("Threshold of the conventional rule, in standard deviations")] = 3.0

    def _check_values(self) -> None:
        if list(self.half_widths_s) != sorted(set(self.half_widths_s)):
            raise InputError.of("search.half_widths_s", list(self.half_widths_s), "ascending times")
        if self.slope and not self.offset:
            raise InputError("search.slope needs search.offset = true as well", key="slope")

    @property
    def rate(self) -> float:
        """False alarms per star-day."""
        return self.false_alarms / DAYS[self.per]

    @property
    def rate_text(self) -> str:
        """The false alarms as text, such as "1 false alarm per star-month"."""
        return f"{self.false_alarms:g} false alarm{'' if self.false_alarms == 1 else 's'} per star-{self.per}"

    def white_bank(self, frame_s: float) -> Bank:
        """Return the template bank of the closed form: one sum per frame and no cycle."""
        from mauvecl.flares.shapes import shape_of
        from mauvecl.search.templates import Baseline, white_bank

        level = Baseline(self.offset, self.slope, False, WINDOW_S if self.window_s is None else self.window_s)
        return white_bank(self.half_widths_s, shape_of(self.shape), frame_s, level)

    def level(self, stare: Stare, orbit_s: float) -> Baseline:
        """Return the baseline model for a stare."""
        from mauvecl.search.templates import Baseline

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

    of: Annotated[
        Size | None,
        Help(
            "Measure of the size of injected flares",
            "durations in s, energies in erg",
            default="energy if the star's size is known, else amplitude",
        ),
        Flag("--size"),
    ] = None
    low: Annotated[Positive | None, Help("Smallest size", default="0.3 of what is found"), Flag("--smallest")] = None
    high: Annotated[Positive | None, Help("Largest size", default="3 times what is found"), Flag("--largest")] = None
    sizes: Annotated[int, Range(2, 256), Help("Number of sizes, evenly spaced in the logarithm")] = 16
    widths: Annotated[int, Range(1, 256), Help("Number of half-widths, evenly spaced in the logarithm")] = 16
    half_width_low_s: Annotated[Duration, Help("Smallest half-width")] = 10.0
    half_width_high_s: Annotated[Duration, Help("Largest half-width")] = 1800.0
    count: Annotated[
        int, Range(10, 10**8), Help("Injections of each size and half-width"), Flag("--injections", "-n")
    ] = 2_000
    positions: Annotated[int, Range(2, 100_000), Help("Peak times in the stare")] = 40
    fitted: Annotated[
        int, Range(0, 100_000), Help("Injections of each size and half-width that are fitted if they are detected")
    ] = 40

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
