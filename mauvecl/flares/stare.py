"""Stares: times, known conditions and unknown changes of the frames of a long observation, and their sections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.flares.settings import ORBIT_S, Curve, Sinusoid
from mauvecl.host.arrays import set_read_only
from mauvecl.host.orbit.geometry import TimeGrid, sunlight
from mauvecl.host.orbit.observing_limits import Limits
from mauvecl.host.orbit.orbit import Orbit, Target, Track
from mauvecl.host.orbit.visibility import Particles, Thermal, Visibility
from mauvecl.noise.disturbances import PointingDrifts
from mauvecl.noise.unknowns import CHANGING, STARE_CHANGES, Changing
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Unit
from mauvecl.schema.physical import DAY_S, Duration, Moment

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation

Float = NDArray[np.float64]
#: Largest number of frames of a stare, twenty years of 5 s.
MOST_FRAMES = 2**27
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
        if self.of not in CHANGING:
            raise InputError.of("of", self.of, f"one of {', '.join(CHANGING)}")
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
        own = {name: getattr(self, name) for name in ("start_s", "star", "light", "sky", "temperature_c")}
        set_read_only(self, **own)
        n = self.start_s.size
        if not 1 <= n <= MOST_FRAMES:
            raise InputError.of("n_frames", n, f"1 to {MOST_FRAMES}")
        curves = [(unknown.name, unknown.curve) for unknown in self.unknowns]
        for name, values in [*((name, getattr(self, name)) for name in own), *curves]:
            if values.shape != (n,):
                raise InputError(f"{name} of the stare has the shape {values.shape}", f"({n},)", key=name)
            if not np.isfinite(values).all():
                raise InputError(
                    f"{name} of frame {int(np.argmin(np.isfinite(values)))} is not finite", "finite numbers", key=name
                )
        off = np.abs(self.start_s / self.frame_s - self.numbers)
        if not (off < 1e-6).all() or self.numbers[0] < 0 or not (np.diff(self.numbers) > 0).all():
            raise InputError(
                f"the frames of a stare start at {self.start_s[0]:g} ... {self.start_s[-1]:g} s",
                f"ascending multiples of {self.frame_s:g} s from 0",
                key="start_s",
            )
        for name, values in (("star", self.star), ("light", self.light), ("sky", self.sky)):
            if not (values >= 0).all():
                k = int(np.argmin(values >= 0))
                raise InputError(f"the factor on the {name} of frame {k} = {values[k]:g}", "at least 0", key=name)
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
        count = np.ceil(duration_s / frame_s * (1 - 1e-12))
        if count > MOST_FRAMES:
            raise InputError.of("duration_s", duration_s, f"at most {MOST_FRAMES} frames", unit="s")
        start: Float = np.arange(max(1, int(count)), dtype=np.float64) * float(frame_s)
        start = start[_frames_outside_gaps(gaps, start, float(frame_s))]
        if not start.size:
            raise InputError.of("gaps", gaps, f"gaps that leave a frame of {duration_s:g} s")

        def over_frames(curve: Curve | None) -> Float:
            return np.zeros(start.size) if curve is None else curve.mean_over(start, float(frame_s), orbit_s)

        spread = dict(jitters or {})
        components = STARE_CHANGES["jitters"]
        other = next((name for name in spread if name not in components), None)
        if other is not None:
            raise InputError.of("jitters", other, f"one of {', '.join(components)}")
        return cls(
            start,
            float(frame_s),
            1.0 + over_frames(variability),
            1.0 + over_frames(throughput),
            1.0 + over_frames(sky),
            temperature_c + over_frames(Sinusoid(thermal) if isinstance(thermal, int | float) else thermal),
            spread.get("light", 0.0),
            spread.get("sky", 0.0),
            spread.get("temperature", 0.0),
            _unknowns(start, float(frame_s), orbit_s, offsets or {}, drifts or {}, cycles or {}),
            pointing,
        )

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
        """Return the share of all light that frames of stares lose in drifts, shape (n_stare, n_frame).

        Parameters
        ----------
        numbers : ndarray, shape (n_stare,)
            Numbers of the stares.
        seed : int
        """
        if self.pointing is None:
            return np.zeros((len(numbers), self.n_frames))
        return self.pointing.losses(numbers, self.start_s, self.frame_s, seed)

    def dark_factor(self, quiet: Expectation) -> Float:
        """Return the factor on an expectation's dark current in each frame, shape (n_frame,)."""
        slope, at = quiet.conditions["dark_slope_per_c"], quiet.conditions["temperature_c"]
        return np.asarray(np.exp(slope * (self.temperature_c - at)))


