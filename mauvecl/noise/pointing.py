"""Drifts of the target out of the fibre, ended by re-acquisitions: a process of stares."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar

from mauvecl.schema.calls import validated
from mauvecl.schema.fields import Help, Range, Unit, Widget
from mauvecl.schema.physical import Duration
from mauvecl.schema.section import Section

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Float = NDArray[np.float64]

#: Drifts that are drawn at a time, per stare.
BATCH = 16


@validated
class PointingDrifts(Section):
    """Drifts out of the fibre during a stare, each ended by a re-acquisition; all values are assumptions.

    The target is in place at the start of a stare. The time until a drift begins and the duration of the drift are
    exponentially distributed. In a drift, the lost share of all light (of star, flare, neighbours and sky) rises
    linearly from zero. The target is then acquired again, and the light returns at once.
    """

    stream: ClassVar[int] = 20
    label: ClassVar[str] = "pointing drifts"
    #: For messages and tables of assumptions.
    source: ClassVar[str] = "assumption: rate, depth and duration of drifts are not published"

    # Drifts per hour of good pointing.
    rate_per_h: Annotated[
        float,
        Unit("1 / h"),
        Range(0, 3600, open_low=True),
        Help("Drifts per hour of good pointing", "an assumption"),
        Widget(
            label="Pointing losses",
            hint="Drifts of the star out of the fibre, each ended by a new acquisition, per hour of good pointing. "
            "Nothing: none. How often they happen is not published.",
            group="Pointing",
            name="pointing_rate",
            first="",
            unit="per hour",
            most=60.0,
        ),
    ] = 0.5
    # Mean duration of a drift.
    duration_s: Annotated[
        Duration,
        Help("Mean duration of a drift", "exponential; an assumption"),
        Widget(
            label="Duration of a loss",
            hint="Mean time from the start of a drift to the new acquisition; an assumption.",
            group="Pointing",
            place=1,
            name="pointing_duration",
        ),
    ] = 300.0
    # Largest share of the light lost at the end of a drift; the shares are uniform between zero and this.
    depth: Annotated[
        float,
        Range(0, 1, open_low=True),
        Help("Largest share of the light lost at the end of a drift", "uniform from 0; an assumption"),
        Widget(
            label="Depth of a loss",
            hint="Largest share of the light that is lost at the end of a drift; an assumption.",
            group="Pointing",
            place=2,
            name="pointing_depth",
            unit="%",
            scale=100.0,
        ),
    ] = 0.5

    def drifts(self, numbers: NDArray[np.uint64], end_s: float, seed: int) -> tuple[Float, Float, Float]:
        """Draw the drifts of stares up to a time.

        Parameters
        ----------
        numbers : ndarray, shape (n_stare,)
            Numbers of the stares; each depends only on the seed and its number.

        Returns
        -------
        start_s, duration_s, depth : ndarray, shape (n_stare, n_drift)
            In order of time; the last drift of each stare begins at `end_s` or later.
        """
        import numpy as np

        from mauvecl.noise.random_numbers import four_normals, words

        parts: list[tuple[Float, Float, Float]] = []
        begin = np.zeros((len(numbers), 1))
        index, n = np.asarray(numbers, np.uint64)[:, None], 0
        while not parts or not (parts[-1][0][:, -1] >= end_s).all():
            which = np.arange(n, n + BATCH)[None]
            # Half the sum of two squared normals is exponential, and has the same bits on every machine.
            a, b, c, d = (z.astype(np.float64) for z in four_normals(words(index, which, self.stream, 0, seed)))
            wait, lasts = (a * a + b * b) / 2 * (3600.0 / self.rate_per_h), (c * c + d * d) / 2 * self.duration_s
            share = (words(index, which, self.stream, 1, seed)[0].astype(np.float64) + 0.5) / 2**32
            ends = begin + np.cumsum(wait + lasts, axis=1)
            parts.append((ends - lasts, lasts, share * self.depth))
            begin, n = ends[:, -1:], n + BATCH
        start, lasts, depth = (np.concatenate(several, axis=1) for several in zip(*parts, strict=True))
        return start, lasts, depth

    def losses(self, numbers: NDArray[np.uint64], start_s: Float, frame_s: float, seed: int) -> Float:
        """Draw the mean share of the light that each frame loses, shape (n_stare, n_frame).

        Parameters
        ----------
        numbers : ndarray, shape (n_stare,)
        start_s : ndarray, shape (n_frame,)
            Start of the frames after the start of the stare.
        """
        import numpy as np

        start, lasts, depth = self.drifts(numbers, float(start_s[-1]) + frame_s, seed)
        # Light lost up to the start of each drift, in seconds.
        before = np.cumsum(depth * lasts / 2, axis=1) - depth * lasts / 2
        rows = zip(start, lasts, depth, before, strict=True)
        lost = np.array([_lost_until(start_s + frame_s, *row) - _lost_until(start_s, *row) for row in rows])
        return np.clip(lost / frame_s, 0.0, 1.0)


def _lost_until(times_s: Float, start_s: Float, duration_s: Float, depth: Float, before_s: Float) -> Float:
    """Return the integral of the lost share of the light up to some times, s."""
    import numpy as np

    k = np.searchsorted(start_s, times_s, side="right") - 1
    since = np.clip(times_s - start_s[k], 0.0, duration_s[k])
    until = before_s[k] + depth[k] * since * (since / np.maximum(duration_s[k], 1e-300)) / 2
    return np.asarray(np.where(k < 0, 0.0, until))
