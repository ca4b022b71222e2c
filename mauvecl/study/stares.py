"""A study's stare and the flares in it: frames, gaps, what changes slowly, what is unknown; times, sizes, shapes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from mauvecl.host.errors import InputError
from mauvecl.host.files.bounded import shortened
from mauvecl.lightcurve.flares.energies import EnergyScale, amplitude_of, amplitude_of_peak
from mauvecl.lightcurve.flares.events import Cooling, Event, coefficients, temperatures_of
from mauvecl.lightcurve.flares.shapes import Shape, TableShape, shape_of
from mauvecl.lightcurve.stares.curves import ORBIT_S, Curve, Sinusoid, Table
from mauvecl.lightcurve.stares.observed import Staring
from mauvecl.lightcurve.stares.stare import CHANGING, Stare
from mauvecl.study.sections import Part
from mauvecl.study.weights import read_columns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mauvecl.host.stars.source import Source
    from mauvecl.lightcurve.stares.stare import Changing
    from mauvecl.study.sections import Star
    from mauvecl.study.study import Study

#: One orbit in whole frames, s.
ORBIT_FRAMES_S = 5680.0
#: What `nuisances.usual` draws of a stare, each with the reasons of `noise.usual.USUAL`: a thermal cycle of the orbit,
#: light lost by pointing in each frame (uniform 0-5 %), the sky's level; and the star's own slow change, an assumption.
USUAL_STARE: dict[str, dict[str, float]] = {
    "jitters": {"light": 0.05 / 12**0.5},
    "offsets": {"sky": 0.1},
    "drifts": {"star": 0.01},
    "cycles": {"temperature": 0.5},
}


class CurveText(Part):
    """What changes slowly: a sinusoid, points, or a file of two columns, time in s and value."""

    amplitude: float | None = None
    period_s: float | None = None
    phase: float = 0.0
    points: tuple[tuple[float, float], ...] | None = None
    file: Path | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if (self.amplitude is not None) + (self.points is not None) + (self.file is not None) != 1:
            raise ValueError("a curve has none or several of amplitude, points and file, expected one of them")
        if self.amplitude is None and (self.period_s is not None or self.phase):
            raise ValueError("a curve of points has a period_s or phase, expected them beside an amplitude")
        if self.file is None:
            self.curve("curve", ORBIT_S)
        return self

    def curve(self, name: str, orbit_s: float) -> Curve:
        """As a stare takes it.

        Raises
        ------
        InputError
            For a file or points that are no curve.
        """
        if self.amplitude is not None:
            return Sinusoid(self.amplitude, orbit_s if self.period_s is None else self.period_s, self.phase)
        columns = np.array(self.points) if self.file is None else read_columns(f"curve of {name}", "values", self.file)
        return Table(columns[:, 0], columns[:, 1])


Spreads = dict[Literal["star", "light", "sky", "temperature"], Annotated[float, Field(gt=0)]]


class StareQuestion(Part):
    """How long is looked, with which gaps; what changes and what is unknown; the flares where `events` names none."""

    duration_s: Annotated[float, Field(gt=0)] = ORBIT_FRAMES_S
    gaps: tuple[tuple[float, float], ...] = ()
    orbit_s: Annotated[float, Field(gt=0)] = ORBIT_S
    orbit_gap_s: Annotated[float, Field(ge=0)] = 0.0
    along_orbit: bool = False
    thermal: CurveText | None = None
    variability: CurveText | None = None
    throughput: CurveText | None = None
    sky: CurveText | None = None
    jitters: Spreads = Field(default_factory=dict)
    offsets: Spreads = Field(default_factory=dict)
    drifts: Spreads = Field(default_factory=dict)
    cycles: Spreads = Field(default_factory=dict)
    number: Annotated[int, Field(ge=0, lt=2**32)] = 0
    half_width_s: Annotated[float, Field(gt=0)] = 60.0
    shape: str = "davenport2014"
    energies_erg: tuple[Annotated[float, Field(gt=0)], ...] = ()
    search: bool = True
    bands_nm: tuple[tuple[float, float], ...] = ((200.0, 300.0), (300.0, 400.0), (400.0, 550.0), (550.0, 700.0))

    @model_validator(mode="after")
    def _possible(self) -> Self:
        shape_of(self.shape)
        if self.orbit_gap_s >= self.orbit_s:
            raise ValueError(
                f"stare.orbit_gap_s = {self.orbit_gap_s:g} of an orbit of {self.orbit_s:g} s, expected a shorter gap"
            )
        for low, high in self.bands_nm:
            if not 0 < low < high:
                raise ValueError(f"stare.bands_nm holds {low:g} to {high:g} nm, expected ascending wavelengths")
        return self

    def all_gaps(self) -> list[tuple[float, float]]:
        """The gaps that are named, and the end of every orbit."""
        every = [*self.gaps]
        if self.orbit_gap_s:
            orbits = int(np.ceil(self.duration_s / self.orbit_s))
            every += [((n + 1) * self.orbit_s - self.orbit_gap_s, (n + 1) * self.orbit_s) for n in range(orbits)]
        return every


class CoolingText(Part):
    """How a flare cools from its temperature on."""

    end_k: float
    fold_s: float


class EventText(Part):
    """One flare in time; sizes that are not given are the study's flare's.

    Attributes
    ----------
    peak_s, half_width_s : float
    amplitude, peak, equivalent_duration_s, energy_erg : float, optional
        The shape's amplitude, its highest value, or what both follow from; at most one of them.
    energy : {"bolometric", "band"}
        Which energy `energy_erg` is.
    temperature_k : float, optional
    cooling : CoolingText, optional
    shape : str
    shape_file : Path, optional
        Two columns, time in half widths and value, in place of a published shape.
    """

    peak_s: float
    half_width_s: Annotated[float, Field(gt=0)] | None = None
    amplitude: Annotated[float, Field(ge=0)] | None = None
    peak: Annotated[float, Field(ge=0)] | None = None
    equivalent_duration_s: Annotated[float, Field(gt=0)] | None = None
    energy_erg: Annotated[float, Field(gt=0)] | None = None
    energy: Literal["bolometric", "band"] = "bolometric"
    temperature_k: float | None = None
    cooling: CoolingText | None = None
    shape: str | None = None
    shape_file: Path | None = None

    @model_validator(mode="after")
    def _one_size(self) -> Self:
        sizes = ("amplitude", "peak", "equivalent_duration_s", "energy_erg")
        given = [name for name in sizes if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"an event has {' and '.join(given)}, expected one of them")
        if self.shape is not None and self.shape_file is not None:
            raise ValueError("an event has both shape and shape_file, expected one of them")
        if self.shape is not None:
            shape_of(self.shape)
        return self

    def form(self, usual: str) -> Shape:
        """Its shape."""
        if self.shape_file is None:
            return shape_of(self.shape or usual)
        columns = read_columns("flare shape", "values", self.shape_file)
        return TableShape(columns[:, 0], columns[:, 1], self.shape_file.stem, shortened(self.shape_file.name))


def stare_of(study: Study) -> Stare:
    """A study's stare: its frames, with everything that is known and unknown of them.

    Raises
    ------
    InputError
        For a stare that cannot be, or processes that a stare has in a form of its own.
    """
    processes = study.processes.processes()
    if processes.modulations:
        name, _ = processes.modulations[0]
        raise InputError(
            f"processes.{name} is of single exposures, expected jitters, offsets, drifts or cycles of [stare]"
        )
    q, instrument = study.stare, study.load_instrument()
    spreads: dict[str, dict[Changing, float]] = {
        how: {of: getattr(q, how)[of] for of in CHANGING if of in getattr(q, how)}
        for how in ("jitters", "offsets", "drifts", "cycles")
    }
    if study.nuisances.usual:
        for how, usual in USUAL_STARE.items():
            spreads[how] = {**usual, **spreads[how]}  # type: ignore[dict-item]

    def curve(name: str) -> Curve | None:
        text: CurveText | None = getattr(q, name)
        return None if text is None else text.curve(name, q.orbit_s)

    what: dict[str, Any] = {name: curve(name) for name in ("variability", "throughput", "sky")} | spreads
    what["orbit_s"] = q.orbit_s
    if q.along_orbit:
        return _along(study, instrument.frame_s, what)
    return Stare.of(
        q.duration_s,
        frame_s=instrument.frame_s,
        gaps=q.all_gaps(),
        temperature_c=instrument.temperature_c,
        thermal=curve("thermal"),
        **what,
    )


def _along(study: Study, frame_s: float, what: dict[str, Any]) -> Stare:
    """The stare as the orbit gives it, at the one target of the study's ``orbit`` from its start on.

    Raises
    ------
    InputError
        If there is not one target, or the study tells gaps or a thermal curve as well.
    """
    from mauvecl.study.orbits import targets_of

    q, o = study.stare, study.orbit
    if q.gaps or q.orbit_gap_s or q.thermal is not None:
        raise InputError("stare.along_orbit beside gaps or a thermal curve, expected the orbit to give them")
    targets = targets_of(study)
    if len(targets) != 1:
        raise InputError(f"stare.along_orbit with {len(targets)} targets, expected one in orbit.targets")
    return Stare.along(o.orbit(), targets[0], o.start, q.duration_s, frame_s=frame_s, limits=o.limits.limits(), **what)


def staring_of(study: Study, star: Star) -> tuple[Staring, list[Event]]:
    """A star of a study, its stare and its flares, and what frames are made of; the flares beside it.

    Raises
    ------
    InputError
        For anything of it that cannot be.
    """
    source, stare = star.source(), stare_of(study)
    events = events_of(study, star, source)
    kelvin = temperatures_of(events)
    frames = study.model_copy(
        update={"observation": study.observation.model_copy(update={"exposure_s": stare.frame_s})}
    )
    # A flare that takes the place of photosphere is as linear in its amplitude, but not up to one.
    unit = 1.0 if study.flare.geometry == "added" else 0.01
    flares = [
        frames.model_copy(update={"flare": study.flare.model_copy(update={"temperature_k": float(k)})}) for k in kelvin
    ]
    quiet, *flaring = frames.expect([source, *(one.flaring(source, unit) for one in flares)])
    electrons = [(x.source_electrons - quiet.source_electrons) / unit for x in flaring]
    spectra = np.reshape(electrons, (kelvin.size, quiet.wavelength_nm.size))
    return Staring(quiet, stare, spectra, coefficients(events, stare.start_s, stare.frame_s, kelvin)), events


def orbit_lines(study: Study) -> list[str]:
    """What must be told of the orbit that a study's stare is along, if it is."""
    from mauvecl.host.orbit.moments import DAY_S, Moments

    if not study.stare.along_orbit:
        return []
    o = study.orbit
    moments = Moments(o.start, study.stare.duration_s / DAY_S, study.load_instrument().frame_s)
    assumed = (
        "Limits, temperatures and windows of a stare along the orbit are assumptions; stray light is not modelled."
    )
    return [*o.orbit().messages(moments), assumed]


