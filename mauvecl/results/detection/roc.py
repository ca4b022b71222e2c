"""Receiver operating characteristic (ROC) curves of simulated distributions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.schema.drawable import Drawable
from mauvecl.schema.tables import Column, table_of
from mauvecl.statistics.intervals import CONFIDENCE, Interval, clopper_pearson, clopper_pearson_ends

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.results.counts.tally import Distribution

Float = NDArray[np.float64]
#: Rows of a curve's table.
ROC_ROWS = 200
#: Columns of a curve's table.
COLUMNS = (
    Column("threshold", description="value at and above which a detection is claimed"),
    Column("fap", description="false-alarm probability per test, with a 95 % Clopper-Pearson interval"),
    Column("fap_low", description="95 % interval of the false-alarm probability, lower end"),
    Column("fap_high", description="95 % interval of the false-alarm probability, upper end"),
    Column("probability", description="detection probability, with a 95 % Clopper-Pearson interval"),
    Column("probability_low", description="95 % interval of the detection probability, lower end"),
    Column("probability_high", description="95 % interval of the detection probability, upper end"),
)
#: Columns of the area, in tables of several curves.
AREA_COLUMNS = (
    Column("area", "area.value", description="under the curve; 95 % interval by DeLong's method"),
    Column("area_low", "area.low", description="95 % interval of the area, lower end"),
    Column("area_high", "area.high", description="95 % interval of the area, upper end"),
)


@dataclass(frozen=True, eq=False)
class Roc(Drawable):
    """ROC curve from the lowest threshold to the highest, at edges of filled bins."""

    threshold: Float  # shape (n,)
    fap: Float  # false-alarm probability, shape (n,)
    probability: Float  # detection probability, shape (n,)
    realisations: int  # of the null, and of the flare
    area: Interval  # probability that a flare's value exceeds a null's, counting ties half

    @classmethod
    def of(cls, null: Distribution, flare: Distribution) -> Roc:
        """Compute the curve of two histograms on the same grid.

        The area's variance follows DeLong et al. (1988, doi 10.2307/2531595) for independent null and flare. Here they
        share their draws, so the interval is conservative. Without any overlap, its lower end is that of Clopper and
        Pearson for as many pairs as there are realisations.
        """
        # Union of the filled bins.
        bins = null.bins, flare.bins
        lower, first = np.unique(np.concatenate([bins[0][0], bins[1][0]]), return_index=True)
        upper = np.concatenate([bins[0][1], bins[1][1]])[first]
        share, above = np.zeros((2, lower.size)), np.zeros((2, lower.size + 1))
        for i, (d, (own, _, filled)) in enumerate(zip((null, flare), bins, strict=True)):
            counts = np.zeros(lower.size, np.int64)
            counts[np.searchsorted(lower, own)] = filled
            share[i] = counts / d.n
            # Integer counts above each edge make the ends of the curve exactly 1 and 0.
            above[i, :-1] = counts[::-1].cumsum()[::-1] / d.n
        beaten, beating = 1.0 - above[0, :-1] + 0.5 * share[0], above[1, :-1] - 0.5 * share[1]
        area = float(np.clip(share[1] @ beaten, 0.0, 1.0))
        spread = [float(c @ (values - area) ** 2) for c, values in ((share[1], beaten), (share[0], beating))]
        reach = float(special.ndtri(0.5 + CONFIDENCE / 2)) * float(np.sqrt(spread[0] / flare.n + spread[1] / null.n))
        low, high = max(area - reach, 0.0), min(area + reach, 1.0)
        if bins[0][0][-1] < bins[1][0][0] or bins[1][0][-1] < bins[0][0][0]:
            area = float(round(area))
            n = min(null.n, flare.n)
            sure = clopper_pearson(round(area) * n, n)
            low, high = sure.low, sure.high
        return cls(np.append(lower[0], upper), above[0], above[1], null.n, Interval(area, low, high))

    def plot(self, path: str | Path | None = None, *, name: str = "", ax: Any = None) -> Any:
        """Plot detection probability against false-alarm probability; needs matplotlib."""
        return self._draw(path, ax, name=name)

    def table(self, rows: int = ROC_ROWS) -> QTable:
        """Return at most `rows` rows of the curve, evenly spaced in the logarithm of the false-alarm probability.

        Both ends are included. Probabilities have Clopper-Pearson intervals; the metadata contain the area.
        """
        area = {column.name: column.value(self) for column in AREA_COLUMNS}
        return table_of(COLUMNS, [self.points(rows)], realisations=self.realisations, **area)

    def points(self, rows: int = ROC_ROWS) -> dict[str, Float]:
        """Return at most `rows` points of the curve with their intervals, by the names of `COLUMNS`."""
        n = self.realisations
        wanted = np.append(np.geomspace(1.0, 1.0 / n, max(rows - 1, 1)), 0.0)
        chosen = np.unique(np.minimum(np.searchsorted(-self.fap, -wanted), self.fap.size - 1))
        points = {"threshold": self.threshold[chosen]}
        for name, chance in (("fap", self.fap), ("probability", self.probability)):
            ends = clopper_pearson_ends(np.rint(chance[chosen] * n).astype(np.int64), n)
            points |= dict(zip((name, f"{name}_low", f"{name}_high"), ends, strict=True))
        return points
