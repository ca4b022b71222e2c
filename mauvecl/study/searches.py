"""Study sections for the search for flares and for injected flares; `surveys` converts them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from mauvecl.lightcurve.defaults import HALF_WIDTHS_S, RANK, WINDOW_S, Per, check_shape, per_day
from mauvecl.schema.errors import InputError
from mauvecl.study.nuisances import Spread
from mauvecl.study.sections import Section

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.bank import Bank, Level
    from mauvecl.lightcurve.stares.stare import Stare
    from mauvecl.study.study import Study

#: Window, in orbits, of a baseline with the orbital cycle. Shorter ones cannot separate the cycle from a flare.
CYCLE_ORBITS = 3.0

Positive = Annotated[float, Field(gt=0)]


class SearchChoice(Section):
    """Search of a stare for flares, and its rate of false alarms."""

    shape: str = "davenport2014"
    half_widths_s: Annotated[tuple[Positive, ...], Field(min_length=1)] = HALF_WIDTHS_S  # of the template bank
    sums: Annotated[int, Field(ge=1, le=8)] = RANK  # largest number of weighted sums per frame
    offset: bool = True  # marginalise over the offset of the baseline
    slope: bool = True  # marginalise over the slope of the baseline
    cycle: bool | None = None  # marginalise over the orbital cycle; by default if the stare has an unknown cycle
    window_s: Annotated[float, Field(ge=0)] | None = None  # baseline window; 1800 s, or three orbits with a cycle
    # Nuisance parameters that are independent in each frame, in addition to the stare's jitters.
    frame: dict[Literal["dark", "light", "sky", "tilt"], Spread] = Field(default_factory=dict)
    false_alarms: Positive = 1.0
    per: Per = "month"  # star-time of frames
    # Threshold from importance sampling of normal noise, or counted in simulated stares.
    null: Literal["sampled", "counted"] = "sampled"
    nulls: Annotated[int, Field(ge=0, le=1_000_000)] = 100  # simulated stares without a flare
    # Conventional rule for comparison: `points` consecutive frames above `sigma` standard deviations.
    points: Annotated[int, Field(ge=1, le=100)] = 3
    sigma: Positive = 3.0

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
        import numpy as np

        from mauvecl.lightcurve.flares.shapes import shape_of
        from mauvecl.lightcurve.search.bank import Bank, Level

        level = Level(self.offset, self.slope, False, WINDOW_S if self.window_s is None else self.window_s)
        return Bank(self.half_widths_s, np.ones((1, 1)), shape_of(self.shape), frame_s, level)

    def level(self, stare: Stare, orbit_s: float) -> Level:
        """Return the baseline model for a stare."""
        from mauvecl.lightcurve.search.bank import Level

        cycle = self.cycle if self.cycle is not None else any("cosine" in u.name for u in stare.unknowns)
        window = self.window_s if self.window_s is not None else CYCLE_ORBITS * orbit_s if cycle else WINDOW_S
        return Level(self.offset, self.slope, cycle, window)

    def spreads(self) -> dict[str, float]:
        """Return the standard deviations of the parameters of `frame`; infinite for "free"."""
        return {name: float("inf") if sd == "free" else float(sd) for name, sd in self.frame.items()}


#: Measures of the size of injected flares.
Size = Literal["amplitude", "duration", "energy", "band_energy"]


class InjectionQuestion(Section):
    """Grid of sizes and half-widths of injected flares, which have the study's flare temperature and band."""

    # Amplitudes, equivalent durations (s), bolometric energies, or energies in the flare's band (erg). By default
    # energies if the star's distance or radius is known, and amplitudes otherwise.
    of: Size | None = None
    low: Positive | None = None  # smallest size; by default from the sensitivity of the search
    high: Positive | None = None  # largest size, likewise
    sizes: Annotated[int, Field(ge=2, le=256)] = 16  # evenly spaced in the logarithm
    widths: Annotated[int, Field(ge=1, le=256)] = 16  # evenly spaced in the logarithm
    half_width_low_s: Positive = 10.0
    half_width_high_s: Positive = 1800.0
    count: Annotated[int, Field(ge=10, le=10**8)] = 2_000  # injections per cell
    positions: Annotated[int, Field(ge=2, le=100_000)] = 40  # peak times in the stare
    fitted: Annotated[int, Field(ge=0, le=100_000)] = 40  # injections per cell that are fitted if detected

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


def drop_default_search(data: dict[str, Any], study: Study) -> None:
    """Remove default values of search and injections from a study's data, in place."""
    for name, default in (("search", SearchChoice()), ("injections", InjectionQuestion())):
        if getattr(study, name) == default:
            del data[name]
    if "search" in data and not data["search"]["frame"]:
        del data["search"]["frame"]
