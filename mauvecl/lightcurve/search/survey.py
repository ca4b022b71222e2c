"""A stare, what its frames are made of, and how it is searched: what null, injections and one stare's search share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.search.null import DAY_S
from mauvecl.lightcurve.search.sampled import Sampled, sampled
from mauvecl.lightcurve.search.scatter import Scatter
from mauvecl.lightcurve.search.search import Search
from mauvecl.lightcurve.search.trend import Trend
from mauvecl.lightcurve.stares.requests import StaresRequest
from mauvecl.lightcurve.stares.sums import method_for

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.bank import Bank
    from mauvecl.lightcurve.stares.components import Components
    from mauvecl.lightcurve.stares.stare import Stare
    from mauvecl.lightcurve.usual import Changing
    from mauvecl.noise.processes import CosmicRays

Float = NDArray[np.float64]

#: Share of a curve below which it is the others' sum.
LEAST_CURVE = 1e-6
#: Star-days of a stare that importance sampling looks at, at most.
SAMPLED_DAYS = 2.0


@dataclass(frozen=True, eq=False)
class Survey:
    """How a star is stared at and searched.

    Attributes
    ----------
    components : Components
        With the weights of `Templates`.
    stare : Stare
    bank : Bank
    """

    components: Components
    stare: Stare
    bank: Bank

    @cached_property
    def coefficients(self) -> Float:
        """Known strengths of a frame's components without a flare, shape (n_frame, 3 + n_flare)."""
        return self.components.coefficients(self.stare)

    @cached_property
    def known(self) -> Float:
        """Known mean of each frame's sums without a flare, which the observer subtracts, shape (n_frame, n_sum)."""
        return self.components.means(self.coefficients)

    @cached_property
    def directions(self) -> dict[Changing, Float]:
        """What a small change of the star's level, of light, sky or temperature does, each (n_frame, n_sum)."""
        directions: dict[Any, Float] = self.components.directions(self.coefficients)
        return directions

    def covariance(self, *, jittered: tuple[Changing, ...] = ("light", "sky", "temperature")) -> Float:
        """Of each frame's sums without a flare, some of the stare's jitters included, (n_frame, n_sum, n_sum)."""
        covariance = self.components.covariance(self.coefficients)
        for of in jittered:
            moved = self.stare.jitters[of] * self.directions[of]
            covariance = covariance + moved[:, :, None] * moved[:, None, :]
        return covariance

    @cached_property
    def variance(self) -> Float:
        """Of each frame's sums, averaged over them, as the search takes it, shape (n_frame,)."""
        covariance = self.covariance()
        return np.asarray(np.einsum("tkk->t", covariance) / covariance.shape[1])

    @cached_property
    def curves(self) -> Float | None:
        """Curves of unknown amplitude, shape (n_curve, n_frame): of the stare's unknowns that are no straight line."""
        if not self.bank.level.cycle:
            return None
        every = [unknown.curve for unknown in self.stare.unknowns]
        # What is left of each beside a straight line and those before it.
        basis = np.linalg.qr(np.vander(self.stare.start_s / max(self.stare.duration_s, 1.0), 2))[0]
        curves: list[Float] = []
        for curve in every:
            left = curve - basis @ (basis.T @ curve)
            size = float(np.linalg.norm(left))
            if size > LEAST_CURVE * float(np.linalg.norm(curve)):
                curves.append(left)
                basis = np.column_stack([basis, left / size])
        return np.array(curves).reshape(len(curves), self.stare.n_frames)

    @cached_property
    def search(self) -> Search:
        """The bank on the stare's frames."""
        return Search(self.bank, self.stare, self.curves, self.variance)

    @cached_property
    def unknowns(self) -> Trend | None:
        """What the stare's unknowns do; None where there are none."""
        slope = self.components.quiet.conditions["dark_slope_per_c"]
        return Trend.of_unknowns(
            self.stare.unknowns, self.directions, self.variance, self.stare.numbers, self.stare.frame_s, slope
        )

    @property
    def trend(self) -> Trend | None:
        """What the stare's unknowns do, where they do something to be seen beyond first order."""
        return self.unknowns if self.unknowns is not None and self.unknowns.bends else None

    def left(self, amplitudes: Float) -> Float:
        """Return what unknowns do to the sums that is not subtracted before the search, (n_stare, n_frame, n_sum).

        Parameters
        ----------
        amplitudes : ndarray, shape (n_stare, n_unknown)
            In standard deviations.
        """
        if self.unknowns is None:
            return np.zeros((len(amplitudes), self.stare.n_frames, self.components.n_statistics))
        moved = self.unknowns.moved(amplitudes)
        return moved if self.trend is None else self.trend.subtracted(moved)

    def net(self, sums: NDArray[Any]) -> NDArray[np.float32]:
        """Sums as drawn, (n_stare, n_frame, n_sum), less what is known and what unknowns do beyond first order."""
        return net_of(sums, self.known, self.trend)

    def null(self, count: int, seed: int, cosmic_rays: CosmicRays | None = None) -> StaresRequest:
        """Stares without a flare, and the largest value of each."""
        largest = Largest(self.bank, self.stare, self.curves, self.variance, self.known, self.trend)
        method = method_for(self.components, self.stare, cosmic_rays)
        return StaresRequest(
            self.components, self.stare, count, seed, method=method, cosmic_rays=cosmic_rays, reduction=largest
        )

    def tail(self, seed: int) -> Sampled:
        """The null by importance sampling, under what is unknown of the stare."""
        part = self.of_days(SAMPLED_DAYS)
        return sampled(part.search, seed=seed).under(Scatter.of(self, seed, part))

    def of_days(self, days: float) -> Survey:
        """The same with the first star-days of the stare alone, where it is longer."""
        n = int(days * DAY_S / self.stare.frame_s)
        return self if self.stare.n_frames <= n else replace(self, stare=part_of(self.stare, slice(0, n)))


@dataclass(frozen=True, eq=False)
class Largest:
    """The largest value of each stare that is drawn."""

    adds: ClassVar[bool] = False

    bank: Bank
    stare: Stare
    curves: Float | None
    variance: Float
    known: Float
    trend: Trend | None = None

    @cached_property
    def search(self) -> Search:
        """The bank on the stare's frames."""
        return Search(self.bank, self.stare, self.curves, self.variance)

    def __call__(self, values: NDArray[np.float32], first: int) -> dict[str, NDArray[Any]]:
        """As ``maximum``, shape (n_stare,)."""
        return {"maximum": self.search.largest(net_of(values, self.known, self.trend)).maximum}


def net_of(sums: NDArray[Any], known: NDArray[Any], trend: Trend | None) -> NDArray[np.float32]:
    """Return sums as drawn, (n_stare, n_frame, n_sum), less what is known and what unknowns do beyond first order."""
    left = sums - known
    return np.asarray(left if trend is None else trend.subtracted(left), np.float32)


def part_of(stare: Stare, part: slice) -> Stare:
    """Some frames of a stare, with their own times."""
    names = ("start_s", "star", "light", "sky", "temperature_c")
    unknowns = tuple(replace(unknown, curve=unknown.curve[part]) for unknown in stare.unknowns)
    return replace(stare, unknowns=unknowns, **{name: getattr(stare, name)[part] for name in names})
