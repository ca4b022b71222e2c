"""Lines of a plan's report on a target, each number with its table and column."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mauvecl.answers.campaigns.plan_text import energy
from mauvecl.schema.tables import records

if TYPE_CHECKING:
    from mauvecl.answers.campaigns.plan import PlanAnswer

SUMMARY_TABLE = "plan.ecsv"
#: Explanation of the columns.
LEGEND = (
    "E50 and E90: bolometric energies from which on half and 90 % of the flares are recovered. Flares: recovered "
    "in the hours observed, expected by the rates as they are; 95 % of campaigns recover the numbers next to them, by "
    "Poisson's scatter and that of a star's rate; P(>= 1): probability of recovering any. False alarms: expected of "
    f"noise. Numbers are those of {SUMMARY_TABLE}."
)


def target_lines(answer: PlanAnswer, k: int) -> list[tuple[str, str, str]]:
    """Return the lines on a target: quantity, value, and the file and column of the value."""
    one, observation = answer.planned[k], answer.planned[k].observation
    record = records(answer.table)[k]
    said = {column.name: column.text(record) for column in answer.columns if column.heading}
    place, seen = observation.target, answer.seen
    lines = [
        ("right ascension, declination", f"{place.ra_deg:.4f}, {place.dec_deg:.4f} deg ({place.source})",
         "stars: ra, dec, position"),
        ("type; spectrum that stands for it", f"{place.spectral_type}; {observation.star.library}",
         "stars: spectral_type, spectrum"),
        ("V; distance", f"{observation.star.magnitude:g}; {observation.star.distance_pc:g} pc", "stars: V, distance"),
        ("seen; observed", f"{said['seen']} h; {said['hours']} h", "plan: seen, hours"),
    ]  # fmt: skip
    if one.seen_h == 0:
        return [*lines, ("never seen", seen.reason(place.name), "assumptions")]
    away = seen.elongation_deg(k)
    lines += [
        ("median stretch", f"{observation.window_s / 60:.0f} min", "stars: window"),
        ("best months", said["best_months"], "plan: best_months; months"),
        ("angle from the Sun", f"{away.min():.0f} to {away.max():.0f} deg", "days: elongation"),
        ("detector; hits by particles", f"{observation.quiet.conditions['temperature_c']:.1f} deg C; "
         f"{observation.hits_per_cm2_s:.2f} per cm^2 and s", "stars: temperature, hits"),
        ("S/N of a frame at amplitude 1", f"{observation.signal_per_frame:.4g}", "stars: signal_per_frame"),
        ("half of flares recovered from", energy(one.energy_at(0.5), " erg"), "plan: E50; energies: recovered"),
        ("90 % of flares recovered from", energy(one.energy_at(0.9), " erg"), "plan: E90; energies: recovered"),
    ]  # fmt: skip
    if one.recovered is not None:
        lines += [
            ("flares recovered, expected", said["expected"], "plan: expected; stars: recovered_per_day"),
            ("95 % of campaigns", said["low"], "plan: low, high; stars: scatter"),
            ("probability of at least one", said["at_least_one"], "plan: at_least_one"),
        ]
    lines.append(("false alarms expected", said["false_alarms"], "plan: false_alarms"))
    rates = one.no_rates if one.rates is None else one.rates.source
    lines.append(("flare rates", rates, "stars: rates; assumptions"))
    return lines
