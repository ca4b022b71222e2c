"""The verb that injects flares into stares and searches for them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mauvecl.cli.flags import DRAWS, FLARE, SHAPES, SIZE, SPECTRUM, STARE, SWEEP, flag, group
from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.answers.stares.inject import InjectAnswer
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study

#: Length of the stare where nobody tells, s.
DAY_S = 86_400.0

SEARCH = group(
    flag(float, "--false-alarms", "Of the search, per star-day, -month or -year [1].", "search.false_alarms"),
    flag(str, "--alarms-per", "day, month or year, of frames [month].", "search.per"),
    flag(str, "--shape", SHAPES, "search.shape"),
)
INJECTIONS = group(
    flag(int, "--injections -n", "Of each size and half-width [2000].", "injections.count"),
    flag(
        str,
        "--size",
        "amplitude, duration, energy or band_energy [energy if the star's size is known, else amplitude].",
        "injections.of",
    ),
    flag(float, "--smallest", "Smallest size [0.3 of what is found].", "injections.low"),
    flag(float, "--largest", "Largest size [3 times what is found].", "injections.high"),
)
#: What it takes of a stare: not the flares in it.
LOOKED = {name: STARE[name] for name in ("gap", "orbit_gap", "thermal", "with_unknowns")} | group(
    flag(float, "--duration", f"Of the stare, s [{DAY_S:.0f}, a day; or the study's].", "stare.duration_s")
)


def _day(_: dict[str, Any]) -> Study:
    from mauvecl.study.stare_section import StareQuestion
    from mauvecl.study.study import Study

    return Study(stare=StareQuestion(duration_s=DAY_S))


@takes_study(
    {name: FLARE[name] for name in ("flare_temperature", "flare_band", "geometry", "photosphere_temperature")}
    | SPECTRUM,
    LOOKED,
    SIZE,
    SEARCH,
    INJECTIONS,
    {"seed": DRAWS["seed"]},
    SWEEP,
    without="exposure",
    default=_day,
)
def inject(study: Study, session: Session) -> None:
    """Which flares a search would find: completeness, false alarms.

    Over energy (or amplitude) and half-width, with the errors of what is recovered.

    Flares are injected into drawn stares and searched for with a bank of filters. A stare of a day unless told.

    Examples: mauvecl inject --star G2V --magnitude 7.4 --distance 14.1 --false-alarms 1 --alarms-per month

    mauvecl inject --star M3V --magnitude 9 --orbit-gap 2100 --with-unknowns --sweep flare_temperature=7000,10000,15000
    """
    answer = session.ask(study)
    session.answer(answer, lambda: _show(answer))


def _show(answer: InjectAnswer) -> None:
    from mauvecl.answers.stares.inject import SIZE_UNITS
    from mauvecl.cli.console import short, show_table
    from mauvecl.schema.tables import INTERVAL

    choice = answer.study.search
    alarms = "false alarm" if choice.false_alarms == 1 else "false alarms"
    swept = tuple(axis.quantity for axis in answer.study.sweep.axes)
    show_table(
        f"The search: {choice.false_alarms:g} {alarms} per star-{choice.per} of frames",
        ("star", *swept, "threshold", INTERVAL, "templates", "sums of a frame", "alarms a day above", "sampled",
         "drawn"),
        [
            (one.label, *map(short, one.at.values()), f"{one.threshold.value:.3f}",
             f"[{one.threshold.low:.3f}, {one.threshold.high:.3f}]", str(one.surveyed.survey.search.n_filters),
             str(one.surveyed.survey.components.n_statistics), f"{one.checked:.2f}", f"{one.asked:.3g}",
             f"{one.simulated.value:.3g}")
            for one in answer.stars
        ],
    )  # fmt: skip
    for one in answer.stars:
        table = answer.table[answer.table["star"] == one.label]
        unit = f" ({SIZE_UNITS[one.sizes.of]})" if SIZE_UNITS[one.sizes.of] else ""
        for name, value in one.at.items():
            column = table[name]
            table = table[getattr(column, "value", column) == value]
        show_table(
            f"{one.title}: {one.sizes.of}{unit} of which a half (E50) and nine tenths (E90) are found",
            ("half-width (s)", "E50", INTERVAL, "E90", INTERVAL, "no template fits"),
            [
                ("all" if row["half_width"].value != row["half_width"].value else f"{row['half_width'].value:.4g}",
                 *(text for name in ("e50", "e90") for text in _limit(row, name)), f"{100 * row['never']:.3g} %")
                for row in table
            ],
        )  # fmt: skip


def _limit(row: Any, name: str) -> tuple[str, str]:
    value, low, high = (getattr(row[n], "value", row[n]) for n in (name, f"{name}_low", f"{name}_high"))
    return f"{value:.4g}", f"[{low:.4g}, {high:.4g}]"
