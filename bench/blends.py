"""How well a search of one stare counts and measures flares: coverage by S/N, and two flares by their separation.

    python bench/blends.py coverage 200
    python bench/blends.py pairs 20

print the tables of docs/flares-in-time.md: M3V at V = 9, one orbit, the usual bank, one false alarm in a star-month.
"""

from __future__ import annotations

import sys

import numpy as np

from mauvecl.lightcurve.flares.events import Event, coefficients
from mauvecl.lightcurve.search.alarms import Alarm, alarms
from mauvecl.study.study import Study
from mauvecl.study.surveys import StarSurvey, survey_star

THRESHOLD = 4.92
SQUARE = 0.72148


def found(known: StarSurvey, events: list[Event], seed: int) -> list[Alarm]:
    """Return the alarms of one stare with normal noise."""
    stare, components = known.survey.stare, known.survey.components
    coefs = components.coefficients(stare, coefficients(events, stare.start_s, stare.frame_s, np.array([10_000.0])))
    scatter = np.linalg.cholesky(components.covariance(coefs))
    normal = np.random.Generator(np.random.Philox(seed)).standard_normal((stare.n_frames, 3))
    sums = components.means(coefs) + np.einsum("tij,tj->ti", scatter, normal)
    return alarms(known.survey, known.templates, sums, THRESHOLD)


def coverage(known: StarSurvey, count: int, snrs: tuple[float, ...] = (6.0, 8.0, 15.0, 30.0)) -> None:
    """Print the share of 68 % intervals that hold the truth, of flares that are found, by S/N."""
    names = ("peak_s", "amplitude", "half_width_s", "temperature_k", "equivalent_duration_s")
    for snr in snrs:
        rows, ratios, by_curvature = [], [], []
        for seed in range(count):
            rng = np.random.Generator(np.random.Philox([seed, int(snr)]))
            width, peak = 10 ** rng.uniform(np.log10(25), np.log10(250)), rng.uniform(2000, 3500)
            amplitude = snr / known.unit_snr / np.sqrt(SQUARE * width / 5.0)
            event = Event(float(peak), float(width), float(amplitude))
            near = [
                a for a in found(known, [event], seed)
                if a.measured and abs(a.recovered.peak_s[0] - peak) < 3 * width
            ]  # fmt: skip
            if not near:
                continue
            one, truth = near[0], (peak, amplitude, width, 10_000.0, event.equivalent_duration_s)
            rows.append([a <= t <= b for (a, b), t in zip((one.intervals[n] for n in names), truth, strict=True)])
            ratios.append(float(one.recovered.equivalent_duration_s[0]) / event.equivalent_duration_s)
            by_curvature.append(abs(one.recovered.half_width_s[0] - width) <= one.recovered.half_width_error_s[0])
        shares = np.mean(rows, axis=0)
        print(
            f"| {snr:g} | {len(rows)} of {count} | " + " | ".join(f"{100 * s:.0f}" for s in shares)
            + f" | {100 * np.mean(by_curvature):.0f} | {np.median(ratios):.2f} |", flush=True,
        )  # fmt: skip


def pairs(known: StarSurvey, count: int) -> None:
    """Print how two equal flares come back, by separation in half-widths (60 s) and S/N."""
    for snr in (15.0, 40.0, 100.0):
        amplitude = snr / known.unit_snr / np.sqrt(SQUARE * 60.0 / 5.0)
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
    study = Study().with_settings(['star=[{library="M3V", magnitude=9}]'])
    what, number = sys.argv[1], int(sys.argv[2])
    {"coverage": coverage, "pairs": pairs}[what](survey_star(study, study.star[0]), number)
