"""A study's search for flares and the flares that are injected: sections, and the survey that they make of a star."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from mauvecl.host.errors import InputError
from mauvecl.lightcurve.flares.shapes import shape_of
from mauvecl.lightcurve.search.bank import HALF_WIDTHS_S, WINDOW_S, Bank, Level
from mauvecl.lightcurve.search.null import Per, per_day
from mauvecl.lightcurve.search.recovery import Fit
from mauvecl.lightcurve.search.survey import Survey
from mauvecl.lightcurve.search.templates import RANK, TEMPERATURES_K, Templates, frame_nuisances
from mauvecl.lightcurve.stares.components import Components
from mauvecl.study.nuisances import Spread
from mauvecl.study.sections import Part
from mauvecl.study.stares import energy_scale, stare_of

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.host.stars.source import Source
    from mauvecl.lightcurve.stares.stare import Stare
    from mauvecl.study.sections import Star
    from mauvecl.study.study import Study

#: Orbits over which a level with the orbit's cycle is fitted: fewer cannot tell the cycle from a flare of minutes.
CYCLE_ORBITS = 3.0
#: Smallest and largest flare of a map that is not told, in sizes that the search finds half of.
AROUND = (0.3, 3.0)

Positive = Annotated[float, Field(gt=0)]


class SearchChoice(Part):
    """How a stare is searched for flares, and how many false alarms there may be.

    Attributes
    ----------
    shape : str
    half_widths_s : tuple of float
        Of the bank.
    sums : int
        Of each frame, at most.
    offset, slope : bool
        Whether they are unknown of the level under a flare.
    cycle : bool, optional
        Whether the curves of the stare's unknowns are; where the stare has an unknown cycle by default.
    window_s : float, optional
        Time over which the level is taken for what it is; 1800 s by default, with a cycle three orbits.
    frame : dict of str to float or "free"
        What is unknown of each frame apart from all others, beside the stare's jitters: dark, light, sky, tilt.
    false_alarms : float
    per : {"day", "month", "year"}
        Of star-days of frames.
    null : {"sampled", "counted"}
        Whether the threshold comes from normal noise by importance sampling, or from the stares that are drawn.
    nulls : int
        Stares drawn without a flare.
    points, sigma
        The common rule beside it: so many consecutive points above so many standard deviations.
    """

    shape: str = "davenport2014"
    half_widths_s: Annotated[tuple[Positive, ...], Field(min_length=1)] = HALF_WIDTHS_S
    sums: Annotated[int, Field(ge=1, le=8)] = RANK
    offset: bool = True
    slope: bool = True
    cycle: bool | None = None
    window_s: Annotated[float, Field(ge=0)] | None = None
    frame: dict[Literal["dark", "light", "sky", "tilt"], Spread] = Field(default_factory=dict)
    false_alarms: Positive = 1.0
    per: Per = "month"
    null: Literal["sampled", "counted"] = "sampled"
    nulls: Annotated[int, Field(ge=0, le=1_000_000)] = 100
    points: Annotated[int, Field(ge=1, le=100)] = 3
    sigma: Positive = 3.0

    @model_validator(mode="after")
    def _possible(self) -> Self:
        shape_of(self.shape)
        if list(self.half_widths_s) != sorted(set(self.half_widths_s)):
            raise ValueError(f"search.half_widths_s = {list(self.half_widths_s)}, expected ascending times")
        if self.slope and not self.offset:
            raise ValueError("search.slope without search.offset, expected both or the offset alone")
        return self

    @property
    def rate(self) -> float:
        """False alarms per star-day."""
        return per_day(self.false_alarms, self.per)

    def white_bank(self, frame_s: float) -> Bank:
        """For one sum of each frame and no curves, as closed forms take it."""
        level = Level(self.offset, self.slope, False, WINDOW_S if self.window_s is None else self.window_s)
        return Bank(self.half_widths_s, np.ones((1, 1)), shape_of(self.shape), frame_s, level)

    def level(self, stare: Stare, orbit_s: float) -> Level:
        """What is unknown of the level in a stare."""
        cycle = self.cycle if self.cycle is not None else any("cosine" in u.name for u in stare.unknowns)
        window = self.window_s if self.window_s is not None else CYCLE_ORBITS * orbit_s if cycle else WINDOW_S
        return Level(self.offset, self.slope, cycle, window)

    def spreads(self) -> dict[str, float]:
        """Of what is unknown in each frame; infinite for what is projected out."""
        return {name: float("inf") if sd == "free" else float(sd) for name, sd in self.frame.items()}


#: What the sizes of injected flares may be.
Size = Literal["amplitude", "duration", "energy", "band_energy"]


class InjectionQuestion(Part):
    """Which flares are injected: sizes x half-widths, of the study's flare temperature and band.

    Attributes
    ----------
    of : {"amplitude", "duration", "energy", "band_energy"}, optional
        Sizes: amplitudes, equivalent durations (s), bolometric energies or those in the flare's band (erg); energies
        where the star's distance or radius is known, amplitudes elsewhere, by default.
    low, high : float, optional
        Smallest and largest size; from what the search should find, by default.
    sizes, widths : int
        How many, evenly in the logarithm.
    half_width_low_s, half_width_high_s : float
    shape : str, optional
        The search's by default.
    count : int
        Injections of each cell.
    positions : int
        Places in the stare at which they peak.
    fitted : int
        Injections of each cell whose flares are fitted, where they are found.
    """

    of: Size | None = None
    low: Positive | None = None
    high: Positive | None = None
    sizes: Annotated[int, Field(ge=2, le=256)] = 16
    widths: Annotated[int, Field(ge=1, le=256)] = 16
    half_width_low_s: Positive = 10.0
    half_width_high_s: Positive = 1800.0
    count: Annotated[int, Field(ge=10, le=10**8)] = 2_000
    positions: Annotated[int, Field(ge=2, le=100_000)] = 40
    fitted: Annotated[int, Field(ge=0, le=100_000)] = 40

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"injections.low = {self.low:g} and high = {self.high:g}, expected low below high")
        if self.half_width_low_s > self.half_width_high_s:
            raise ValueError(
                f"injections.half_width_low_s = {self.half_width_low_s:g} is above half_width_high_s = "
                f"{self.half_width_high_s:g}, expected it below"
            )
        return self

    @property
    def half_widths_s(self) -> tuple[float, ...]:
        """Half-widths injected."""
        if self.widths == 1:
            return (self.half_width_low_s,)
        return tuple(float(w) for w in np.geomspace(self.half_width_low_s, self.half_width_high_s, self.widths))


@dataclass(frozen=True, eq=False)
class Surveyed:
    """A star of a study, as it is stared at and searched.

    Attributes
    ----------
    source : Source
    quiet : Expectation
        One frame.
    templates : Templates
    survey : Survey
        With the study's flare as the only one of its components.
    """

    source: Source
    quiet: Expectation
    templates: Templates
    survey: Survey

    @property
    def fit(self) -> Fit:
        """How what is found is fitted."""
        return Fit(self.survey.bank, self.templates)

    @property
    def unit_snr(self) -> float:
        """S/N of one frame for the study's flare with an amplitude of one, shape and level aside."""
        x = self.survey.components
        unit = np.zeros(3 + x.n_flares)
        unit[:3], unit[3] = 1.0, 1.0
        return float(np.linalg.norm(x.means(unit)))


