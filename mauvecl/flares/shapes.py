"""Published shapes of flares in time: the excess over the quiescent flux for unit amplitude.

Times are tau = (t - peak) / half_width. The half-width is the scale t_1/2 of each publication, which differs from the
full width at half maximum, `Shape.width`. Integrals are closed forms.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import scipy
from numpy.typing import ArrayLike

from mauvecl.flares import check_shape, integral_between_points
from mauvecl.host.arrays import Float, set_read_only
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError, shortened
from mauvecl.schema.fields import Duration


class TimeProfile(ABC):
    """Time profile that can be integrated, in units of amplitude and half-width."""

    @abstractmethod
    def before(self, tau: ArrayLike) -> Float:
        """Return the integral up to tau, in half-widths, shape of tau."""

    @abstractmethod
    def after(self, tau: ArrayLike) -> Float:
        """Return the integral from tau to the end, in half-widths, without cancellation; shape of tau."""

    @cached_property
    def equivalent_duration(self) -> float:
        """Total integral, in half-widths."""
        return float(self.before(0.0) + self.after(0.0))


@validated
class Shape(TimeProfile):
    """Time profile of a flare."""

    #: Name in studies and flags, and publication.
    name: str
    source: str

    def __repr__(self) -> str:
        """Return the same text in every process, since requests are identified by it."""
        return f"{type(self).__name__}()"

    @abstractmethod
    def at(self, tau: ArrayLike) -> Float:
        """Return the value, shape of tau."""

    @property
    def peak_at(self) -> float:
        """Position of the maximum, tau: zero unless a shape has another."""
        return 0.0

    @property
    @abstractmethod
    def square_integral(self) -> float:
        """Integral of the square, in half-widths; the S/N of a matched filter is proportional to its root."""

    @cached_property
    def peak(self) -> float:
        """Maximum; it differs from one if the publication defines the amplitude differently."""
        return float(self.at(self.peak_at))

    @cached_property
    def width(self) -> float:
        """Full width at half maximum, in half-widths."""
        ends = []
        for reach in (1.0, -1.0):
            while float(self.at(self.peak_at + reach)) > self.peak / 2:
                reach *= 2
            low, high = sorted((self.peak_at, self.peak_at + reach))
            ends.append(scipy.optimize.brentq(lambda t: float(self.at(t)) - self.peak / 2, low, high, xtol=1e-13))
        return float(ends[0] - ends[1])

    def integral(self, first: ArrayLike, last: ArrayLike) -> Float:
        """Return the integral between two values of tau, elementwise, in half-widths."""
        return between(sides(self, first), sides(self, last))

    def mean_over(self, edges_s: ArrayLike, peak_s: ArrayLike, t_half_s: ArrayLike) -> Float:
        """Return the exact mean over each frame, shape (n_frame,), or (n, n_frame) for peaks of the shape (n, 1).

        Edges are those of consecutive frames, (n_frame + 1,), or start and end of each frame, (n_frame, 2). The peak is
        the time at which tau is 0.
        """
        edges, peak, scale = (np.asarray(values, np.float64) for values in (edges_s, peak_s, t_half_s))
        if edges.ndim == 2:
            integrals = self.integral((edges[:, 0] - peak) / scale, (edges[:, 1] - peak) / scale)
        else:
            integrals = consecutive_integrals(self, (edges - peak) / scale)
        lengths = np.diff(edges).reshape(-1)
        return np.asarray(integrals * scale / lengths)


def sides(shape: TimeProfile, tau: ArrayLike) -> Float:
    """Return the integrals up to min(tau, 0) and from max(tau, 0), in half-widths, shape (2, *tau.shape).

    `between` subtracts them. Differences of integrals from one end only would cancel on the other side of the peak.
    """
    t = np.asarray(tau, np.float64)
    return np.stack([shape.before(np.minimum(t, 0.0)), shape.after(np.maximum(t, 0.0))])


def between(first: Float, last: Float) -> Float:
    """Return the integrals of a shape between two values of tau from `sides` at both."""
    # Shapes are not negative; differences of equal integrals may be, by rounding.
    return np.asarray(np.maximum(last[0] - first[0] + (first[1] - last[1]), 0.0))


def consecutive_integrals(shape: TimeProfile, tau: ArrayLike) -> Float:
    """Return the integrals between consecutive values of tau along the last axis, in half-widths."""
    integrals = sides(shape, tau)
    return between(integrals[..., :-1], integrals[..., 1:])


class Davenport2014(Shape):
    """A polynomial rise within one half-width, followed by two exponentials.

    Davenport et al. 2014, ApJ 797, 122 (doi 10.1088/0004-637X/797/2/122). The published form has a step of
    0.005 at its start and one of -0.008 at its peak.
    """

    name = "davenport2014"
    source = "Davenport et al. 2014, doi 10.1088/0004-637X/797/2/122"
    RISE: ClassVar = np.polynomial.Polynomial([1.0, 1.94053, -0.175084, -2.24588, -1.12498])
    #: Integral of the rise.
    RISEN: ClassVar = RISE.integ(lbnd=-1)
    WHOLE_RISE: ClassVar = float(RISEN(0.0))
    DECAY: ClassVar = ((0.689008, 1.60053), (0.302963, 0.278318))

    def at(self, tau: ArrayLike) -> Float:
        t = np.asarray(tau, np.float64)
        values = np.zeros(t.shape)
        rising, late = (t > -1) & (t <= 0), t > 0
        values[rising] = self.RISE(t[rising])
        values[late] = sum(a * np.exp(-b * t[late]) for a, b in self.DECAY)
        return values

    def before(self, tau: ArrayLike) -> Float:
        t = np.asarray(tau, np.float64)
        late = np.maximum(t, 0.0)
        decayed = sum(-a / b * np.expm1(-b * late) for a, b in self.DECAY) if late.any() else 0.0
        return np.asarray(self._risen(t) + decayed)

    def after(self, tau: ArrayLike) -> Float:
        t = np.asarray(tau, np.float64)
        late = np.maximum(t, 0.0)
        rise = self.WHOLE_RISE - self._risen(t) if (t < 0).any() else 0.0
        return np.asarray(rise + sum(a / b * np.exp(-b * late) for a, b in self.DECAY))

    def _risen(self, t: Float) -> Float:
        """Return the integral of the rise by Horner's rule, which dominates the time of a search."""
        clipped, (*rest, last) = np.clip(t, -1.0, 0.0), self.RISEN.coef.astype(np.float64)
        total = np.asarray(last)
        for coefficient in reversed(rest):
            total = coefficient + total * clipped
        return np.asarray(total)

    @cached_property
    def square_integral(self) -> float:
        rise = (self.RISE**2).integ(lbnd=-1)(0.0)
        return float(rise + sum(a * c / (b + d) for a, b in self.DECAY for c, d in self.DECAY))