def select_frames(stare: Stare, part: slice | NDArray[np.bool_]) -> Stare:
    """Return a stare with some of its frames."""
    names = ("start_s", "star", "light", "sky", "temperature_c")
    unknowns = tuple(replace(unknown, curve=unknown.curve[part]) for unknown in stare.unknowns)
    return replace(stare, unknowns=unknowns, **{name: getattr(stare, name)[part] for name in names})


def _frames_outside_gaps(gaps: Sequence[tuple[float, float]], start: Float, frame_s: float) -> NDArray[np.bool_]:
    """Return which frames do not overlap a gap."""
    # The tolerance keeps a frame that starts at the end of a gap.
    outside, tolerance = np.ones(start.size, np.bool_), 1e-9 * frame_s
    for first, last in gaps:
        if not (np.isfinite([first, last]).all() and first < last):
            raise InputError.of("gaps", (first, last), "two times, ascending", unit="s")
        outside &= (start + frame_s <= first + tolerance) | (start >= last - tolerance)
    return outside


def _unknowns(
    start: Float,
    frame_s: float,
    orbit_s: float,
    offsets: Mapping[Changing, float],
    drifts: Mapping[Changing, float],
    cycles: Mapping[Changing, float],
) -> tuple[StareUnknown, ...]:
    middle = (start[0] + start[-1] + frame_s) / 2
    hours = (start + frame_s / 2 - middle) / HOUR_S
    sine, cosine = (Sinusoid(1.0, orbit_s, phase).mean_over(start, frame_s) for phase in (0.0, np.pi / 2))
    unknowns = [StareUnknown(f"{of} offset", of, sd, np.ones(start.size)) for of, sd in offsets.items()]
    unknowns += [StareUnknown(f"{of} drift", of, sd, hours) for of, sd in drifts.items()]
    for of, sd in cycles.items():
        unknowns += [StareUnknown(f"{of} sine", of, sd, sine), StareUnknown(f"{of} cosine", of, sd, cosine)]
    return tuple(unknowns)


def _check_spread(name: str, of: Changing, sd: float, least: float = 1e-300) -> None:
    most = 100.0 if of == "temperature" else LARGEST_SPREAD
    if not least <= sd <= most:
        unit = STARE_CHANGES["offsets"][of].unit
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
    start: str,
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
        ISO 8601, UTC.
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
    for name in ("gaps", "temperature_c", "thermal"):
        if name in unknowns:
            raise InputError.of(name, unknowns[name], "none, since the orbit gives it")
    if not (np.isfinite(duration_s) and 0 < duration_s <= MOST_FRAMES * frame_s):
        raise InputError.of("duration_s", duration_s, "a time above 0", unit="s")
    place = target if isinstance(target, Target) else Target.of(target)
    thermal, particles = thermal or Thermal(), particles or Particles()
    count = int(np.ceil(duration_s / frame_s * (1 - 1e-12)))
    times = TimeGrid(start, count * frame_s / DAY_S, frame_s)
    track = orbit.track(times)
    visible = Visibility.of(track, place.direction[None], limits)
    seen = visible.seen[:, 0]
    if not seen.any():
        raise InputError(
            f"target {place.name!r} is never seen in {duration_s / 3600:g} h from {times.iso(0.0)}",
            "another time or other limits",
            key="target",
        )
    # All but the temperature follow from a stare without gaps.
    whole = Stare.of(count * frame_s, frame_s=frame_s, **unknowns)
    temperature = _temperature(orbit, track, thermal)
    stare = select_frames(replace(whole, temperature_c=temperature), seen)
    hits = particles.rate_per_cm2_s(track)[seen]
    return OrbitStare(stare, hits, visible.shadow[seen], times.iso(0.0), tuple(orbit.messages(times)))


def _temperature(orbit: Orbit, track: Track, thermal: Thermal) -> Float:
    """Return the detector temperature at each step, deg C, computed from several time constants before the first."""
    times = track.times
    past = TimeGrid(
        times.iso(-SETTLING * thermal.time_constant_s, 3),
        SETTLING * thermal.time_constant_s / DAY_S,
        PAST_STEP_S,
    )
    # The same kind of orbit as that of the plan.
    before = Orbit(orbit.elements, orbit.resolved(times)).track(past)
    first = float(thermal.temperature_c(_light(before), PAST_STEP_S)[-1])
    return thermal.temperature_c(_light(track), times.step_s, first)


def _light(track: Track) -> Float:
    return sunlight(track.position_km, track.bodies.sun, track.bodies.sun_km)
