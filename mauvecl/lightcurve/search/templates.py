"""Spectral weights that reduce a frame to a few sums for flares of any temperature.

The optimal weights for a flare with spectrum d are C^-1 d, where C is the covariance of a frame including nuisance
parameters (METHODS section 7). Spectra of flares of 6000-30 000 K are similar, so that two or three singular vectors of
the whitened spectra suffice as a basis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.defaults import RANK
from mauvecl.results.measurements.reduction import MeanSums
from mauvecl.schema.errors import InputError
from mauvecl.statistics.nuisances import Nuisances, join_names

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.lightcurve.stares.stare import Stare

Float = NDArray[np.float64]

#: Default temperatures of templates, K, in steps of a factor of 1.034.
TEMPERATURES_K = tuple(float(t) for t in np.geomspace(6_000.0, 30_000.0, 49).round(-1))
#: Angle between neighbouring directions of a bank in the space of whitened sums. A flare halfway between them loses
#: 1 - cos(ANGLE / 2) = 0.3 % of its S/N.
ANGLE = 0.15
#: Smallest singular value relative to the largest; smaller ones are rounding errors.
MIN_SINGULAR = 1e-6


@dataclass(frozen=True, eq=False)
class Templates:
    """Weights of a frame's sums, and the effect of flares on these sums.

    Attributes
    ----------
    temperatures_k : tuple of float
        Flare temperatures, ascending.
    weights : ndarray, shape (n_sum, n_pixel)
        Weights per DN, for which sums of a quiescent frame have unit covariance, including nuisance parameters.
    directions : ndarray, shape (n_temperature, n_sum)
        Mean sums for a flare of unit amplitude.
    best : ndarray, shape (n_temperature,)
        S/N of that flare in one frame with its optimal weights: the norm of `directions` without loss.
    noise : ndarray, shape (n_temperature, n_sum, n_sum)
        Covariance that the photon noise of a flare of unit amplitude adds to the sums.
    """

    temperatures_k: tuple[float, ...]
    weights: Float
    directions: Float
    best: Float
    noise: Float

    @classmethod
    def of(
        cls,
        quiet: Expectation,
        flares_dn: Float,
        temperatures_k: Sequence[float],
        *,
        nuisances: Nuisances | None = None,
        rank: int = RANK,
    ) -> Self:
        """Compute weights from one frame of the quiescent star and flare spectra.

        Parameters
        ----------
        quiet : Expectation
            One frame.
        flares_dn : ndarray, shape (n_temperature, n_pixel)
            Mean DN per frame of flares of unit amplitude.
        temperatures_k : sequence of float
            Temperatures of these flares, ascending, in steps small enough for `chosen`.
        nuisances : Nuisances, optional
            Nuisance parameters that are independent in each frame, such as jitter.
        rank : int
            Largest number of sums.
        """
        used = ~quiet.saturated
        if not used.any():
            raise InputError.of("quiet", quiet.name, "a star that does not saturate every pixel")
        variance = np.where(used, quiet.variance_dn2, 0.0)
        return cls.of_spectra(
            variance, flares_dn * used, quiet.gain_dn_per_electron, temperatures_k, nuisances=nuisances, rank=rank
        )

    @classmethod
    def of_spectra(
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

        Parameters
        ----------
        variance : ndarray, shape (n_pixel,)
            Variance of a quiescent frame; zero in pixels that are not used.
        flares : ndarray, shape (n_temperature, n_pixel)
            Flares of unit amplitude; zero in pixels that are not used.
        photon_variance : ndarray, shape (n_pixel,)
            Rise of the variance with the flux.
        temperatures_k, nuisances, rank
            As for `of`.
        """
        used = variance > 0
        plain = np.divide(flares, variance, out=np.zeros_like(flares), where=used)
        optimal = plain
        if nuisances:
            rows = nuisances.rows(variance, nuisances.spectra * used)
            optimal = plain - (flares @ rows.T) @ rows
        gram = optimal @ flares.T
        power = np.diag(gram)
        if not (power > 1e-10 * np.einsum("tp,tp->t", plain, flares)).all():
            names = join_names(nuisances.names) if nuisances else "nothing"
            raise InputError(
                f"a flare cannot be distinguished from {names} in one frame",
                "fewer nuisance parameters",
                key="nuisances",
                value=names,
            )
        length = np.sqrt(power)
        values, vectors = np.linalg.eigh(gram / np.outer(length, length))
        kept = [k for k in range(len(values))[::-1][:rank] if values[k] > MIN_SINGULAR**2 * values[-1]]
        weights = (vectors[:, kept] / length[:, None] / np.sqrt(values[kept])).T @ optimal
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
        wanted = (np.arange(n) + 0.5) / n * along[-1]
        return tuple(dict.fromkeys(int(np.argmin(np.abs(along - w))) for w in wanted))

    @property
    def coloured(self) -> bool:
        """True if the sums of a flare depend on its temperature by more than a factor."""
        return len(self.temperatures_k) > 1 and self.directions.shape[1] > 1

    @cached_property
    def mean_sums(self) -> MeanSums:
        """Mean sums of a flare of unit amplitude over log temperature."""
        log_k, values = np.log(self.temperatures_k), self.directions
        if log_k.size == 1:
            # The same at any temperature.
            log_k, values = log_k + np.array([-1.0, 1.0]), np.tile(values, (2, 1))
        return MeanSums(values, np.zeros((0, values.shape[1])), log_k)

    @property
    def loss(self) -> Float:
        """Share of the S/N that is lost by reducing frames to sums, shape (n_temperature,)."""
        return np.asarray(1.0 - np.linalg.norm(self.directions, axis=1) / self.best)

    def noise_of(self, kelvin: float) -> Float:
        """Return the covariance added by the photon noise of a flare of the nearest temperature, (n_sum, n_sum)."""
        return np.asarray(self.noise[int(np.argmin(np.abs(np.log(np.array(self.temperatures_k) / kelvin))))])

    def of_flares(self, flares_dn: Float) -> Float:
        """Return the mean sums, (n, n_sum), for flare spectra in DN, (n, n_pixel)."""
        return np.asarray(flares_dn @ self.weights.T)


def frame_nuisances(
    quiet: Expectation, stare: Stare, more: Mapping[str, float] | Nuisances | None = None
) -> Nuisances | None:
    """Return the nuisance parameters of each frame: the stare's jitters, and additional ones.

    Parameters
    ----------
    quiet : Expectation
        One frame.
    more : mapping of str to float, or Nuisances, optional
        Standard deviations by name, which replace jitters of the same kind; an infinite one is projected out.
    """
    names = {"light": "light", "sky": "sky", "temperature": "dark"}
    jitters = {names[of]: sd for of, sd in stare.jitters.items() if sd > 0}
    # Drifts and re-acquisitions change all light alike, by any amount and at any time.
    drifting = {} if stare.pointing is None else {"light": np.inf}
    jitters |= drifting
    if isinstance(more, Nuisances):
        mine = Nuisances.of(quiet, {name: sd for name, sd in jitters.items() if name not in more.names})
        return replace(
            more,
            names=(*more.names, *mine.names),
            spectra=np.vstack([more.spectra, mine.spectra]),
            sd=np.concatenate([more.sd, mine.sd]),
        )
    spreads = jitters | dict(more or {}) | drifting
    return Nuisances.of(quiet, spreads) if spreads else None
