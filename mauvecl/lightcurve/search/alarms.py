"""The flares that a search finds in one stare: the largest first, each taken out before the next is looked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.search.bank import LEAD, TAIL
from mauvecl.lightcurve.search.recovery import Fit, Recovered

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.survey import Survey
    from mauvecl.lightcurve.search.templates import Templates

Float = NDArray[np.float64]

#: Alarms of one stare, at most.
MOST_ALARMS = 200
#: Share of a flare's S/N that its fit may leave behind, and that is no alarm of its own: shapes and temperatures that
#: the fit does not have.
LEFT_BEHIND = 0.05


@dataclass(frozen=True, eq=False)
class Alarm:
    """One flare that was found.

    Attributes
    ----------
    rho : float
        The search's statistic.
    recovered : Recovered
        What it was, by a fit; arrays of one value.
    """

    rho: float
    recovered: Recovered


def alarms(survey: Survey, templates: Templates, sums: NDArray[Any], threshold: float) -> list[Alarm]:
    """Everything above a threshold in one stare, as it is found: the largest first.

    Parameters
    ----------
    survey : Survey
    templates : Templates
        That the survey's bank and components are made of.
    sums : ndarray, shape (n_frame, n_sum)
        As drawn; what is known is taken off here.
    threshold : float
    """
    left = np.asarray(survey.net(sums[None]), np.float64)
    search, bank, start = survey.search, survey.bank, survey.stare.start_s
    fit = Fit(bank, templates)
    edges = np.column_stack([start, start + survey.stare.frame_s])
    raised: list[Alarm] = []
    while len(raised) < MOST_ALARMS:
        best = search.largest(left.astype(np.float32))
        rho, peak, width = (float(v[0]) for v in (best.maximum, best.peak_s, best.half_width_s))
        # What the fits of the others may have left here.
        near = [a.rho for a in raised if abs(float(a.recovered.peak_s[0]) - peak) < _reach(a, width)]
        if rho < threshold + LEFT_BEHIND * sum(near):
            break
        kelvin = templates.temperatures_k[templates.chosen[int(best.temperature[0])]]
        one = fit.recover(
            left, start, peak_s=[peak], half_width_s=[width], temperature_k=[kelvin],
            variance=search.variance, curves=survey.curves,
        )  # fmt: skip
        raised.append(Alarm(rho, one))
        light = one.amplitude[0] * bank.shape.mean_over(edges, one.peak_s[0], one.half_width_s[0])
        at = kelvin if np.isnan(one.temperature_k[0]) else float(one.temperature_k[0])
        left = left - light[:, None] * _response(templates, at)
    return raised


def _reach(alarm: Alarm, width_s: float) -> float:
    """How far what a flare's fit leaves behind reaches into templates of a half-width, s."""
    return TAIL * float(alarm.recovered.half_width_s[0]) + LEAD * width_s


def _response(templates: Templates, kelvin: float) -> Float:
    """The sums of a frame for a flare of one amplitude, straight between temperatures in their logarithm."""
    logs = np.log(templates.temperatures_k)
    return np.array([np.interp(np.log(kelvin), logs, column) for column in templates.directions.T])
