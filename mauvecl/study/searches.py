"""Study sections for the search for flares and for injected flares; `surveys` converts them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import Field, model_validator

from mauvecl.flares.defaults import HALF_WIDTHS_S, RANK, WINDOW_S, Per, check_shape, per_day
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, Help, Range, Unit, Widget
from mauvecl.schema.physical import Duration, Positive
from mauvecl.schema.section import Section
from mauvecl.study.nuisances import Spread
from mauvecl.study.stare_section import ShapeName

if TYPE_CHECKING:
    from mauvecl.flares.stare import Stare
    from mauvecl.search.templates import Bank, Baseline

#: Window, in orbits, of a baseline with the orbital cycle. Shorter ones cannot separate the cycle from a flare.
CYCLE_ORBITS = 3.0


class SearchChoice(Section):
    """Search of a stare for flares, and its rate of false alarms."""

    shape: ShapeName = "davenport2014"
    half_widths_s: Annotated[tuple[Duration, ...], Field(min_length=1), Help("Half-widths of the template bank")] = (
        HALF_WIDTHS_S
    )
    sums: Annotated[int, Range(1, 8), Help("Largest number of weighted sums per frame")] = RANK
    offset: Annotated[bool, Help("Whether to marginalise over the offset of the baseline")] = True
    slope: Annotated[bool, Help("Whether to marginalise over the slope of the baseline")] = True
    cycle: Annotated[
        bool | None,
        Help("Whether to marginalise over the orbital cycle", default="if the stare has an unknown cycle"),
    ] = None
    window_s: Annotated[
        Annotated[float, Unit("s"), Range(0)] | None,
        Help("Window of the baseline", default="1800, or three orbits with a cycle"),
    ] = None
    frame: Annotated[
        dict[Literal["dark", "light", "sky", "tilt"], Spread],
        Help("Standard deviations of nuisance parameters of each frame, in addition to the stare's jitters"),
    ] = Field(default_factory=dict)
    false_alarms: Annotated[
        Positive,
        Help("False alarms of the search per star-day, star-month or star-year"),
        Flag("--false-alarms"),
        Widget(
            label="False alarms",
            hint="Expected number of detections that are only noise, in the time that the next field states.",
            group="Search",
        ),
    ] = 1.0
    per: Annotated[
        Per,
        Help("Star-time of frames for the false alarms"),
        Flag("--alarms-per"),
        Widget(
            label="False alarms per",
            hint="Observing time of one star to which the number of false alarms refers.",
            group="Search",
            place=1,
        ),
    ] = "month"
    null: Annotated[
        Literal["sampled", "counted"],
        Help("Threshold from importance sampling of normal noise, or counted in simulated stares"),
    ] = "sampled"
    nulls: Annotated[int, Range(0, 1_000_000), Help("Simulated stares without a flare")] = 100
    points: Annotated[int, Range(1, 100), Help("Consecutive frames of the conventional rule, for comparison")] = 3
    sigma: Annotated[Positive, Help("Threshold of the conventional rule, in standard deviations")] = 3.0

    @model_validator(mode="after")
    def _possible(self) -> Self:
        check_shape(self.shape)
        if list(self.half_widths_s) != sorted(set(self.half_widths_s)):
            raise InputError.of("search.half_widths_s", list(self.half_widths_s), "ascending times")
        if self.slope and not self.offset:
            raise InputError(
                "search.slope is true without search.offset", "both or the offset alone", key="slope", value=True
            )
        return self

    @property
    def rate(self) -> float:
        """False alarms per star-day."""
        return per_day(self.false_alarms, self.per)

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
        return {name: float("inf") if sd == "free" else float(sd) for name, sd in self.frame.items()}


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

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise InputError(
                f"injections.low = {self.low:g} and high = {self.high:g}",
                "low below high",
                key="low",
                value=(self.low, self.high),
            )
        if self.half_width_low_s > self.half_width_high_s:
            raise InputError(
                f"injections.half_width_low_s = {self.half_width_low_s:g} is above half_width_high_s = "
                f"{self.half_width_high_s:g}",
                "it below",
                key="half_width_low_s",
                value=self.half_width_low_s,
            )
        return self

    @property
    def half_widths_s(self) -> tuple[float, ...]:
        """Half-widths of injected flares, evenly spaced in the logarithm."""
        import numpy as np

        if self.widths == 1:
            return (self.half_width_low_s,)
        return tuple(float(w) for w in np.geomspace(self.half_width_low_s, self.half_width_high_s, self.widths))