def energy_scale(
    study: Study, star: Star, source: Source, kind: Literal["bolometric", "band"], flare_k: float
) -> EnergyScale | None:
    """What a second of equivalent duration comes to for a star; None where its size and distance are unknown.

    By radius and temperature where the study has them, by its distance otherwise.
    """
    hot = flare_k if kind == "bolometric" else None
    if star.radius_rsun is not None and star.effective_temperature_k is not None:
        return EnergyScale.of_blackbody(
            star.radius_rsun, star.effective_temperature_k, band=study.flare.band, flare_k=hot
        )
    if star.distance_pc is not None:
        return EnergyScale.of_star(source, star.distance_pc, band=study.flare.band, flare_k=hot)
    return None


def energy_of(
    study: Study, star: Star, source: Source, event: Event, kind: Literal["bolometric", "band"]
) -> float | None:
    """Energy of a flare at a star, erg; None where the star's size and distance are unknown."""
    if energy_scale(study, star, source, kind, event.hottest_k) is None:
        return None

    def scale_of(kelvin: float) -> EnergyScale:
        scale = energy_scale(study, star, source, kind, kelvin)
        assert scale is not None
        return scale

    return event.bolometric_energy(scale_of)


def events_of(study: Study, star: Star, source: Source) -> list[Event]:
    """A study's flares at one of its stars: its `events`, or one of each energy or amplitude, evenly over the stare.

    Raises
    ------
    InputError
        For an energy where neither the star's size nor its distance is known, or a flare that cannot be.
    """
    texts = study.events or _spread(study)
    return [_event(study, star, source, text) for text in texts]


