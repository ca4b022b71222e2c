"""Stares: times, known conditions, flares, and unknown changes of the frames of a long observation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.flares import MOST_TEMPERATURES, ORBIT_S, SAME_K, Cooling, Curve, Sinusoid
from mauvecl.flares.energies import EnergyScale, amplitude_of
from mauvecl.flares.shapes import SHAPES, Shape, TableShape, shape_of
from mauvecl.host.arrays import Float, set_read_only
from mauvecl.host.orbit import Limits
from mauvecl.host.orbit.orbit import Orbit, Target, TimeGrid
from mauvecl.host.orbit.visibility import Particles, Thermal, Visibility
from mauvecl.noise.disturbances import PointingDrifts
from mauvecl.noise.unknowns import STARE_CHANGES, Changing
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import DAY_S, Amplitude, DateText, Duration, Energy, Moment, Range, Temperature, Unit

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation


#: Smallest number of a stare's temperatures that are left for flares that cool.
LEAST_STEPS = 3
#: For a flare that cools: smallest number of steps per frame, half-width and cooling time, and largest per frame.
PARTS, MOST_PARTS = 16, 512
#: Fraction of a flare's peak and of its fluence below which its light in a frame is neglected.
LEAST_LIGHT = 1e-9


@validated
@dataclass(frozen=True)
class Event:
    """A flare in a stare.

    Attributes
    ----------
    peak_s : float
        Time at which tau is 0, from the start of the stare.
    half_width_s : float
        t_1/2 of the shape's publication.
    amplitude : float
        Factor on the shape: relative rise of the photons in the flare's band.
    temperature : float or Cooling
        K.
    shape : Shape or str

    Examples
    --------
    >>> from mauvecl.flares.stare import Event
    >>> flare = Event.of_peak(0.1, peak_s=600, half_width_s=60, shape="tovarmendoza2022")
    >>> round(flare.amplitude, 4), round(flare.equivalent_duration_s, 3)
    (0.1052, 12.888)
    """

    peak_s: Moment
    half_width_s: Duration
    amplitude: Amplitude
    temperature: Temperature | Cooling = 10_000.0
    shape: Shape | str = field(default_factory=lambda: SHAPES["davenport2014"])

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", shape_of(self.shape))

    @classmethod
    def of_peak(
        cls,
        peak: Amplitude,
        *,
        peak_s: Moment,
        half_width_s: Duration,
        temperature: Temperature | Cooling = 10_000.0,
        shape: Shape | str = "davenport2014",
    ) -> Self:
        """Return the flare with a maximum relative rise, which is not the amplitude of every shape."""
        return cls(peak_s, half_width_s, peak / shape_of(shape).peak, temperature, shape)

    @classmethod
    def of_equivalent_duration(
        cls,
        equivalent_duration_s: Annotated[float, Unit("s"), Range(0)],
        *,
        peak_s: Moment,
        half_width_s: Duration,
        temperature: Temperature | Cooling = 10_000.0,
        shape: Shape | str = "davenport2014",
    ) -> Self:
        """Return the flare with an equivalent duration in the band."""
        return cls(peak_s, half_width_s, amplitude_of(equivalent_duration_s, half_width_s, shape), temperature, shape)

    @classmethod
    def of_energy(
        cls,
        energy_erg: Energy,
        scale: EnergyScale,
        *,
        peak_s: Moment,
        half_width_s: Duration,
        temperature: Temperature | Cooling = 10_000.0,
        shape: Shape | str = "davenport2014",
    ) -> Self:
        """Return the flare with an energy; for one that cools see `total_energy`."""
        amplitude = amplitude_of(scale.equivalent_duration(energy_erg), half_width_s, shape)
        return cls(peak_s, half_width_s, amplitude, temperature, shape)

    @property
    def form(self) -> Shape:
        """The shape."""
        return shape_of(self.shape)

    @property
    def hottest_k(self) -> float:
        """Temperature at the peak, K."""
        return float(self.temperature.peak_k if isinstance(self.temperature, Cooling) else self.temperature)

    @property
    def peak(self) -> float:
        """Maximum relative rise of the photons in the band."""
        return self.amplitude * self.form.peak

    @property
    def equivalent_duration_s(self) -> float:
        """Equivalent duration in the band, s."""
        return self.amplitude * self.half_width_s * self.form.equivalent_duration

    def energy(self, scale: EnergyScale) -> float:
        """Return the energy, erg."""
        return scale.energy(self.equivalent_duration_s)

    def total_energy(self, scale_of: Callable[[float], EnergyScale], nodes: Float | None = None) -> float:
        """Return the energy of a flare that may cool, erg, for the energy scales of temperatures in K.

        Frames interpolate the light of a flare that cools between the spectra of a few temperatures. The energy is that
        of the interpolated light, which is the light that is drawn. `nodes` are the temperatures of the spectra,
        `temperatures_of` all flares of the stare; by default of this flare alone.
        """
        cooling = _cooling_of(self)
        if cooling is None:
            return self.energy(scale_of(self.hottest_k))
        nodes = temperatures_of([self]) if nodes is None else nodes
        # Published shapes end within these half-widths; a table may be longer, as one in seconds is.
        first, last = -10.0, 1000.0
        if isinstance(self.form, TableShape):
            first, last = min(first, float(self.form.tau[0])), max(last, float(self.form.tau[-1]))
        # Steps resolve the half-width and the cooling time; rounding removes duplicates that differ in their last bits.
        tau = np.concatenate([[first], np.linspace(-10.0, 10.0, 2001), np.geomspace(10.0, last, 1001)[1:]])
        fold = np.linspace(0.0, 20.0, 2001) * cooling.fold_s / self.half_width_s
        edges = self.half_width_s * np.unique(np.concatenate([tau, fold[fold < last]]).round(6))
        light = self.form.mean_over(edges, 0.0, self.half_width_s) * np.diff(edges)
        kelvin = cooling.at((edges[1:] + edges[:-1]) / 2)
        per_s = 0.0
        for column, share in _node_weights(kelvin, nodes):
            per_s += float(light @ share) * scale_of(float(nodes[column])).erg_per_s
        return float(self.amplitude * per_s)


def check_contributions(events: Sequence[Event], start_s: Float, frame_s: float) -> list[str]:
    """Return a message for each flare that peaks outside the frames but contributes light to them.

    Raises InputError if a flare contributes no light.
    """
    frames = np.column_stack([start_s, start_s + frame_s])
    sentences = []
    for number, event in enumerate(events, 1):
        mean = event.form.mean_over(frames, event.peak_s, event.half_width_s)
        share = float(mean.sum()) * frame_s / event.half_width_s / event.form.equivalent_duration
        if max(share, float(mean.max()) / event.form.peak) < LEAST_LIGHT:
            raise InputError(
                f"flare {number}, which peaks at {event.peak_s:g} s, adds no light to the frames of the stare; it must "
                f"shine between {start_s[0]:g} and {start_s[-1] + frame_s:g} s and outside gaps",
                key="peak_s",
            )
        peak_s = event.peak_s + event.half_width_s * event.form.peak_at
        last = int(np.searchsorted(start_s, peak_s, side="right")) - 1
        if last < 0 or peak_s >= start_s[last] + frame_s:
            sentences.append(
                f"Flare {number} peaks at {event.peak_s:g} s, outside the frames of the stare, which contain "
                f"{100 * share:.3g} % of its light."
            )
    return sentences


def temperatures_of(events: Sequence[Event]) -> Float:
    """Return the temperatures whose spectra represent the events, K, ascending, shape (n_temperature,).

    They are all constant temperatures and, for flares that cool, a grid that is even in 1 / T. Raises InputError if
    there are more than `MOST_TEMPERATURES`.
    """
    constant: list[float] = []
    cooling = []
    for event in events:
        law = _cooling_of(event)
        if law is not None:
            cooling.append(law)
        elif all(abs(event.hottest_k - kelvin) >= SAME_K for kelvin in constant):
            constant.append(event.hottest_k)
    most = MOST_TEMPERATURES - (LEAST_STEPS if cooling else 0)
    if len(constant) > most:
        raise InputError(
            f"flares of a stare must have at most {most} constant "
            f"temperatures{' besides those that cool' if cooling else ''}, not {len(constant)}",
            key="events",
        )
    if cooling:
        low, high = min(c.end_k for c in cooling), max(c.peak_k for c in cooling)
        nodes = 1.0 / np.linspace(1.0 / low, 1.0 / high, MOST_TEMPERATURES - len(constant))
        constant += [float(k) for k in nodes if all(abs(k - kelvin) >= SAME_K for kelvin in constant)]
    return np.sort(np.array(constant))


def coefficients(events: Sequence[Event], start_s: Float, frame_s: float, temperatures_k: Float) -> Float:
    """Return the mean amplitude of each flare spectrum in each frame, shape (n_frame, n_temperature).

    Flares of constant temperature are integrated exactly. The light of a flare that cools is interpolated linearly in
    1 / T between the spectra of the two neighbouring temperatures, with a constant temperature in each step of a frame.
    Raises InputError if a flare has a temperature outside the range of `temperatures_k`, which are ascending and at
    least those of `temperatures_of`.
    """
    factors = np.zeros((start_s.size, temperatures_k.size))
    for event in events:
        parts, cooling = 1, _cooling_of(event)
        if cooling is not None:
            shortest = min(frame_s, event.half_width_s, cooling.fold_s)
            parts = int(min(np.ceil(PARTS * frame_s / shortest), MOST_PARTS))
        for part in range(parts):
            start = start_s + part * frame_s / parts
            edges = np.column_stack([start, start + frame_s / parts])
            mean = event.amplitude / parts * event.form.mean_over(edges, event.peak_s, event.half_width_s)
            middle = start + frame_s / parts / 2
            kelvin = np.array([event.hottest_k]) if cooling is None else cooling.at(middle - event.peak_s)
            for column, share in _node_weights(kelvin, temperatures_k):
                factors[:, column] += share * mean
    return factors


def _cooling_of(event: Event) -> Cooling | None:
    """Return how a flare cools, or None if its temperature hardly changes."""
    law = event.temperature
    return law if isinstance(law, Cooling) and not law.steady else None


def _node_weights(temperature: Float, nodes: Float) -> list[tuple[int, Float]]:
    """Return indices of nodes that have a weight, and their weights, linear in 1 / T, shape of the temperature."""
    if temperature.min() < nodes[0] - SAME_K or temperature.max() > nodes[-1] + SAME_K:
        raise InputError(
            f"the temperatures of a flare must be within {nodes[0]:g} to {nodes[-1]:g} K, but are "
            f"{temperature.min():g} to {temperature.max():g} K",
            key="temperature",
        )
    inverse = -1.0 / nodes
    place = np.interp(-1.0 / temperature, inverse, np.arange(nodes.size, dtype=np.float64))
    shares = [np.maximum(0.0, 1.0 - np.abs(place - column)) for column in range(nodes.size)]
    return [(column, share) for column, share in enumerate(shares) if share.any()]


#: Largest number of frames of a stare, twenty years of 5 s.
MOST_FRAMES = 2**27
#: Arrays of a stare with a value per frame.
PER_FRAME = ("start_s", "star", "light", "sky", "temperature_c")
#: Largest relative standard deviation; with larger ones, levels could be negative.
LARGEST_SPREAD = 0.2
HOUR_S = 3600.0


@dataclass(frozen=True, eq=False)
class StareUnknown:
    """Unknown change of a stare: a normal amplitude times a known curve."""

    name: str
    of: Changing
    sd: float  # standard deviation of the amplitude; relative, or deg C for the temperature
    curve: Float  # effect of unit amplitude on each frame, shape (n_frame,)

    def __post_init__(self) -> None:
        set_read_only(self, curve=self.curve)
        _check_spread(self.name, self.of, self.sd)


@validated
@dataclass(frozen=True, eq=False)
class Stare:
    """Frames of one star, with gaps; arrays are read-only.

    In frame k of stare i, with standard normal z drawn for the stare and e drawn for the frame,

    - all light, of star, flare and sky, is multiplied by light_k (1 + sum_u sd_u z_iu curve_uk + light_jitter e_ik);
    - the light of the star without flares is also multiplied by star_k (1 + sum_u ...), and that of the sky by
      sky_k (1 + sum_u ... + sky_jitter e_ik);
    - the detector's temperature is temperature_c_k + sum_u ... + temperature_jitter_c e_ik.

    Each jitter and each sum has independent draws.

    Attributes
    ----------
    start_s : ndarray, shape (n_frame,)
        Start of each frame from the start of the stare: ascending multiples of `frame_s`, without frames in gaps.
    frame_s : float
    star, light, sky : ndarray, shape (n_frame,)
        Known factors on the light of the star, on all light, and on the sky.
    temperature_c : ndarray, shape (n_frame,)
        Known detector temperature.
    light_jitter, sky_jitter : float
        Relative standard deviation from frame to frame.
    temperature_jitter_c : float
        Standard deviation from frame to frame, deg C.
    unknowns : tuple of StareUnknown
        Changes that differ between stares.
    pointing : PointingDrifts, optional
        Drifts out of the fibre, drawn for each stare, by which all light is multiplied as well.

    Examples
    --------
    >>> from mauvecl.flares.stare import Stare
    >>> stare = Stare.of(6000, gaps=[(1000, 2000)], thermal=0.5, drifts={"light": 0.01})
    >>> stare.n_frames, stare.gtis.tolist()
    (1000, [[0.0, 1000.0], [2000.0, 6000.0]])
    """

    start_s: Annotated[Float, Unit("s")]
    frame_s: Duration
    star: Float
    light: Float
    sky: Float
    temperature_c: Annotated[Float, Unit("deg_C")]
    light_jitter: float = 0.0
    sky_jitter: float = 0.0
    temperature_jitter_c: float = 0.0
    unknowns: tuple[StareUnknown, ...] = ()
    pointing: PointingDrifts | None = None

    def __post_init__(self) -> None:
        arrays = {name: getattr(self, name) for name in PER_FRAME}
        set_read_only(self, **arrays)
        n = self.start_s.size
        if not 1 <= n <= MOST_FRAMES:
            raise InputError.of("n_frames", n, f"between 1 and {MOST_FRAMES}")
        curves = [(unknown.name, unknown.curve) for unknown in self.unknowns]
        for name, values in [*((name, getattr(self, name)) for name in PER_FRAME), *curves]:
            if values.shape != (n,):
                raise InputError(f"{name} of the stare must have the shape ({n},), not {values.shape}", key=name)
            if not np.isfinite(values).all():
                raise InputError(
                    f"{name} must be finite, but is not in frame {int(np.argmin(np.isfinite(values)))}", key=name
                )
        off = np.abs(self.start_s / self.frame_s - self.numbers)
        if not (off < 1e-6).all() or self.numbers[0] < 0 or not (np.diff(self.numbers) > 0).all():
            raise InputError(
                f"the frames of a stare must start at ascending multiples of {self.frame_s:g} s from 0, not at "
                f"{self.start_s[0]:g} ... {self.start_s[-1]:g} s",
                key="start_s",
            )
        for name, values in (("star", self.star), ("light", self.light), ("sky", self.sky)):
            if not (values >= 0).all():
                k = int(np.argmin(values >= 0))
                raise InputError(
                    f"the factor on the {name} must be at least 0, but is {values[k]:g} in frame {k}", key=name
                )
        for of, sd in self.jitters.items():
            _check_spread(f"{of} jitter", of, sd, least=0.0)
        for unknown in self.unknowns:
            _check_spread(unknown.name, unknown.of, unknown.sd * float(np.abs(unknown.curve).max()), least=0.0)

    @classmethod
    def of(
        cls,
        duration_s: Duration,
        *,
        frame_s: Duration = 5.0,
        gaps: Sequence[tuple[Moment, Moment]] = (),
        temperature_c: Annotated[float, Unit("deg_C"), Range()] = 21.0,
        thermal: float | Curve | None = None,
        variability: Curve | None = None,
        throughput: Curve | None = None,
        sky: Curve | None = None,
        orbit_s: Duration = ORBIT_S,
        jitters: Mapping[Changing, float] | None = None,
        offsets: Mapping[Changing, float] | None = None,
        drifts: Mapping[Changing, float] | None = None,
        cycles: Mapping[Changing, float] | None = None,
        pointing: PointingDrifts | None = None,
    ) -> Self:
        """Return a stare from its duration, gaps and changes.

        Parameters
        ----------
        duration_s : float
            From the first frame to the end of the last, rounded up to whole frames.
        frame_s : float
        gaps : sequence of (float, float)
            Start and end of gaps, s; frames that overlap a gap are lost.
        temperature_c : float
            Mean detector temperature; that of the payload by default.
        thermal : float or Curve, optional
            Change of the temperature, deg C: the amplitude of a sinusoid with the orbital period, or a curve.
        variability : Curve, optional
            Relative variability of the star: 0.01 is 1 % brighter.
        throughput, sky : Curve, optional
            Known relative changes of all light, and of the sky brightness.
        orbit_s : float
            Period of `cycles`, and of sinusoids without a given period.
        jitters : mapping of {"light", "sky", "temperature"} to float, optional
            Standard deviation from frame to frame.
        offsets, drifts, cycles : mapping of {"star", "light", "sky", "temperature"} to float, optional
            Standard deviations over stares of an unknown level, of an unknown change per hour that is zero in the
            middle, and of the sine and cosine of an unknown orbital cycle.
        pointing : PointingDrifts, optional
            Drifts out of the fibre with re-acquisitions.

        Raises
        ------
        InputError
            If the gaps leave no frame, or for an invalid value.
        """
        start = _starts(duration_s, float(frame_s), gaps)

        def over_frames(curve: Curve | None) -> Float:
            return np.zeros(start.size) if curve is None else curve.mean_over(start, float(frame_s), orbit_s)

        spread = dict(jitters or {})
        for name in spread:
            if name not in STARE_CHANGES["jitters"]:
                raise InputError.of("jitters", name, f"one of {', '.join(STARE_CHANGES['jitters'])}")
        warmth = over_frames(Sinusoid(thermal) if isinstance(thermal, int | float) else thermal)
        changed = {"star": variability, "light": throughput, "sky": sky}
        hours = (start + frame_s / 2 - (start[0] + start[-1] + frame_s) / 2) / HOUR_S
        sine, cosine = (over_frames(Sinusoid(1.0, orbit_s, phase)) for phase in (0.0, np.pi / 2))
        unknowns = [StareUnknown(f"{of} offset", of, sd, np.ones(start.size)) for of, sd in (offsets or {}).items()]
        unknowns += [StareUnknown(f"{of} drift", of, sd, hours) for of, sd in (drifts or {}).items()]
        for of, sd in (cycles or {}).items():
            unknowns += [StareUnknown(f"{of} sine", of, sd, sine), StareUnknown(f"{of} cosine", of, sd, cosine)]
        return cls(
            start, float(frame_s), temperature_c=temperature_c + warmth, unknowns=tuple(unknowns), pointing=pointing,
            light_jitter=spread.get("light", 0.0), sky_jitter=spread.get("sky", 0.0),
            temperature_jitter_c=spread.get("temperature", 0.0),
            **{name: 1.0 + over_frames(curve) for name, curve in changed.items()},
        )  # fmt: skip

    @property
    def jitters(self) -> dict[Changing, float]:
        """Standard deviations from frame to frame."""
        return {"light": self.light_jitter, "sky": self.sky_jitter, "temperature": self.temperature_jitter_c}

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self.start_s.size

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """Number of each frame from the start of the stare, counting gaps, shape (n_frame,)."""
        return np.rint(self.start_s / self.frame_s).astype(np.int64)

    @property
    def middle_s(self) -> Float:
        """Middle of each frame, s, shape (n_frame,)."""
        return np.asarray(self.start_s + self.frame_s / 2)

    @property
    def duration_s(self) -> float:
        """From 0 to the end of the last frame, s."""
        return float(self.start_s[-1] + self.frame_s)

    @property
    def observed_s(self) -> float:
        """Time in frames, s."""
        return self.n_frames * self.frame_s

    @cached_property
    def gtis(self) -> Float:
        """Good time intervals: start and end of each run of frames without a gap, s, shape (n, 2)."""
        breaks = np.flatnonzero(np.diff(self.numbers) > 1)
        first = np.concatenate([[0], breaks + 1])
        last = np.concatenate([breaks, [self.n_frames - 1]])
        return np.column_stack([self.start_s[first], self.start_s[last] + self.frame_s])

    def pointing_losses(self, numbers: NDArray[np.uint64], seed: int) -> Float:
        """Return the share of all light that the frames of some stares lose in drifts, shape (n_stare, n_frame)."""
        from mauvecl.noise.reference import pointing_losses

        if self.pointing is None:
            return np.zeros((len(numbers), self.n_frames))
        return pointing_losses(self.pointing, numbers, self.start_s, self.frame_s, seed)

    def dark_factor(self, quiet: Expectation) -> Float:
        """Return the factor on an expectation's dark current in each frame, shape (n_frame,)."""
        slope, at = quiet.conditions["dark_slope_per_c"], quiet.conditions["temperature_c"]
        return np.asarray(np.exp(slope * (self.temperature_c - at)))


