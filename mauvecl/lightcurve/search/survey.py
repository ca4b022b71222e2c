"""Survey of a star: its stare, frame components and search, shared by false alarms, injections and single stares."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.search.search import Search
from mauvecl.lightcurve.search.trend import Trend
from mauvecl.lightcurve.stares.stare_requests import StaresRequest
from mauvecl.lightcurve.stares.sum_cumulants import method_for
from mauvecl.noise.processes import NONE, Processes
from mauvecl.schema.physical import DAY_S

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.bank import Bank
    from mauvecl.lightcurve.stares.frame_components import Components
    from mauvecl.lightcurve.stares.stare import Stare
    from mauvecl.noise.unknowns import Changing

Float = NDArray[np.float64]

#: Relative norm of a curve's residual below which it is a linear combination of others.
MIN_CURVE = 1e-6


@dataclass(frozen=True, eq=False)
class Survey:
    """Stare at a star and its search."""

    components: Components  # with the weights of `Templates`
    stare: Stare
    bank: Bank

    @cached_property
    def coefficients(self) -> Float:
        """Known coefficients of each frame's components without a flare, shape (n_frame, 4 + n_flare)."""
        return self.components.coefficients(self.stare)

    @cached_property
    def known(self) -> Float:
        """Known mean of each frame's sums without a flare, which the observer subtracts, shape (n_frame, n_sum)."""
        return self.components.means(self.coefficients)

    @cached_property
    def directions(self) -> dict[Changing, Float]:
        """Derivatives of the mean sums by star, light, sky and temperature, shape (n_frame, n_sum) each."""
        directions: dict[Any, Float] = self.components.directions(self.coefficients)
        return directions

    def covariance(self) -> Float:
        """Return the covariance of each frame's sums without a flare, shape (n_frame, n_sum, n_sum)."""
        covariance = self.components.covariance(self.coefficients)
        for of, sd in self.stare.jitters.items():
            moved = sd * self.directions[of]
            covariance = covariance + moved[:, :, None] * moved[:, None, :]
        return covariance

    @cached_property
    def variance(self) -> Float:
        """Variance of each frame's sums that the search assumes, averaged over sums, shape (n_frame,)."""
        covariance = self.covariance()
        return np.asarray(np.einsum("tkk->t", covariance) / covariance.shape[1])

    @cached_property
    def curves(self) -> Float | None:
        """Curves of the stare's unknowns that are not straight lines, shape (n_curve, n_frame)."""
        if not self.bank.baseline.cycle:
            return None
        every = [unknown.curve for unknown in self.stare.unknowns]
        # Residual of each curve after a fit of a straight line and the previous curves.
        basis = np.linalg.qr(np.vander(self.stare.start_s / max(self.stare.duration_s, 1.0), 2))[0]
        curves: list[Float] = []
        for curve in every:
            left = curve - basis @ (basis.T @ curve)
            size = float(np.linalg.norm(left))
            if size > MIN_CURVE * float(np.linalg.norm(curve)):
                curves.append(left)
                basis = np.column_stack([basis, left / size])
        return np.array(curves).reshape(len(curves), self.stare.n_frames)

    @cached_property
    def search(self) -> Search:
        """Search of the stare's frames."""
        return Search(self.bank, self.stare, self.curves, self.variance)

    @cached_property
    def unknowns(self) -> Trend | None:
        """Effect of the stare's unknowns, or None without unknowns."""
        slope = self.components.quiet.conditions["dark_slope_per_c"]
        return Trend.of_unknowns(
            self.stare.unknowns, self.directions, self.variance, self.stare.numbers, self.stare.frame_s, slope
        )

    @property
    def trend(self) -> Trend | None:
        """Effect of the stare's unknowns if it is significant beyond first order, else None."""
        return self.unknowns if self.unknowns is not None and self.unknowns.is_nonlinear else None

    def unsubtracted(self, amplitudes: Float) -> Float:
        """Return the effect of unknowns on the sums that is not subtracted before the search.

        The shape is (n_stare, n_frame, n_sum).

        Parameters
        ----------
        amplitudes : ndarray, shape (n_stare, n_unknown)
            In standard deviations.
        """
        if self.unknowns is None:
            return np.zeros((len(amplitudes), self.stare.n_frames, self.components.n_statistics))
        moved = self.unknowns.effect(amplitudes)
        return moved if self.trend is None else self.trend.subtracted(moved)

    def net(self, sums: NDArray[Any]) -> NDArray[np.float32]:
        """Subtract from simulated sums their known mean and the fitted trend, shape (n_stare, n_frame, n_sum)."""
        return subtract_known(sums, self.known, self.trend)

    def largest_value_request(self, count: int, seed: int, processes: Processes = NONE) -> StaresRequest:
        """Return the request for the largest values of stares without a flare."""
        largest = Largest(self.bank, self.stare, self.curves, self.variance, self.known, self.trend)
        method = method_for(self.components, self.stare, processes)
        return StaresRequest(
            self.components, self.stare, count, seed, method=method, processes=processes, reduction=largest
        )

    def of_days(self, days: float) -> Survey:
        """Return the survey of at most the first `days` star-days of the stare."""
        n = int(days * DAY_S / self.stare.frame_s)
        return self if self.stare.n_frames <= n else replace(self, stare=select_frames(self.stare, slice(0, n)))


@dataclass(frozen=True, eq=False)
class Largest:
    """Reduction of simulated stares to their largest values."""

    adds: ClassVar[bool] = False

    bank: Bank
    stare: Stare
    curves: Float | None
    variance: Float
    known: Float
    trend: Trend | None = None

    @cached_property
    def search(self) -> Search:
        """Search of the stare's frames."""
        return Search(self.bank, self.stare, self.curves, self.variance)

    def __call__(self, values: NDArray[np.float32], first: int) -> dict[str, NDArray[Any]]:
        """Return the largest values as ``maximum``, shape (n_stare,)."""
        return {"maximum": self.search.largest(subtract_known(values, self.known, self.trend)).maximum}


def subtract_known(sums: NDArray[Any], known: NDArray[Any], trend: Trend | None) -> NDArray[np.float32]:
    """Subtract from simulated sums, (n_stare, n_frame, n_sum), their known mean and, if given, the fitted trend."""
    left = sums - known
    return np.asarray(left if trend is None else trend.subtracted(left), np.float32)


def select_frames(stare: Stare, part: slice | NDArray[np.bool_]) -> Stare:
    """Return a stare with some of the frames."""
    names = ("start_s", "star", "light", "sky", "temperature_c")
    unknowns = tuple(replace(unknown, curve=unknown.curve[part]) for unknown in stare.unknowns)
    return replace(stare, unknowns=unknowns, **{name: getattr(stare, name)[part] for name in names})