def _spread(study: Study) -> Sequence[EventText]:
    q = study.stare
    sizes = [{"energy_erg": e} for e in q.energies_erg] or [{"amplitude": a} for a in study.flare.amplitudes]
    # As much before the first as from one to the next.
    step = q.duration_s / (len(sizes) + 1)
    return [EventText(peak_s=step * (n + 1), **size) for n, size in enumerate(sizes)]


def _event(study: Study, star: Star, source: Source, text: EventText) -> Event:
    shape, flare = text.form(study.stare.shape), study.flare
    half = study.stare.half_width_s if text.half_width_s is None else text.half_width_s
    kelvin = flare.temperature_k if text.temperature_k is None else text.temperature_k
    temperature = kelvin if text.cooling is None else Cooling(kelvin, text.cooling.end_k, text.cooling.fold_s)
    amplitude = flare.amplitudes[0] if text.amplitude is None else text.amplitude
    if text.peak is not None:
        amplitude = amplitude_of_peak(text.peak, shape)
    elif text.equivalent_duration_s is not None:
        amplitude = amplitude_of(text.equivalent_duration_s, half, shape)
    elif text.energy_erg is not None:
        # Any energy is linear in the amplitude.
        one = energy_of(study, star, source, Event(text.peak_s, half, 1.0, temperature, shape), text.energy)
        if one is None:
            raise InputError(
                f"a flare of {text.energy_erg:g} erg at {source.name} of unknown size, expected the star's distance_pc "
                "or radius_rsun and effective_temperature_k"
            )
        amplitude = text.energy_erg / one
    return Event(text.peak_s, half, amplitude, temperature, shape)