def select_frames(stare: Stare, part: slice | NDArray[np.bool_]) -> Stare:
    """Return a stare with some of its frames."""
    unknowns = tuple(replace(unknown, curve=unknown.curve[part]) for unknown in stare.unknowns)
    return replace(stare, unknowns=unknowns, **{name: getattr(stare, name)[part] for name in PER_FRAME})


def _starts(duration_s: float, frame_s: float, gaps: Sequence[tuple[float, float]]) -> Float:
    """Return the starts of the frames of a stare that do not overlap a gap, s, shape (n_frame,)."""
    count = np.ceil(duration_s / frame_s * (1 - 1e-12))
    if count > MOST_FRAMES:
        raise InputError.of("duration_s", duration_s, f"at most {MOST_FRAMES} frames", unit="s")
    start: Float = np.arange(max(1, int(count)), dtype=np.float64) * frame_s
    # The tolerance keeps a frame that starts at the end of a gap.
    outside, tolerance = np.ones(start.size, np.bool_), 1e-9 * frame_s
    for first, last in gaps:
        if not (np.isfinite([first, last]).all() and first < last):
            raise InputError.of("gaps", (first, last), "two times, ascending", unit="s")
        outside &= (start + frame_s <= first + tolerance) | (start >= last - tolerance)
    if not outside.any():
        raise InputError.of("gaps", gaps, f"times that leave a frame of {duration_s:g} s")
    return start[outside]


