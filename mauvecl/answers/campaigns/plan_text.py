"""What a plan's report says of a target, in words: each number with the table and column that it is from."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mauvecl.answers.campaigns.plan import PlanAnswer
    from mauvecl.answers.campaigns.planned import Planned

#: Columns of the summary: heading, and the table that has the numbers.
SUMMARY = ("target", "seen (h)", "observed (h)", "E50 (erg)", "E90 (erg)", "flares", "95 %", "P(>= 1)", "false alarms",
           "best months")  # fmt: skip
SUMMARY_TABLE = "plan.ecsv"


def summary_rows(found: PlanAnswer) -> list[tuple[str, ...]]:
    """One row per target, as `SUMMARY`."""
    alarms = found.false_alarms
    return [
        (one.name, f"{one.seen_h:.0f}", f"{one.hours:.0f}", energy(one.energy_at(0.5)), energy(one.energy_at(0.9)),
         *_flares(one), f"{alarms[k]:.2g}", months(one.best_months))
        for k, one in enumerate(found.planned)
    ]  # fmt: skip


def _flares(one: Planned) -> tuple[str, str, str]:
    if one.found is None:
        return "", "", ""
    return f"{one.found.expected:.2g}", f"{one.found.low} to {one.found.high}", f"{one.found.at_least_one:.2f}"


def energy(value: float) -> str:
    """An energy with two digits, or that there is none."""
    return f"{value:.1e}" if math.isfinite(value) else "none"


def months(names: tuple[str, ...]) -> str:
    """Months in short: their numbers, and the year where it is one."""
    years = sorted({name[:4] for name in names})
    if len(years) == 1:
        return f"{years[0]}: " + ", ".join(str(int(name[5:])) for name in names)
    return ", ".join(names)


def target_lines(found: PlanAnswer, k: int) -> list[tuple[str, str, str]]:
    """Everything said of a target: what, how much, and the file and column that have it."""
    one, looked = found.planned[k], found.planned[k].looked
    place, seen = looked.target, found.seen
    lines = [
        ("right ascension, declination", f"{place.ra_deg:.4f}, {place.dec_deg:.4f} deg ({place.source})",
         "stars: ra, dec"),
        ("type; spectrum that stands for it", f"{place.spectral_type}; {looked.star.library}",
         "stars: spectral_type, spectrum"),
        ("V; distance", f"{looked.star.magnitude:g}; {looked.star.distance_pc:g} pc", "stars: V, distance"),
        ("seen; observed", f"{one.seen_h:.0f} h; {one.hours:.0f} h", "plan: seen, hours"),
        ("median stretch", f"{looked.window_s / 60:.0f} min", "stars: window"),
        ("best months", months(one.best_months), "plan: best_months; months"),
        ("angle from the Sun", f"{seen.elongation_deg(k).min():.0f} to {seen.elongation_deg(k).max():.0f} deg",
         "days: elongation"),
        ("S/N of a frame at amplitude 1", f"{looked.signal_per_frame:.4g}", "stars: signal_per_frame"),
        ("half of flares recovered from", f"{energy(one.energy_at(0.5))} erg", "plan: E50; energies: recovered"),
        ("90 % of flares recovered from", f"{energy(one.energy_at(0.9))} erg", "plan: E90; energies: recovered"),
    ]  # fmt: skip
    if one.found is not None:
        flares, interval, any_ = _flares(one)
        lines += [
            ("flares recovered, expected", flares, "plan: expected; stars: recovered_per_day"),
            ("95 % of campaigns", interval, "plan: low, high; stars: scatter"),
            ("probability of at least one", any_, "plan: at_least_one"),
        ]
    lines.append(("false alarms expected", f"{found.false_alarms[k]:.2g}", "plan: false_alarms"))
    rates = one.no_rates if one.rates is None else one.rates.source
    lines.append(("flare rates", rates, "stars: rates; assumptions"))
    return lines


def heading(found: PlanAnswer) -> str:
    """What the plan is, in a line."""
    moments = found.seen.moments
    return f"{len(found.planned)} targets, {moments.days:g} days from {moments.iso(0.0)[:10]} (UTC)"