class TovarMendoza2022(Shape):
    """A Gaussian convolved with two exponentials, which is smooth; its amplitude is not its maximum.

    Tovar Mendoza et al. 2022, AJ 164, 17 (doi 10.3847/1538-3881/ac6fe6). Since g' = Gaussian - D g, the integral is
    a closed form.
    """

    name = "tovarmendoza2022"
    source = "Tovar Mendoza et al. 2022, doi 10.3847/1538-3881/ac6fe6"
    A, B, C = 0.9687734504375167, -0.251299705922117, 0.22675974948468916
    #: Weight and rate of each exponential.
    DECAY: ClassVar = ((0.12695865022878844, 0.15551880775110513), (1 - 0.12695865022878844, 1.2150539528490194))
    #: Height of the Gaussian, which includes the factor exp((B / C)^2) of the publication.
    HEIGHT = A * float(np.exp((B / C) ** 2))

    def _part(self, tau: Float, rate: float) -> Float:
        """Return the convolution with one exponential, by the scaled erfcx where the plain product would overflow."""
        z = (self.B - tau) / self.C
        u = z + self.C * rate / 2
        early = np.exp(-(z**2)) * scipy.special.erfcx(np.maximum(u, 0.0))
        exponent = rate * (self.B - tau) + (rate * self.C / 2) ** 2
        late = np.exp(np.where(u > 0, 0.0, exponent)) * scipy.special.erfc(np.minimum(u, 0.0))
        return np.asarray(np.sqrt(np.pi) / 2 * self.HEIGHT * self.C * np.where(u > 0, early, late))

    def _gaussian(self, z: Float) -> Float:
        """Return the integral of the Gaussian beyond z widths."""
        return np.asarray(np.sqrt(np.pi) / 2 * self.HEIGHT * self.C * scipy.special.erfc(z))

    def at(self, tau: ArrayLike) -> Float:
        t = np.asarray(tau, np.float64)
        return np.asarray(sum(share * self._part(t, rate) for share, rate in self.DECAY))

    def before(self, tau: ArrayLike) -> Float:
        t = np.asarray(tau, np.float64)
        z = (self.B - t) / self.C
        # Far before the peak, erfc underflows before its product does: the scaled erfcx decreases, so that the
        # difference is at least zero.
        far = np.maximum(z, 0.0)
        scale = np.sqrt(np.pi) / 2 * self.HEIGHT * self.C * np.exp(-(far**2))

        def risen(rate: float) -> Float:
            early = scale * (scipy.special.erfcx(far) - scipy.special.erfcx(far + self.C * rate / 2))
            return np.where(z > 0, early, self._gaussian(z) - self._part(t, rate))

        return np.asarray(sum(share / rate * risen(rate) for share, rate in self.DECAY))

    def after(self, tau: ArrayLike) -> Float:
        t = np.asarray(tau, np.float64)
        rest = self._gaussian((t - self.B) / self.C)
        return np.asarray(sum(share / rate * (rest + self._part(t, rate)) for share, rate in self.DECAY))

    @cached_property
    def peak_at(self) -> float:
        def slope(tau: float) -> float:
            gaussian = self.HEIGHT * np.exp(-(((tau - self.B) / self.C) ** 2))
            return float(sum(s * (gaussian - rate * self._part(np.asarray(tau), rate)) for s, rate in self.DECAY))

        return float(scipy.optimize.brentq(slope, -0.5, 0.5, xtol=1e-15))

    @cached_property
    def square_integral(self) -> float:
        # Correlation of the Gaussian with itself times that of two exponentials, over all lags.
        def lags(rate: float) -> Any:
            return self.C * np.sqrt(np.pi / 2) * scipy.special.erfcx(rate * self.C / np.sqrt(2))

        gaussian = self.HEIGHT**2 * self.C * np.sqrt(np.pi / 2)
        pairs = [(f * g, c, d) for f, c in self.DECAY for g, d in self.DECAY]
        return float(sum(share * gaussian * (lags(c) + lags(d)) / (c + d) for share, c, d in pairs))