def _check_spread(name: str, of: Changing, sd: float, least: float = 1e-300) -> None:
    """Raise InputError unless a standard deviation lies between `least` and the largest for positive levels."""
    most = 100.0 if of == "temperature" else LARGEST_SPREAD
    if not least <= sd <= most:
        unit = "deg C" if of == "temperature" else ""
        above = "0" if least == 0 else "above 0"
        raise InputError.of(name, sd, f"a standard deviation of {above} to {most:g} {unit}".rstrip())


#: Time before the first frame for which the detector temperature is computed, in its time constants.
SETTLING = 8.0
#: Time step before the first frame, s.
PAST_STEP_S = 30.0


@dataclass(frozen=True, eq=False)
class OrbitStare:
    """A stare along the orbit, with the conditions of its frames."""

    stare: Stare  # without the frames in which the target is not visible
    hits_per_cm2_s: Float  # cosmic rays and trapped protons, shape (n_frame,)
    in_shadow: NDArray[np.bool_]  # shape (n_frame,)
    start: str  # of the stare, ISO 8601, UTC
    messages: tuple[str, ...]  # about the orbit

    @property
    def mean_hits_per_cm2_s(self) -> float:
        """Mean over the frames, the rate for `CosmicRays`."""
        return float(self.hits_per_cm2_s.mean())