def surveyed(study: Study, star: Star) -> Surveyed:
    """What a study's stare and search come to for one of its stars.

    Raises
    ------
    InputError
        For anything in the study that cannot be.
    """
    source, stare = star.source(), stare_of(study)
    choice = study.search
    frames = study.model_copy(
        update={"observation": study.observation.model_copy(update={"exposure_s": stare.frame_s})}
    )
    kelvin = (*TEMPERATURES_K, study.flare.temperature_k)
    quiet, electrons = flare_electrons(frames, source, kelvin)
    nuisances = frame_nuisances(quiet, stare, choice.spreads())
    templates = Templates.of(
        quiet,
        electrons[:-1] * quiet.gain_dn_per_electron,
        TEMPERATURES_K,
        nuisances=nuisances,
        rank=choice.sums,
    )
    level = choice.level(stare, study.stare.orbit_s)
    bank = Bank(
        choice.half_widths_s, templates.directions[list(templates.chosen)], shape_of(choice.shape), stare.frame_s, level
    )
    survey = Survey(Components(quiet, electrons[-1:], templates.weights), stare, bank)
    if level.cycle and not len(survey.curves if survey.curves is not None else ()):
        raise InputError("search.cycle without a curve, expected unknown cycles in the stare")
    return Surveyed(source, quiet, templates, survey)


