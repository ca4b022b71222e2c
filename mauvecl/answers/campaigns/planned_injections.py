"""Completeness of a plan's target from flares injected into its windows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.answers.campaigns.planned import TargetObservation
from mauvecl.answers.stares.inject import inject
from mauvecl.flares.curves import Curve
from mauvecl.flares.energies import BOLOMETRIC
from mauvecl.runs.checkpoint import kept
from mauvecl.runs.pool import Pool
from mauvecl.search.completeness import PER_DECADE, Completeness, DurationLaw
from mauvecl.study.cases import Case
from mauvecl.study.searches import InjectionQuestion

if TYPE_CHECKING:
    from mauvecl.detection.snr import Arrays
    from mauvecl.device.stare_engine import Stares

Float = NDArray[np.float64]

#: Orbits of a stare; the baseline window of a search spans several of them.
ORBITS = 3
#: Number and range of injected half-widths, and number of their peak times.
WIDTHS, WIDTH_RANGE_S, POSITIONS = 10, (5.0, 3000.0), 20


def inject_target(observation: TargetObservation, engine: Stares | Pool | None = None) -> Completeness:
    """Compute the share of injected flares that the study's search finds, by bolometric energy.

    Each orbit of the stare has one window of the target's median length. The checkpoint of a pool keeps the result.
    """
    study, question = observation.case.study, injection_case(observation).study
    energy = 10 ** np.arange(24.0, 40.0, 1 / PER_DECADE)

    def computed() -> Arrays:
        star = inject(question, engine).stars[0]
        widths = np.array(star.injected.half_widths_s)
        critical = star.injected.critical.reshape(widths.size, -1)
        probability = found_by_energy(critical, widths, energy, study.plan.law())
        return {
            "probability": probability,
            "threshold": np.array(star.threshold.value),
            "shifted": np.array(star.shifted),
        }

    depends_on = ("completeness of a target", question.text(), observation.quiet, observation.scale)
    found = kept(engine.checkpoint if isinstance(engine, Pool) else None, depends_on, computed)
    how = (
        f"{question.injections.count} injections of each of {WIDTHS} half-widths into stretches of "
        f"{observation.window_s / 60:.0f} min, found above {float(found['threshold']):.2f} sigma, "
        f"{study.search.false_alarms:g} false alarms per {study.search.per}"
        + (", allowing for unknowns that the search leaves in" if found["shifted"] else "")
    )
    return Completeness(energy, found["probability"], BOLOMETRIC, how)


def injection_case(observation: TargetObservation) -> Case:
    """Return the case for `inject`, with the target's windows and conditions."""
    study, conditions = observation.case.study, observation.conditions
    orbit_s = study.orbit.orbit().elements.period_s
    gap = max(orbit_s - observation.window_s, 0.0)
    changes: dict[str, Any] = {
        "duration_s": ORBITS * orbit_s, "orbit_s": orbit_s, "orbit_gap_s": gap, "gaps": (), "along_orbit": False,
    }  # fmt: skip
    if conditions is not None and study.stare.thermal is None:
        changes["thermal"] = Curve(points=conditions.swings(ORBITS, orbit_s))
    injections = InjectionQuestion(
        of="energy", sizes=2, widths=WIDTHS, half_width_low_s=WIDTH_RANGE_S[0], half_width_high_s=WIDTH_RANGE_S[1],
        count=study.plan.injections, positions=min(POSITIONS, study.plan.injections), fitted=0,
    )  # fmt: skip
    return observation.case.with_sections(
        stare=study.stare.model_copy(update=changes),
        search=study.search.model_copy(update={"nulls": 0}),
        injections=injections,
    )


def found_by_energy(critical_erg: Float, half_widths_s: Float, energy_erg: Float, law: DurationLaw) -> Float:
    """Return the completeness by energy, averaged over the half-widths of an energy, shape (n_energy,).

    Parameters
    ----------
    critical_erg : ndarray, shape (n_half_width, n_draw)
        Smallest detected energy of each injection. It is zero if there is an alarm without the flare; these injections
        are ignored, since false alarms are counted separately.
    half_widths_s : ndarray, shape (n_half_width,)
    energy_erg : ndarray, shape (n_energy,)
    """
    of_width = np.empty((half_widths_s.size, energy_erg.size))
    for row, one in zip(of_width, critical_erg, strict=True):
        counted = np.sort(one[one > 0])
        row[:] = np.searchsorted(counted, energy_erg, side="right") / max(counted.size, 1)
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    half = np.log(law.half_width(energy_erg)[:, None] * 10 ** (law.scatter_dex * nodes))
    place = np.interp(half, np.log(half_widths_s), np.arange(half_widths_s.size))
    i = np.minimum(place.astype(int), half_widths_s.size - 2)
    part, column = place - i, np.arange(energy_erg.size)[:, None]
    p = (1 - part) * of_width[i, column] + part * of_width[i + 1, column]
    return np.asarray(np.clip(p @ (weights / weights.sum()), 0.0, 1.0))
