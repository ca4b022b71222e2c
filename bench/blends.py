"""How well a search of one stare counts and measures flares: coverage by S/N, and two flares by their separation.

    python bench/blends.py coverage 100
    python bench/blends.py pairs 20

print the tables of docs/flares-in-time.md: M3V at V = 9, one orbit, the usual bank, one false alarm in a star-month.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mauvecl.answers.inject import survey_star
from mauvecl.answers.stare import log_energy
from mauvecl.flares.stare import Event, coefficients
from mauvecl.search.alarms import Alarm, alarms
from mauvecl.search.survey import Factor, Survey
from mauvecl.study.cases import Case
from mauvecl.study.study import Study

THRESHOLD = 4.92
SQUARE = 0.72148
FIRST_SEED = 1000


@dataclass(frozen=True, eq=False)
class Known:
    """A star's search, and the energies of flares at it."""

    case: Case

    @property
    def survey(self) -> Survey:
        """The star's search."""
        return survey_star(self.case)

    @cached_property
    def log_energy(self) -> Factor | None:
        """As `stare` has it."""
        return log_energy(self.case, self.survey.templates.temperatures_k)


def found(known: Known, events: list[Event], seed: int) -> list[Alarm]:
    """Return the alarms of one stare with normal noise."""
    survey = known.survey
    stare, components = survey.stare, survey.components
    coefs = components.coefficients(stare, coefficients(events, stare.start_s, stare.frame_s, np.array([10_000.0])))
    scatter = np.linalg.cholesky(components.covariance(coefs))
    normal = np.random.Generator(np.random.Philox(seed)).standard_normal((stare.n_frames, 3))
    sums = components.means(coefs) + np.einsum("tij,tj->ti", scatter, normal)
    return alarms(survey, sums, THRESHOLD, known.log_energy)


def coverage(known: Known, count: int, snrs: tuple[float, ...] = (6.0, 8.0, 15.0, 30.0)) -> None:
    """Print shares of 68 % intervals that hold the truth, pulls and ratios, of flares that are found, by S/N.

    The seeds are other ones than those that `alarms.BARTLETT` was chosen with.
    """
    names = ("peak_s", "amplitude", "half_width_s", "temperature_k", "equivalent_duration_s", "energy")
    pulled = ("half_width_s", "peak_s", "equivalent_duration_s")
    print(f"| S/N | found | {' | '.join(names)} | rms pulls of {', '.join(pulled)} | energy, median ratio |")
    for snr in snrs:
        rows, ratios, pulls = [], [], []
        for seed in range(FIRST_SEED, FIRST_SEED + count):
            rng = np.random.Generator(np.random.Philox([seed, int(snr)]))
            width, peak = 10 ** rng.uniform(np.log10(25), np.log10(250)), rng.uniform(2000, 3500)
            amplitude = snr / known.survey.unit_snr / np.sqrt(SQUARE * width / 5.0)
            event = Event(float(peak), float(width), float(amplitude))
            near = [
                a for a in found(known, [event], seed)
                if a.measured and abs(a.recovered.peak_s[0] - peak) < 3 * width
            ]  # fmt: skip
            if not near:
                continue
            one, kelvin = near[0], 10_000.0
            scale = known.log_energy
            assert scale is not None
            energy = event.equivalent_duration_s * np.exp(scale(np.log(kelvin))[0])
            truth = (peak, amplitude, width, kelvin, event.equivalent_duration_s, energy)
            of = dict(zip(names, truth, strict=True))
            rows.append([one.intervals[name][0] <= of[name] <= one.intervals[name][1] for name in names])
            fit = one.recovered
            ratios.append(fit.equivalent_duration_s[0] * np.exp(scale(np.log(fit.temperature_k[0]))[0]) / energy)
            pulls.append([(getattr(fit, n) - of[n])[0] / getattr(fit, f"{n[:-2]}_error_s")[0] for n in pulled])
        shares, rms = np.mean(rows, axis=0), np.sqrt(np.mean(np.square(pulls), axis=0))
        print(
            f"| {snr:g} | {len(rows)} of {count} | " + " | ".join(f"{100 * s:.0f}" for s in shares)
            + f" | {', '.join(f'{r:.1f}' for r in rms)} | {np.median(ratios):.2f} |", flush=True,
        )  # fmt: skip


def pairs(known: Known, count: int, snrs: tuple[float, ...] = (15.0, 40.0, 100.0)) -> None:
    """Print how two equal flares come back, by separation in half-widths (60 s) and S/N."""
    for snr in snrs:
        amplitude = snr / known.survey.unit_snr / np.sqrt(SQUARE * 60.0 / 5.0)
        for apart in (0.25, 0.5, 1.0, 2.0, 5.0, 15.0):
            two, ratios, others = 0, [], 0
            for seed in range(count):
                events = [Event(2500.0, 60.0, amplitude), Event(2500.0 + 60.0 * apart, 60.0, amplitude)]
                several = sorted((a for a in found(known, events, seed) if a.measured), key=_peak)
                others += len(several) > 2
                if len(several) == 2:
                    two += 1
                    ratios += [
                        float(a.recovered.equivalent_duration_s[0]) / e.equivalent_duration_s
                        for a, e in zip(several, events, strict=True)
                    ]
            spread = np.quantile(ratios, (0.16, 0.5, 0.84)) if ratios else [np.nan] * 3
            print(
                f"| {snr:g} | {apart:g} | {100 * two / count:.0f} % | {100 * others / count:.0f} % | "
                f"{spread[1]:.2f} ({spread[0]:.2f}-{spread[2]:.2f}) |", flush=True,
            )  # fmt: skip


def _peak(alarm: Alarm) -> float:
    return float(alarm.recovered.peak_s[0])


if __name__ == "__main__":
    study = Study().with_settings(['star=[{library="M3V", magnitude=9, distance_pc=5}]'])
    what, number, snrs = sys.argv[1], int(sys.argv[2]), tuple(float(each) for each in sys.argv[3:])
    known = Known(Case(study))
    {"coverage": coverage, "pairs": pairs}[what](known, number, *((snrs,) if snrs else ()))