def flare_electrons(study: Study, source: Source, kelvin: tuple[float, ...]) -> tuple[Expectation, NDArray[np.float64]]:
    """One frame of a star, and the electrons that flares of one amplitude add to it, (n_temperature, n_pixel)."""
    # A flare that takes the place of photosphere is as linear in its amplitude, but not up to one.
    unit = 1.0 if study.flare.geometry == "added" else 0.01
    each = [study.model_copy(update={"flare": study.flare.model_copy(update={"temperature_k": k})}) for k in kelvin]
    quiet, *flaring = study.expect([source, *(one.flaring(source, unit) for one in each)])
    return quiet, np.array([(x.source_electrons - quiet.source_electrons) / unit for x in flaring])


@dataclass(frozen=True)
class Sizes:
    """What the sizes of flares are, for one star: amplitude x half-width^power x per_unit.

    Attributes
    ----------
    of : str
    power : int
    per_unit : float
        Size of a flare of one amplitude and a half-width of 1 s.
    """

    of: Size
    power: int
    per_unit: float

    @classmethod
    def chosen(cls, study: Study, star: Star, source: Source) -> Sizes:
        """By a study.

        Raises
        ------
        InputError
            For energies of a star of unknown size.
        """
        asked = study.injections.of
        flare = study.flare
        bolometric = energy_scale(study, star, source, "bolometric", flare.temperature_k)
        if asked is None:
            asked = "amplitude" if bolometric is None else "energy"
        if asked == "amplitude":
            return cls("amplitude", 0, 1.0)
        area = shape_of(study.search.shape).equivalent_duration
        if asked == "duration":
            return cls("duration", 1, area)
        kind: Any = "bolometric" if asked == "energy" else "band"
        scale = energy_scale(study, star, source, kind, flare.temperature_k)
        if scale is None:
            raise InputError(
                f"injections.of = {asked!r} at {source.name} of unknown size, expected the star's distance_pc or "
                "radius_rsun and effective_temperature_k"
            )
        return cls(asked, 1, area * scale.erg_per_s)

    def of_amplitude(self, amplitude: Any, half_width_s: Any) -> Any:
        """The size of amplitudes and half-widths, broadcast together."""
        return amplitude * half_width_s**self.power * self.per_unit

    def amplitude(self, size: Any, half_width_s: Any) -> Any:
        """The amplitude of sizes."""
        return size / (half_width_s**self.power * self.per_unit)


def sizes_of(study: Study, sizes: Sizes, unit_snr: float, threshold: float) -> NDArray[np.float64]:
    """The sizes that a study injects, ascending; around what half are found of where the study does not tell."""
    asked = study.injections
    widths = np.array([asked.half_width_low_s, asked.half_width_high_s])
    frames = widths / study.load_instrument().frame_s
    # S/N of a known flare on a known level: (A / sigma) sqrt(square integral x half-width), of no more than its frames.
    amplitude = threshold / unit_snr / np.sqrt(shape_of(study.search.shape).square_integral * frames)
    half = sizes.of_amplitude(amplitude, widths)
    low = AROUND[0] * half.min() if asked.low is None else asked.low
    high = AROUND[1] * half.max() if asked.high is None else asked.high
    if not low < high:
        raise InputError(f"injections from {low:.3g} to {high:.3g}, expected low below high")
    return np.geomspace(low, high, asked.sizes)


def without_usual_search(data: dict[str, Any], study: Study) -> None:
    """Leave out of a study's text what it does not say of searches."""
    for name, usual in (("search", SearchChoice()), ("injections", InjectionQuestion())):
        if getattr(study, name) == usual:
            del data[name]
    if "search" in data and not data["search"]["frame"]:
        del data["search"]["frame"]