class Fiducial(Shape):
    """The fiducial flare of the MUSCLES survey: a boxcar with 2/3 of the fluence and an exponential with 1/3.

    Loyd et al. 2018, ApJ 867, 71 (doi 10.3847/1538-4357/aae2bd). It rises at tau = 0, and its half-width is its full
    width at half maximum. `Fiducial.of` relates height and length to the equivalent duration.
    """

    name = "fiducial"
    source = "Loyd et al. 2018, doi 10.3847/1538-4357/aae2bd"
    #: Lengths of boxcar and exponential, in half-widths.
    BOX = 1 / (1 + float(np.log(2)) / 2)
    FOLD = BOX / 2

    @classmethod
    @validated
    def of(cls, equivalent_duration_s: Duration) -> tuple[float, float]:
        """Return amplitude, 0.3 (delta/s)^0.6, and half-width (s) for an equivalent duration delta."""
        height = 0.3 * equivalent_duration_s**0.6
        return height, equivalent_duration_s / 1.5 / height / cls.BOX

    def at(self, tau: ArrayLike) -> Float:
        t = np.asarray(tau, np.float64)
        return np.asarray(np.where(t < 0, 0.0, np.exp(-np.maximum(t - self.BOX, 0.0) / self.FOLD)))

    def before(self, tau: ArrayLike) -> Float:
        t = np.asarray(tau, np.float64)
        late = np.maximum(t - self.BOX, 0.0)
        return np.asarray(np.clip(t, 0.0, self.BOX) - self.FOLD * np.expm1(-late / self.FOLD))

    def after(self, tau: ArrayLike) -> Float:
        t = np.asarray(tau, np.float64)
        late = np.maximum(t - self.BOX, 0.0)
        return np.asarray(self.BOX - np.clip(t, 0.0, self.BOX) + self.FOLD * np.exp(-late / self.FOLD))

    @property
    def square_integral(self) -> float:
        return self.BOX + self.FOLD / 2


