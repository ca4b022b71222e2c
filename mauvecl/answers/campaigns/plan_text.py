"""What a plan's report says of a target, in words: each number with the table and column that it is from."""

from __future__ import annotations

import calendar
import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mauvecl.answers.campaigns.plan import PlanAnswer
    from mauvecl.answers.campaigns.planned import Planned

#: Columns of the summary: heading, and the columns of the table that has the numbers.
SUMMARY = ("target", "seen (h)", "observed (h)", "E50 (erg)", "E90 (erg)", "flares", "95 %", "P(>= 1)", "false alarms",
           "best months")  # fmt: skip
SUMMARY_COLUMNS = ("target", "seen", "hours", "E50", "E90", "expected", "low, high", "at_least_one", "false_alarms",
                   "best_months")  # fmt: skip
SUMMARY_TABLE = "plan.ecsv"
#: What the columns mean.
LEGEND = (
    "E50 and E90: bolometric energies from which on half and 90 % of the flares are recovered. Flares: recovered "
    "in the hours observed, expected by the rates as they are; 95 % of campaigns recover the numbers beside them, by "
    "Poisson's scatter and that of a star's rate; P(>= 1): probability of recovering any. False alarms: expected of "
    f"noise. Numbers are those of {SUMMARY_TABLE}."
)


def summary_rows(answer: PlanAnswer) -> list[tuple[str, ...]]:
    """One row per target, as `SUMMARY`."""
    alarms = answer.false_alarms
    return [
        (one.name, f"{one.seen_h:.0f}", f"{one.hours:.0f}", energy(one.energy_at(0.5)), energy(one.energy_at(0.9)),
         *_flares(one), two_digits(alarms[k]), months(one.best_months))
        for k, one in enumerate(answer.planned)
    ]  # fmt: skip


def _flares(one: Planned) -> tuple[str, str, str]:
    if one.recovered is None:
        return "not known", "", ""
    recovered = one.recovered
    return two_digits(recovered.expected), f"{recovered.low} to {recovered.high}", f"{recovered.at_least_one:.2f}"


def two_digits(value: float) -> str:
    """A number with two digits, or all that it has before the point."""
    return f"{value:.0f}" if value == 0 or value >= 9.95 else f"{value:#.2g}"


def energy(value: float, unit: str = "") -> str:
    """An energy with two digits, or that there is none."""
    return f"{value:.1e}{unit}" if math.isfinite(value) else "none"


def months(names: tuple[str, ...]) -> str:
    """Months by name, each year after its own."""
    years: dict[str, list[str]] = {}
    for name in names:
        years.setdefault(name[:4], []).append(calendar.month_abbr[int(name[5:])])
    return ", ".join(f"{' '.join(each)} {year}" for year, each in years.items())


def target_lines(answer: PlanAnswer, k: int) -> list[tuple[str, str, str]]:
    """Everything said of a target: what, how much, and the file and column that have it."""
    one, observation = answer.planned[k], answer.planned[k].observation
    place, seen = observation.target, answer.seen
    lines = [
        ("right ascension, declination", f"{place.ra_deg:.4f}, {place.dec_deg:.4f} deg ({place.source})",
         "stars: ra, dec, position"),
        ("type; spectrum that stands for it", f"{place.spectral_type}; {observation.star.library}",
         "stars: spectral_type, spectrum"),
        ("V; distance", f"{observation.star.magnitude:g}; {observation.star.distance_pc:g} pc", "stars: V, distance"),
        ("seen; observed", f"{one.seen_h:.0f} h; {one.hours:.0f} h", "plan: seen, hours"),
    ]  # fmt: skip
    if one.seen_h == 0:
        return [*lines, ("never seen", seen.reason(place.name), "assumptions")]
    away = seen.elongation_deg(k)
    lines += [
        ("median stretch", f"{observation.window_s / 60:.0f} min", "stars: window"),
        ("best months", months(one.best_months), "plan: best_months; months"),
        ("angle from the Sun", f"{away.min():.0f} to {away.max():.0f} deg", "days: elongation"),
        ("detector; hits by particles", f"{observation.quiet.conditions['temperature_c']:.1f} deg C; "
         f"{observation.hits_per_cm2_s:.2f} per cm^2 and s", "stars: temperature, hits"),
        ("S/N of a frame at amplitude 1", f"{observation.signal_per_frame:.4g}", "stars: signal_per_frame"),
        ("half of flares recovered from", energy(one.energy_at(0.5), " erg"), "plan: E50; energies: recovered"),
        ("90 % of flares recovered from", energy(one.energy_at(0.9), " erg"), "plan: E90; energies: recovered"),
    ]  # fmt: skip
    if one.recovered is not None:
        flares, interval, any_ = _flares(one)
        lines += [
            ("flares recovered, expected", flares, "plan: expected; stars: recovered_per_day"),
            ("95 % of campaigns", interval, "plan: low, high; stars: scatter"),
            ("probability of at least one", any_, "plan: at_least_one"),
        ]
    lines.append(("false alarms expected", two_digits(answer.false_alarms[k]), "plan: false_alarms"))
    rates = one.no_rates if one.rates is None else one.rates.source
    lines.append(("flare rates", rates, "stars: rates; assumptions"))
    return lines


def heading(answer: PlanAnswer) -> str:
    """What the plan is, in a line."""
    times = answer.seen.times
    targets = "1 target" if len(answer.planned) == 1 else f"{len(answer.planned)} targets"
    return f"{targets}, {times.days:g} days from {times.iso(0.0)[:10]} (UTC)"
