"""Errors of the usual root-of-N formula over magnitude and exposure.

The formula promises three things: the S/N of a spectrum, that the true signal lies within one estimated standard
deviation of the observed one in 68.27 % of all spectra, and the false-alarm probability of a threshold.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import special

from mauvecl.answers.answer import Answer, TableOf
from mauvecl.answers.detect import DetectAnswer, detect
from mauvecl.answers.signal import SnrAnswer, snr
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.detection.counts import steps_of
from mauvecl.device.engine import Engine
from mauvecl.host.arrays import Float
from mauvecl.noise.drawing import Cumulants
from mauvecl.schema.columns import Column, number, table_of
from mauvecl.schema.errors import counted
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.detection.snr import SnrResult
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.runs.pool import Pool

#: Significance of reported differences, and width of a 95 % interval, in standard errors.
SURE, ERRORS_IN_INTERVAL = 4, 3.92
#: Smallest ratio of false-alarm probabilities that is distinguished.
SMALLEST_RATIO = 1e-3
ELEMENT_COLUMNS = (
    Column("wavelength", unit="nm", description="vacuum wavelength, the middle of the pixel or element"),
    Column("expected", description="S/N by the formula"),
    Column("mean", description="mean S/N of the realisations"),
    Column("std", description="standard deviation of the S/N of the realisations"),
    Column("error", description="standard error of the mean"),
    Column("bias", description="mean over expected S/N, less one"),
    Column("coverage", description="share of 1-sigma intervals of its pixels that hold the truth; 0.6827 promised"),
)
#: Columns of the largest error of each prediction.
WORST_COLUMNS = (
    Column("best_snr", "", "", "largest S/N per element by the formula", "best S/N", ".2f", detail=True),
    Column("snr_off_by", "", "", "largest significant (4 standard errors) difference of the mean S/N from it; 0 if "
           "none", "S/N off by", "+.3f"),
    Column("at_nm", description="where", heading="at nm", format=number(".0f"), detail=True),
    Column("coverage_low", description="smallest share of 1-sigma intervals that hold the truth, of all elements",
           heading="1-sigma intervals", format=lambda low, high: f"{100 * low:.2f}-{100 * high:.2f} %",
           others=("coverage_high",), detail=True),
    Column("coverage_high", description="largest"),
    Column("five_sigma_above", description="how often a pixel lies 5 sigma above its mean, over the normal 2.9e-7; "
           "the most", heading="5 sigma above, below", format=lambda above, below: f"{above:.2f}, {below:.2f}",
           others=("five_sigma_below",), detail=True),
    Column("five_sigma_below",
           description="how often a pixel lies 5 sigma below its mean, over the normal 2.9e-7; the least"),
    Column("fap_ratio", description="most wrong false-alarm probability over the promised one; 1 if none differs, NaN "
           "if they are too rare to be counted", heading="false alarms", format=number(".3f")),
    Column("statistic", description="detection statistic", heading="statistic", detail=True),
    Column("why", description="main cause of a difference from the closed form", heading="why", detail=True),
    Column("probability_off_by", "", "", "largest significant difference of a detection probability from the closed "
           "form", "detection off by", "+.4f"),
)  # fmt: skip


def coverage(result: SnrResult) -> Float:
    """Return the coverage of intervals of one estimated standard deviation about the observed signal, for each pixel.

    The standard deviation is estimated from the observed photons and the known dark and read noise. Values are
    interpolated within the bins of the histogram of counts, 1/64 of a standard deviation or less.
    """
    observers = result.observers[: result.scene.n_pixel]
    signal = result.expectation.light_dn
    gain, variance = observers["gain"].astype(float), observers["variance"].astype(float)
    # Ends of the observed signals whose interval reaches the true one: net -+ sqrt(gain max(net, 0) + known) = signal.
    root = np.sqrt(gain**2 / 4 + gain * signal + variance)
    high = signal + gain / 2 + root
    low = signal + gain / 2 - root
    low = np.where(low < 0, signal - np.sqrt(variance), low)
    width = 2.0 ** observers["bin_shift"].astype(float)
    shares = np.empty(signal.size)
    for p in range(signal.size):
        filled, counts = result.counts.bins["pixel"].in_row(p)
        edges = width[p] * np.column_stack([filled, filled + 1]).ravel() - 0.5
        edges += float(observers["net_offset"][p])
        ends = np.interp([low[p], high[p]], edges, steps_of(counts) / result.counts.n)
        shares[p] = ends[1] - ends[0]
    return shares


def beyond(x: Expectation, sigmas: float) -> Float:
    """Return the probability that a pixel is more than `sigmas` standard deviations above or (negative) below its mean.

    By the saddle point (Lugannani & Rice 1980, doi 10.2307/1426607) of Gaussian and Poisson parts together; right to
    3e-3 of the probability. For normal noise it would be the same in every pixel.
    """
    c = Cumulants.of(x, x.n_frames)
    photons = np.where(c.photon_step > 0, c.photons, 0.0)
    steps = ((c.photon_step, photons), (c.dark_step, c.dark_dn / c.dark_step))

    def cumulants(u: Float) -> tuple[Float, ...]:
        """Return the cumulant generating function of the deviation and its first two derivatives at u."""
        value, first, second = c.gaussian * u**2 / 2, c.gaussian * u, c.gaussian.copy()
        for step, mean in steps:
            value = value + mean * (np.expm1(step * u) - step * u)
            first = first + mean * step * np.expm1(step * u)
            second = second + mean * step**2 * np.exp(step * u)
        return value, first, second

    sd = np.sqrt(c.variance)
    goal, u = sigmas * sd, sigmas / sd
    for _ in range(50):
        _, first, second = cumulants(u)
        u = u - (first - goal) / second
    value, _, second = cumulants(u)
    w, v = np.sqrt(2 * (u * goal - value)), np.abs(u) * np.sqrt(second)
    return np.asarray(special.ndtr(-w) + np.exp(-(w**2) / 2) / np.sqrt(2 * np.pi) * (1 / v - 1 / w))


def _promises(result: SnrResult) -> QTable:
    """Return S/N and intervals of the formula and of the simulation, one row per resolution element."""
    table, x = result.element, result.expectation
    values = {name: np.asarray(table[name].value) for name in ("wavelength", "expected", "mean", "std")}
    values["error"] = values["std"] / np.sqrt(result.counts.n)
    with np.errstate(divide="ignore", invalid="ignore"):
        values["bias"] = values["mean"] / values["expected"] - 1.0
    values["coverage"] = x.per_element(coverage(result)) / x.per_element(np.ones(x.wavelength_nm.size))
    return table_of(ELEMENT_COLUMNS, [values], **table.meta)


@dataclass(eq=False)
class GaussianAnswer(Answer):
    """Answer of `gaussian`."""

    USES = ("instrument", "sky", "flare", "processes", "nuisances", "seed", "sweep")

    study: Study
    signal: SnrAnswer
    detection: DetectAnswer

    #: Largest error of each prediction, one row per star and cell.
    cells = TableOf(
        "gaussian", WORST_COLUMNS, "_largest_errors", place=True, about=("study.run.fap", "study"),
        title=lambda answer: f"The root-of-N formula and {answer.study.run.realisations:,} realisations; promised: no "
        "difference in S/N, 68.3 % of 1-sigma intervals, as many 5-sigma pixels and false alarms "
        f"({answer.study.run.fap:g}) as normal noise has",
    )  # fmt: skip
    #: Predictions and simulation, one row per star, cell and resolution element.
    elements = TableOf("elements", (), "signal.stars", of=lambda _, star: _promises(star.result),
                       place=True, about=("study.run.realisations", "study"))  # fmt: skip
    #: One row per star, cell and statistic: false-alarm probabilities at the formula's thresholds, with reasons.
    thresholds = TableOf("thresholds", (), "detection.departures")

    @property
    def headline(self) -> str:
        """The largest errors of the formula."""
        cells = self.cells
        snr = float(np.abs(cells["snr_off_by"]).max())
        worst = float(cells["fap_ratio"][_most_wrong(cells["fap_ratio"])])
        many = f"{'as many' if worst == 1.0 else f'up to {worst:.3g} times as many'} as promised"
        return (
            f"The root-of-N formula is {f'off by at most {snr:.2g}' if snr else 'right'} in S/N, and its false alarms "
            f"are {'too rare to be counted' if np.isnan(worst) else many}, in {counted(len(cells), 'case')}."
        )

    @property
    def messages(self) -> list[str]:
        return self.detection.messages

    @property
    def inputs(self) -> list[Expectation]:
        return self.signal.inputs

    @property
    def _largest_errors(self) -> Iterator[dict[str, Any]]:
        stars, rare = self.signal.stars, special.ndtr(-5.0)
        for k, star in enumerate(stars):
            # Each star has as many rows as the others.
            elements, tested, flares = (
                table[k * len(table) // len(stars) : (k + 1) * len(table) // len(stars)]
                for table in (self.elements, self.thresholds, self.detection.table)
            )
            sure = elements[np.abs(elements["mean"] - elements["expected"]) > SURE * elements["error"]]
            worst = sure[np.argmax(np.abs(sure["mean"] - sure["expected"]))] if len(sure) else None
            off = tested[tested["differs"]]
            right = {"ratio": 1.0 if len(tested) else np.nan, "statistic": "", "why": ""}
            wrong: Any = off[_most_wrong(off["ratio"])] if len(off) else right
            missed = flares["probability"] - flares["closed_form_probability"]
            # The interval includes the error of the threshold.
            is_sure = np.abs(missed) > (flares["high"] - flares["low"]) * SURE / ERRORS_IN_INTERVAL
            missed = np.where(is_sure, missed, 0.0)
            yield vars(star) | {
                "best_snr": float(elements["expected"].max()),
                "snr_off_by": 0.0 if worst is None else float(worst["mean"] - worst["expected"]),
                "at_nm": np.nan if worst is None else float(worst["wavelength"].value),
                "coverage_low": float(elements["coverage"].min()),
                "coverage_high": float(elements["coverage"].max()),
                "five_sigma_above": float((beyond(star.result.expectation, 5.0) / rare).max()),
                "five_sigma_below": float((beyond(star.result.expectation, -5.0) / rare).min()),
                "fap_ratio": float(wrong["ratio"]), "statistic": str(wrong["statistic"]), "why": str(wrong["why"]),
                "probability_off_by": float(missed[np.argmax(np.abs(missed))]),
            }  # fmt: skip


def _most_wrong(ratios: Any) -> int:
    """Return the index of the ratio that is furthest from 1, up or down."""
    return int(np.argmax(np.abs(np.log(np.maximum(ratios, SMALLEST_RATIO)))))


@by_keywords("stars, each of which is drawn for its S/N and then for its flares")
def gaussian(study: Study, engine: Engine | Pool | None = None, progress: Progress = None) -> GaussianAnswer:
    """Compare the usual formula with the simulation, for every star and sweep value of a study.

    Without a study, and unless keywords state a sweep, magnitude or exposure: magnitudes from 4 to 12 and exposures of
    5, 50 and 600 s. Usual unknowns are left out: the question is about the noise.
    """
    engine, study = engine or Engine(), study.ideal()

    def report(stage: int, number: int, total: int) -> None:
        if progress is not None:
            progress(stage * total + number, 2 * total)

    return GaussianAnswer(study, snr(study, engine, partial(report, 0)), detect(study, engine, partial(report, 1)))