@validated
def stare_along(
    orbit: Orbit,
    target: Target | str,
    start: DateText,
    duration_s: Duration,
    *,
    frame_s: Duration = 5.0,
    limits: Limits | None = None,
    thermal: Thermal | None = None,
    particles: Particles | None = None,
    **unknowns: Any,
) -> OrbitStare:
    """Compute the stare at a target along an orbit.

    Parameters
    ----------
    orbit : Orbit
    target : Target or str
        A name of the embedded list, or coordinates.
    start : str
        ISO 8601, UTC; dates of Python, NumPy and pandas, and times of astropy, are converted.
    duration_s : float
        From the first frame, including times at which the target is not visible.
    frame_s : float
    limits : Limits, optional
        Conditions for the target to be visible.
    thermal : Thermal, optional
        Response of the detector temperature to sunlight and shadow; assumed by default.
    particles : Particles, optional
    **unknowns
        Arguments of `Stare.of`: variability, throughput, sky, jitters, offsets, drifts, cycles.

    Raises
    ------
    InputError
        If the target is never visible.
    """
    for name in ("gaps", "temperature_c"):
        if name in unknowns:
            raise InputError.of(name, unknowns[name], "none, since the orbit gives it")
    place = target if isinstance(target, Target) else Target.of(target)
    thermal, particles = thermal or Thermal(), particles or Particles()
    times = TimeGrid(start, duration_s / DAY_S, frame_s)
    track = orbit.track(times)
    visible = Visibility.of(track, place.direction[None], limits)
    is_visible = visible.seen[:, 0]
    if not is_visible.any():
        raise InputError(
            f"target {place.name!r} is never seen in {duration_s / HOUR_S:g} h from {times.iso(0.0)}; try another time "
            "or other limits",
            key="target",
        )
    # All but the temperature follow from a stare without gaps.
    continuous = Stare.of(times.n * frame_s, frame_s=frame_s, **unknowns)
    # The temperature is computed from several time constants before the first frame on, in the same kind of orbit.
    settling_s = SETTLING * thermal.time_constant_s
    past = TimeGrid(times.iso(-settling_s, 3), settling_s / DAY_S, PAST_STEP_S)
    before = Orbit(orbit.elements, orbit.resolved(times)).track(past)
    first = float(thermal.temperature_c(before.sunlight, PAST_STEP_S)[-1])
    temperature = thermal.temperature_c(track.sunlight, times.step_s, first)
    stare = select_frames(replace(continuous, temperature_c=temperature), is_visible)
    hits = particles.rate_per_cm2_s(track)[is_visible]
    return OrbitStare(stare, hits, visible.shadow[is_visible], times.iso(0.0), tuple(orbit.messages(times)))