def check_sweep(study: Study) -> None:
    """See that what a study sweeps over changes its stares.

    Raises
    ------
    InputError
        For a quantity that does not.
    """
    sizes = ("amplitude", "peak", "equivalent_duration_s", "energy_erg")
    events = study.events
    fixed = {
        "exposure": True,
        "amplitude": bool(study.stare.energies_erg)
        if not events
        else all(any(getattr(event, size) is not None for size in sizes) for event in events),
        "flare_temperature": bool(events) and all(event.temperature_k is not None for event in events),
    }
    for axis in study.sweep.axes:
        if fixed.get(axis.quantity):
            raise InputError(
                f"a sweep over {axis.quantity.replace('_', ' ')} changes no flare of this stare, expected a quantity "
                "that its [stare] and events leave open"
            )


def find_curves(data: dict[str, Any], folder: Path) -> None:
    """Put the folder of a study before the names of its curves' and shapes' files."""
    stare, events = data.get("stare"), data.get("events")
    curves = [one for one in stare.values() if isinstance(one, dict)] if isinstance(stare, dict) else []
    shapes = [one for one in events if isinstance(one, dict)] if isinstance(events, list) else []
    for one, key in [*((curve, "file") for curve in curves), *((shape, "shape_file") for shape in shapes)]:
        if isinstance(one.get(key), str):
            one[key] = str(folder / one[key])


def without_usual(data: dict[str, Any], study: Study) -> None:
    """Leave out of a study's text what it does not say of stares; files by their full names."""
    if study.stare == StareQuestion():
        del data["stare"]
    else:
        for how in ("jitters", "offsets", "drifts", "cycles"):
            if not data["stare"][how]:
                del data["stare"][how]
    if not study.events:
        del data["events"]
    find_curves(data, Path.cwd())