@validated
@dataclass(frozen=True, eq=False)
class TableShape(Shape):
    """User-defined shape, linear between its points and zero outside them.

    Attributes
    ----------
    tau : ndarray, shape (n,)
        Ascending; in half-widths, or in seconds for a half-width of 1 s.
    values : ndarray, shape (n,)
        Not negative; scaled to a maximum of 1.
    name, source : str
    """

    tau: Float
    values: Float
    name: str = "table"
    source: str = "user-defined table"

    def __post_init__(self) -> None:
        tau, values = np.array(self.tau, np.float64), np.array(self.values, np.float64)
        name = f"the flare shape {shortened(self.name)}"
        if tau.ndim != 1 or tau.shape != values.shape or tau.size < 2:
            raise InputError.of("values", values.size, f"one for each of {tau.size} times, at least 2", where=name)
        if not (np.isfinite(tau).all() and (np.diff(tau) > 0).all()):
            raise InputError(f"the times of {name} must be finite and ascend", key="tau")
        if not (np.isfinite(values).all() and values.min() >= 0 and values.max() > 0):
            raise InputError(
                f"the values of {name} must be finite and at least 0, and some above 0, but range from "
                f"{values.min():g} to {values.max():g}",
                key="values",
            )
        set_read_only(self, tau=tau, values=values / values.max())

    def at(self, tau: ArrayLike) -> Float:
        return np.asarray(np.interp(np.asarray(tau, np.float64), self.tau, self.values, left=0.0, right=0.0))

    def before(self, tau: ArrayLike) -> Float:
        return integral_between_points(self.tau, self.values, np.asarray(tau, np.float64))

    def after(self, tau: ArrayLike) -> Float:
        mirrored = TableShape(-self.tau[::-1], self.values[::-1])
        return mirrored.before(-np.asarray(tau, np.float64))

    @cached_property
    def peak_at(self) -> float:
        return float(self.tau[int(np.argmax(self.values))])

    @cached_property
    def square_integral(self) -> float:
        a, b = self.values[:-1], self.values[1:]
        return float(np.sum(np.diff(self.tau) * (a * a + a * b + b * b) / 3))

    @cached_property
    def width(self) -> float:
        # Several peaks may exceed half of the maximum.
        a, b = self.values[:-1] - 0.5, self.values[1:] - 0.5
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(a * b < 0, np.maximum(a, b) / np.abs(b - a), (a + b >= 0) & (np.minimum(a, b) >= 0))
        return float(np.sum(np.diff(self.tau) * share))


#: Published shapes by name.
SHAPES: dict[str, Shape] = {shape.name: shape for shape in (Davenport2014(), TovarMendoza2022(), Fiducial())}


def shape_of(given: Shape | str) -> Shape:
    """Return a shape by name; a `Shape` is returned unchanged."""
    return given if isinstance(given, Shape) else SHAPES[check_shape(given)]
