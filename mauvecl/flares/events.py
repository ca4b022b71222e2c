"""Flares of a stare, and the light that they add to its frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.flares.energies import EnergyScale, amplitude_of, amplitude_of_peak, equivalent_duration
from mauvecl.flares.settings import SAME_K, Cooling
from mauvecl.flares.shapes import SHAPES, Shape, shape_of
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Unit
from mauvecl.schema.physical import Amplitude, Duration, Energy, Moment, Temperature

Float = NDArray[np.float64]

#: Largest number of flare spectra of a stare (`frames.MOST_FLARES`), and the smallest for flares that cool.
MOST_TEMPERATURES, LEAST_STEPS = 8, 3
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
    >>> from mauvecl.flares.events import Event
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
        return cls(peak_s, half_width_s, amplitude_of_peak(peak, shape), temperature, shape)

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
        return cls.of_equivalent_duration(
            scale.equivalent_duration(energy_erg),
            peak_s=peak_s,
            half_width_s=half_width_s,
            temperature=temperature,
            shape=shape,
        )

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
        return equivalent_duration(self.amplitude, self.half_width_s, self.form)

    def energy(self, scale: EnergyScale) -> float:
        """Return the energy, erg."""
        return scale.energy(self.equivalent_duration_s)

    def total_energy(self, scale_of: Callable[[float], EnergyScale], nodes: Float | None = None) -> float:
        """Return the energy of a flare that may cool, erg.

        Frames interpolate the light of a flare that cools between the spectra of a few temperatures. The energy is that
        of the interpolated light, which is the light that is drawn.

        Parameters
        ----------
        scale_of : callable
            Returns the energy scale for a temperature in K.
        nodes : ndarray, shape (n_temperature,), optional
            Temperatures of the spectra: `temperatures_of` all flares of the stare; by default of this flare alone.
        """
        cooling = self.temperature
        if not isinstance(cooling, Cooling) or cooling.steady:
            return self.energy(scale_of(self.hottest_k))
        nodes = temperatures_of([self]) if nodes is None else nodes
        tau = np.concatenate([np.linspace(-10.0, 10.0, 2001), np.geomspace(10.0, 1000.0, 1001)[1:]])
        # Steps resolve the half-width and the cooling time; rounding removes duplicates that differ in their last bits.
        fold = np.linspace(0.0, 20.0, 2001) * cooling.fold_s / self.half_width_s
        edges = self.half_width_s * np.unique(np.concatenate([tau, fold[fold < 1000.0]]).round(6))
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
                f"flare {number}, which peaks at {event.peak_s:g} s, adds no light to the frames of the stare",
                f"light between {start_s[0]:g} and {start_s[-1] + frame_s:g} s and outside gaps",
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
        if isinstance(event.temperature, Cooling) and not event.temperature.steady:
            cooling.append(event.temperature)
        elif all(abs(event.hottest_k - other) >= SAME_K for other in constant):
            constant.append(event.hottest_k)
    left = MOST_TEMPERATURES - len(constant)
    if left < (LEAST_STEPS if cooling else 0):
        raise InputError(
            f"flares of {len(constant)} constant temperatures{' and some that cool' if cooling else ''}",
            f"at most {MOST_TEMPERATURES - (LEAST_STEPS if cooling else 0)}",
            key="events",
        )
    if cooling:
        low, high = min(c.end_k for c in cooling), max(c.peak_k for c in cooling)
        nodes = 1.0 / np.linspace(1.0 / low, 1.0 / high, left)
        constant += [float(k) for k in nodes if all(abs(k - other) >= SAME_K for other in constant)]
    return np.sort(np.array(constant))


def coefficients(events: Sequence[Event], start_s: Float, frame_s: float, temperatures_k: Float) -> Float:
    """Return the mean amplitude of each flare spectrum in each frame, shape (n_frame, n_temperature).

    Flares of constant temperature are integrated exactly. The light of a flare that cools is interpolated linearly in 1
    / T between the spectra of the two neighbouring temperatures, with a constant temperature in each step of a frame.
    Raises InputError if a flare has a temperature outside the range of `temperatures_k`, which are ascending and at
    least those of `temperatures_of`.
    """
    factors = np.zeros((start_s.size, temperatures_k.size))
    for event in events:
        if isinstance(event.temperature, Cooling) and not event.temperature.steady:
            _add_cooling(factors, event, event.temperature, start_s, frame_s, temperatures_k)
            continue
        edges = np.column_stack([start_s, start_s + frame_s])
        mean = event.amplitude * event.form.mean_over(edges, event.peak_s, event.half_width_s)
        for column, share in _node_weights(np.array([event.hottest_k]), temperatures_k):
            factors[:, column] += float(share[0]) * mean
    return factors


def _add_cooling(
    factors: Float, event: Event, cooling: Cooling, start_s: Float, frame_s: float, temperatures_k: Float
) -> None:
    shortest = min(frame_s, event.half_width_s, cooling.fold_s)
    parts = int(min(np.ceil(PARTS * frame_s / shortest), MOST_PARTS))
    for part in range(parts):
        start = start_s + part * frame_s / parts
        edges = np.column_stack([start, start + frame_s / parts])
        mean = event.amplitude / parts * event.form.mean_over(edges, event.peak_s, event.half_width_s)
        temperature = cooling.at(start + frame_s / parts / 2 - event.peak_s)
        for column, share in _node_weights(temperature, temperatures_k):
            factors[:, column] += share * mean


def _node_weights(temperature: Float, nodes: Float) -> list[tuple[int, Float]]:
    """Return the weights of the nodes for temperatures, linear in 1 / T, by index of the node."""
    if temperature.min() < nodes[0] - SAME_K or temperature.max() > nodes[-1] + SAME_K:
        raise InputError(
            f"a flare of {temperature.min():g} to {temperature.max():g} K",
            f"temperatures within {nodes[0]:g} to {nodes[-1]:g} K",
            key="temperature",
        )
    inverse = -1.0 / nodes
    place = np.interp(-1.0 / temperature, inverse, np.arange(nodes.size, dtype=np.float64))
    shares = [np.maximum(0.0, 1.0 - np.abs(place - column)) for column in range(nodes.size)]
    return [(column, share) for column, share in enumerate(shares) if share.any()]
