"""Spectral weights of a frame: flares of any temperature told from noise and from what is unknown, in a few sums.

The weights of a flare with the spectrum d are C^-1 d, C the covariance of a frame with what is unknown of it (METHODS
section 7). Flares of 6000-30 000 K look much alike, so that an orthonormal basis of their weights with two or three
rows is enough: the singular vectors of the whitened spectra.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.lightcurve.usual import RANK
from mauvecl.statistics.nuisances import Nuisances, join_names

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.lightcurve.stares.stare import Stare

Float = NDArray[np.float64]

#: Temperatures that a search looks for unless told, K: from the first to the last, a factor of 1.034 apart.
TEMPERATURES_K = tuple(float(t) for t in np.geomspace(6_000.0, 30_000.0, 49).round(-1))
#: Angle between neighbouring flares of a bank, in the space of whitened sums: the one between them loses 1 - cos of
#: half of it, 0.3 % of S/N.
ANGLE = 0.15
#: Share of the largest singular value below which a direction holds nothing but rounding.
LEAST_SINGULAR = 1e-6


@dataclass(frozen=True, eq=False)
class Templates:
    """Weights of a frame's sums, and what flares do to these sums.

    Attributes
    ----------
    temperatures_k : tuple of float
        Of flares, K, ascending.
    weights : ndarray, shape (n_sum, n_pixel)
        Per DN. The sums of a quiescent frame have covariance one, what is unknown of a single frame included.
    directions : ndarray, shape (n_temperature, n_sum)
        Mean sums for a flare of one amplitude.
    best : ndarray, shape (n_temperature,)
        S/N of that flare in one frame with weights of its own: what `directions` would be as long as without loss.
    noise : ndarray, shape (n_temperature, n_sum, n_sum)
        Covariance that the photons of a flare of one amplitude add to the sums of a frame.
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
        """From one frame of the quiescent star, and the spectra of flares.

        Parameters
        ----------
        quiet : Expectation
            One frame.
        flares_dn : ndarray, shape (n_temperature, n_pixel)
            Mean DN per frame of flares of one amplitude.
        temperatures_k : sequence of float
            Of these flares, ascending; close enough for `chosen` to choose among.
        nuisances : Nuisances, optional
            What is unknown of each frame apart from all others, such as jitter.
        rank : int
            Sums kept, at most.

        Raises
        ------
        InputError
            If every pixel saturates, or a flare cannot be told from what is unknown.
        """
        used = ~quiet.saturated
        if not used.any():
            raise InputError(f"every pixel of {quiet.name} saturates, expected some that do not")
        variance, flares = np.where(used, quiet.variance_dn2, 0.0), flares_dn * used
        plain = np.divide(flares, variance, out=np.zeros_like(flares), where=used)
        optimal = plain
        if nuisances:
            rows = nuisances.rows(variance, nuisances.spectra * used)
            optimal = plain - (flares @ rows.T) @ rows
        gram = optimal @ flares.T
        power = np.diag(gram)
        if not (power > 1e-10 * np.einsum("tp,tp->t", plain, flares)).all():
            names = join_names(nuisances.names) if nuisances else "nothing"
            raise InputError(f"a flare cannot be told from {names} in one frame, expected fewer unknowns of frames")
        length = np.sqrt(power)
        values, vectors = np.linalg.eigh(gram / np.outer(length, length))
        kept = [k for k in range(len(values))[::-1][:rank] if values[k] > LEAST_SINGULAR**2 * values[-1]]
        weights = (vectors[:, kept] / length[:, None] / np.sqrt(values[kept])).T @ optimal
        # Signs are free: the hottest flare adds to each sum.
        weights *= np.where(weights @ flares[-1] < 0, -1.0, 1.0)[:, None]
        photons = flares * quiet.gain_dn_per_electron
        noise = np.einsum("kp,lp,tp->tkl", weights, weights, photons, optimize=True)
        return cls(tuple(temperatures_k), weights, flares @ weights.T, length, noise)

    @cached_property
    def chosen(self) -> tuple[int, ...]:
        """Flares that a bank looks for, as rows of `directions`: neighbours are `ANGLE` apart at most, about."""
        unit = self.directions / np.linalg.norm(self.directions, axis=1, keepdims=True)
        steps = np.arccos(np.clip(np.sum(unit[1:] * unit[:-1], axis=1), -1.0, 1.0))
        along = np.concatenate([[0.0], np.cumsum(steps)])
        # The outermost may be half of a step from the ends.
        n = max(1, int(np.ceil(along[-1] / ANGLE)))
        wanted = (np.arange(n) + 0.5) / n * along[-1]
        return tuple(dict.fromkeys(int(np.argmin(np.abs(along - w))) for w in wanted))

    @property
    def loss(self) -> Float:
        """Share of S/N lost to the few sums, shape (n_temperature,)."""
        return np.asarray(1.0 - np.linalg.norm(self.directions, axis=1) / self.best)

    def noise_of(self, kelvin: float) -> Float:
        """Return what the photons of a flare add to the covariance, by the nearest temperature, (n_sum, n_sum)."""
        return np.asarray(self.noise[int(np.argmin(np.abs(np.log(np.array(self.temperatures_k) / kelvin))))])

    def of_flares(self, flares_dn: Float) -> Float:
        """Mean sums for flares of other temperatures, shape (n, n_sum), from their spectra, DN, (n, n_pixel)."""
        return np.asarray(flares_dn @ self.weights.T)


def frame_nuisances(
    quiet: Expectation, stare: Stare, more: Mapping[str, float] | Nuisances | None = None
) -> Nuisances | None:
    """What is unknown of each frame: the stare's jitters, and what is named beside them.

    Parameters
    ----------
    quiet : Expectation
        One frame.
    stare : Stare
    more : mapping of str to float, or Nuisances, optional
        Standard deviations by name (infinite: projected out), which take the place of jitters of the same kind.
    """
    names = {"light": "light", "sky": "sky", "temperature": "dark"}
    jitters = {names[of]: sd for of, sd in stare.jitters.items() if sd > 0}
    if isinstance(more, Nuisances):
        mine = Nuisances.of(quiet, {name: sd for name, sd in jitters.items() if name not in more.names})
        return replace(
            more,
            names=(*more.names, *mine.names),
            spectra=np.vstack([more.spectra, mine.spectra]),
            sd=np.concatenate([more.sd, mine.sd]),
        )
    spreads = jitters | dict(more or {})
    return Nuisances.of(quiet, spreads) if spreads else None
