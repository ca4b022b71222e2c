"""Templates of a search for flares: their bank, weights in wavelength, and study sections.

Weights reduce a frame to a few sums for flares of any temperature. The optimal weights for a flare with spectrum d are
C^-1 d, where C is the covariance of a frame including nuisance parameters (METHODS section 7). Spectra of flares of
6000-30 000 K are similar, so that two or three singular vectors of the whitened spectra suffice as a basis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Self

import numpy as np

from mauvecl.detection.nuisances import Nuisances
from mauvecl.fits.flare_model import spanning_weights
from mauvecl.flares import RANK, WINDOW_S
from mauvecl.host.arrays import Float, set_read_only
from mauvecl.noise.unknowns import CHANGED_PART
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.flares.shapes import Shape
    from mauvecl.flares.stare import Stare
    from mauvecl.host.exposure.expectation import Expectation


#: Shortest window before and after a peak, in half-widths of the template.
LEAD, TAIL = 5.0, 10.0
#: Half-widths before and after a peak beyond which the light of a flare is neglected.
REACH = (5.0, 80.0)
#: Smallest number of onsets per half-width.
ONSETS = 10
#: Half-width in frames below which two onsets per frame are searched.
SUB_FRAME = 6.0
#: Smallest share of a template's power outside gaps for which it is searched.
LEAST_SHARE = 0.25


@dataclass(frozen=True)
class Baseline:
    """Baseline under a flare: the terms that are marginalised over in each window."""

    offset: bool = True
    slope: bool = True
    cycle: bool = False  #: curves of unknown amplitude, such as the orbital thermal cycle
    window_s: float = WINDOW_S  #: of the smallest window; windows hold 5 half-widths before the peak and 10 after

    @property
    def powers(self) -> tuple[int, ...]:
        """Powers of time in the baseline."""
        return (*((0,) if self.offset else ()), *((1,) if self.slope else ()))


@dataclass(frozen=True, eq=False)
class Template:
    """Flare shapes of one half-width on a grid of frames."""

    half_width_s: float
    first: int  # first frame of the window relative to the frame of the peak
    phases: tuple[float, ...]  # positions of the peak within its frame, in frames
    shapes: Float  # mean flux per frame for a peak of 1, shape (n_phase, n)
    stride: int  # frames between onsets

    @cached_property
    def time(self) -> Float:
        """Time of each frame of the window, from -1 to 1 about its middle, shape (n,)."""
        n = self.shapes.shape[1]
        return np.asarray((np.arange(n) - (n - 1) / 2) / max((n - 1) / 2, 1.0))

    def detrended(self, phase: int, powers: tuple[int, ...]) -> Float:
        """Return a shape less its projection on powers of time, shape (n,)."""
        columns = np.array([self.time**power for power in powers]).reshape(len(powers), self.time.size).T
        level, *_ = np.linalg.lstsq(columns, self.shapes[phase])
        return np.asarray(self.shapes[phase] - columns @ level)


@dataclass(frozen=True, eq=False)
class Bank:
    """Template bank of a search."""

    half_widths_s: tuple[float, ...]  #: ascending
    #: Unit vectors of the change of a frame's sums for each temperature: rows of `Templates.directions`, or one row of
    #: ones for a single light curve; shape (n_temperature, n_sum).
    directions: Float
    shape: Shape
    frame_s: float
    baseline: Baseline = Baseline()

    def __post_init__(self) -> None:
        directions = np.atleast_2d(np.array(self.directions, np.float64))
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        if not (length > 0).all():
            raise InputError("every direction of the bank must change a sum of a frame", key="directions")
        set_read_only(self, directions=directions / length)

    @cached_property
    def templates(self) -> tuple[Template, ...]:
        """Templates of all half-widths, with two phases of narrow ones and one of others."""
        templates = []
        for width in self.half_widths_s:
            frames, (lead, tail) = width / self.frame_s, self.window(width)
            phases = (0.25, 0.75) if frames < SUB_FRAME else (0.5,)
            edges = np.arange(-lead, tail + 2) * self.frame_s
            shapes = np.array([self.shape.mean_over(edges, p * self.frame_s, width) for p in phases])
            templates.append(Template(width, -lead, phases, shapes, max(1, int(frames / ONSETS))))
        return tuple(templates)

    def window(self, half_width_s: float) -> tuple[int, int]:
        """Return the number of frames of the window before and after the peak."""
        half = self.baseline.window_s / 2
        lead, tail = (max(reach * half_width_s, half) / self.frame_s for reach in (LEAD, TAIL))
        return int(np.ceil(lead)), int(np.ceil(tail))


@lru_cache(maxsize=8)
def white_bank(half_widths_s: tuple[float, ...], shape: Shape, frame_s: float, baseline: Baseline = Baseline()) -> Bank:
    """Return the bank of a single light curve with white noise; the same one for the same arguments."""
    return Bank(half_widths_s, np.ones((1, 1)), shape, frame_s, baseline)


#: Default temperatures of templates, K, in steps of a factor of 1.034.
TEMPERATURES_K = tuple(float(t) for t in np.geomspace(6_000.0, 30_000.0, 49).round(-1))
#: Angle between neighbouring directions of a bank in the space of whitened sums. A flare halfway between them loses
#: 1 - cos(ANGLE / 2) = 0.3 % of its S/N.
ANGLE = 0.15
#: Smallest singular value relative to the largest; smaller ones are rounding errors.
MIN_SINGULAR = 1e-6


@dataclass(frozen=True, eq=False)
class Templates:
    """Weights of a frame's sums, and the effect of flares of unit amplitude on these sums."""

    temperatures_k: tuple[float, ...]  #: ascending
    #: Per DN; sums of a quiescent frame have unit covariance, including nuisance parameters; shape (n_sum, n_pixel).
    weights: Float
    directions: Float  #: mean sums, shape (n_temperature, n_sum)
    best: Float  #: S/N in a frame with optimal weights: the norm of `directions` without loss, shape (n_temperature,)
    noise: Float  #: covariance that photon noise of the flare adds to the sums, shape (n_temperature, n_sum, n_sum)

    @classmethod
    def of(
        cls,
        variance: Float,
        flares: Float,
        photon_variance: Float,
        temperatures_k: Sequence[float],
        *,
        nuisances: Nuisances | None = None,
        rank: int = RANK,
    ) -> Self:
        """Compute weights from the noise of a quiescent frame and flare spectra, all in one unit.

        `variance` and `flares`, (n_temperature, n_pixel), are zero in unused pixels; `photon_variance` is the
        rise of the variance with the flux. Flares have unit amplitude and ascending temperatures, in steps small enough
        for `chosen`. `nuisances` are independent in each frame, such as jitter; `rank` is the largest number of sums.
        """
        rows = nuisances.rows(variance, nuisances.spectra * (variance > 0)) if nuisances else None
        plain = np.divide(flares, variance, out=np.zeros_like(flares), where=variance > 0)
        weights, length = spanning_weights(flares, plain, nuisances, rows, MIN_SINGULAR**2)
        weights = weights[::-1][:rank]
        # Signs are arbitrary; choose them so that the hottest flare increases each sum.
        weights *= np.where(weights @ flares[-1] < 0, -1.0, 1.0)[:, None]
        photons = flares * photon_variance
        noise = np.einsum("kp,lp,tp->tkl", weights, weights, photons, optimize=True)
        return cls(tuple(temperatures_k), weights, flares @ weights.T, length, noise)

    def mixed(self, matrix: Float) -> Self:
        """Return the templates of linear combinations of the sums, with `matrix` of shape (n_sum, n_sum)."""
        return replace(
            self,
            weights=matrix @ self.weights,
            directions=self.directions @ matrix.T,
            noise=np.einsum("kl,tlm,nm->tkn", matrix, self.noise, matrix),
        )

    @cached_property
    def chosen(self) -> tuple[int, ...]:
        """Rows of `directions` for a bank, spaced by at most about `ANGLE`."""
        unit = self.directions / np.linalg.norm(self.directions, axis=1, keepdims=True)
        steps = np.arccos(np.clip(np.sum(unit[1:] * unit[:-1], axis=1), -1.0, 1.0))
        along = np.concatenate([[0.0], np.cumsum(steps)])
        # The outermost directions may be half a step from the ends.
        n = max(1, int(np.ceil(along[-1] / ANGLE)))
        angles = (np.arange(n) + 0.5) / n * along[-1]
        return tuple(dict.fromkeys(int(np.argmin(np.abs(along - angle))) for angle in angles))

    @property
    def coloured(self) -> bool:
        """True if the sums of a flare depend on its temperature by more than a factor."""
        return len(self.temperatures_k) > 1 and self.directions.shape[1] > 1

    @property
    def loss(self) -> Float:
        """Share of the S/N that is lost by reducing frames to sums, shape (n_temperature,)."""
        return np.asarray(1.0 - np.linalg.norm(self.directions, axis=1) / self.best)

    def nearest(self, kelvin: float) -> int:
        """Return the row of the temperature that is nearest to another one."""
        return int(np.argmin(np.abs(np.log(np.array(self.temperatures_k) / kelvin))))


def frame_nuisances(quiet: Expectation, stare: Stare, more: Mapping[str, float] | None = None) -> Nuisances | None:
    """Return the nuisance parameters of each frame: the stare's jitters, and `more`.

    Standard deviations by name in `more` replace jitters of the same kind; an infinite one is projected out.
    """
    jitters: dict[str, float] = {CHANGED_PART[of]: sd for of, sd in stare.jitters.items() if sd > 0}
    # Drifts and re-acquisitions change all light alike, by any amount and at any time.
    drifting = {} if stare.pointing is None else {"light": np.inf}
    spreads = jitters | drifting | dict(more or {}) | drifting
    return Nuisances.of(quiet, spreads) if spreads else None
