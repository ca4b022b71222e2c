"""Frames of stares, drawn and reduced to a few weighted sums each."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.lightcurve.components import Components
from mauvecl.lightcurve.stare import Stare

Method = Literal["pixels", "cumulants"]


class Stares:
    """Draws stares; for now in NumPy, from means and covariances alone.

    Parameters
    ----------
    device : str, optional
        As `Engine` takes it.
    """

    def __init__(self, device: str | None = None) -> None:
        self._device = device

    def frames(
        self,
        components: Components,
        stare: Stare,
        flare: NDArray[np.float64] | None = None,
        *,
        first: int = 0,
        count: int = 1,
        seed: int,
        method: Method = "pixels",
        amplitudes: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float32]:
        """Statistics of each frame of stares `first` to `first + count - 1`.

        Parameters
        ----------
        components : Components
        stare : Stare
        flare : ndarray, shape (n_frame, n_flare) or (count, n_frame, n_flare), optional
            Amplitude of each flare spectrum in each frame, of all stares alike or of each.
        first, count : int
            Numbers of stares: what they hold follows from seed and number alone.
        seed : int
            0 to 2**64 - 1.
        method : {"pixels", "cumulants"}
            Every pixel drawn, or the sums at once from their cumulants.
        amplitudes : ndarray, shape (n_scenario, count) or (n_scenario, 1), optional
            Factors on `flare`: as many scenarios on common draws.

        Returns
        -------
        ndarray of float32, shape (count, n_frame, n_statistic)
            With `amplitudes` one axis more in front, (n_scenario, ...).
        """
        if method != "cumulants":
            raise InputError(f"method = {method!r}, expected 'cumulants'")
        shape = (stare.n_frames, components.n_flares)
        given = np.zeros((1, *shape)) if flare is None else np.asarray(flare, np.float64).reshape(-1, *shape)
        factors = np.ones((1, 1)) if amplitudes is None else np.asarray(amplitudes, np.float64)
        known = components.coefficients(stare)
        slope = components.quiet.conditions["dark_slope_per_c"]
        rows = []
        for i in range(count):
            rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, first + i]))
            moved = {
                of: stare.jitters.get(of, 0.0) * rng.standard_normal(stare.n_frames)
                for of in ("light", "sky", "temperature")
            }
            moved["star"] = np.zeros(stare.n_frames)
            for unknown in stare.unknowns:
                moved[unknown.of] = moved[unknown.of] + unknown.sd * rng.standard_normal() * unknown.curve
            z = rng.standard_normal((stare.n_frames, components.n_statistics))
            for row in factors:
                c = known.copy()
                c[:, 3:] = stare.light[:, None] * row[i % len(row)] * given[i % len(given)]
                c[:, 0] *= 1.0 + moved["star"]
                c[:, 1] *= 1.0 + moved["sky"]
                c[:, [0, 1, *range(3, c.shape[1])]] *= 1.0 + moved["light"][:, None]
                c[:, 2] *= np.exp(slope * moved["temperature"])
                low = np.linalg.cholesky(components.covariance(c))
                rows.append(components.means(c) + np.einsum("tkl,tl->tk", low, z))
        found = np.array(rows, np.float32).reshape(count, len(factors), stare.n_frames, components.n_statistics)
        found = np.moveaxis(found, 1, 0)
        return found[0] if amplitudes is None else found
