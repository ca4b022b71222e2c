"""Visibility of targets from the orbit, and calendars of their windows."""

from __future__ import annotations

import datetime
import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers.answer import Answer, TableOf, answer_metadata, first_of_several
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.host import VERSION
from mauvecl.host.arrays import Float, true_runs
from mauvecl.host.orbit.orbit import Bodies, Target, TimeGrid
from mauvecl.host.orbit.visibility import Visibility, Windows, elongation_deg, zodiacal_light
from mauvecl.schema.columns import Column, View, percent, table_of
from mauvecl.schema.fields import DAY_S
from mauvecl.study.plan import targets_of
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from mauvecl.device.engine import Engine
    from mauvecl.runs.pool import Pool


#: Characters that the text of a calendar escapes.
ESCAPES = str.maketrans({"\\": r"\\", ";": r"\;", ",": r"\,", "\n": r"\n"})


def calendar_bytes(entries: Iterable[tuple[str, str, str, str]]) -> bytes:
    """Return a calendar as the bytes of an .ics file, from the start, stop, title and text of its appointments.

    Start and stop are in UTC, ISO 8601 to the second, or dates of whole days, including the last.
    """
    lines = ["BEGIN:VCALENDAR", "VERSION:2.0", f"PRODID:-//mauvecl//mauvecl {VERSION}//EN", "X-WR-CALNAME:Mauve"]
    for start, stop, title, text in entries:
        unique = hashlib.sha256("\0".join((start, stop, title)).encode()).hexdigest()[:24]
        # An event of whole days ends at the beginning of the next day.
        is_day = "T" not in stop
        end = (datetime.date.fromisoformat(stop) + datetime.timedelta(days=1)).isoformat() if is_day else stop
        times = [moment.replace("-", "").replace(":", "") for moment in (start, end)]
        begins, ends = (f";VALUE=DATE:{time}" if is_day else f":{time}Z" for time in times)
        # A fixed time of the entry, so that equal plans give equal files.
        lines += ["BEGIN:VEVENT", f"UID:{unique}@mauvecl", f"DTSTAMP:{times[0][:8]}T000000Z", f"DTSTART{begins}",
                  f"DTEND{ends}", f"SUMMARY:{title.translate(ESCAPES)}", f"DESCRIPTION:{text.translate(ESCAPES)}",
                  "TRANSP:TRANSPARENT", "END:VEVENT"]  # fmt: skip
    lines.append("END:VCALENDAR")
    # Lines have at most 75 bytes; the rest of a longer one follows after a space. No character is cut.
    folded = (re.findall(rb"(?:^.{1,75}|.{1,74})(?![\x80-\xbf])", line.encode()) for line in lines)
    return b"".join(b"\r\n ".join(pieces) + b"\r\n" for pieces in folded)


#: Largest number of rows for which the table of windows is written.
MOST_WINDOWS = 100_000
#: Smallest exposure per day, hours, for which a target counts as visible on a day if windows are not known.
SEEN_H = 0.5

#: Largest number of targets with printed hours per month.
MOST_MONTHLY = 12
TARGET_COLUMN = Column("target", description="name of the target", heading="target", kind=str)
#: Columns of the table of targets; one for each limit in force follows `share`.
COLUMNS = (
    TARGET_COLUMN,
    Column("ra", "", "deg", "right ascension", "RA", ".3f", detail=True),
    Column("dec", "", "deg", "declination", "dec", ".3f", detail=True),
    Column("hours", "", "h", "exposure in the whole time, with the duty cycle", "hours", ".0f"),
    Column("share", "", "", "of the time in which the target is seen", "share", percent(".1f")),
    Column("windows", "", "", "stretches in which it is seen", "windows", detail=True),
    Column("median_window", "", "min", "length of a stretch", "median", lambda minutes: f"{minutes:.0f} min"),
    Column("longest_gap", "", "day", "longest time without one", "longest gap", lambda days: f"{days:.1f} d",
           detail=True),
    Column("per_orbit", "", "min", "exposure in a mean orbit"),
    Column("in_shadow", "", "", "share of the windows in the Earth's shadow"),
    Column("best_month", "", "", "that with most exposure", "best month"),
    Column("least_elongation", "", "deg", "least angle from the Sun", "least elongation",
           lambda degrees: f"{degrees:.0f} deg", detail=True),
    Column("most_elongation", "", "deg", "largest angle from the Sun"),
    Column("brightest_sky", "", "mag / arcsec2", "zodiacal light at its brightest, V, where the table has it"),
    Column("faintest_sky", "", "mag / arcsec2", "zodiacal light at its faintest, V"),
)  # fmt: skip
DAY_COLUMNS = (
    TARGET_COLUMN,
    Column("day", description="UTC"),
    Column("hours", "", "h", "exposure"),
    Column("elongation", "", "deg", "angle from the Sun at noon"),
    Column("zodiacal_light", "", "mag / arcsec2", "V at noon; none where the table has none, near the Sun"),
)
WINDOW_COLUMNS = (
    TARGET_COLUMN,
    Column("start", description="UTC", kind=str),
    Column("stop", description="UTC", kind=str),
    Column("length", "", "min"),
    Column("in_shadow", "", "min", "part of it in the Earth's shadow"),
    Column("orbit", description="ascending nodes since the start of the plan", kind=int),
)


def assumption_columns(first: str) -> tuple[Column, ...]:
    """Return the columns of a table of assumptions, for rows of quantity, value and source."""
    return tuple(Column(name, itemgetter(k)) for k, name in enumerate((first, "value", "source")))


def _target_columns(answer: VisibleAnswer) -> tuple[Column, ...]:
    """Return the columns of `VisibleAnswer.table`."""
    limits = (
        Column(f"leaves_{name}", itemgetter(f"leaves_{name}"), "",
               f"share of the time that the limit of {name} alone leaves")
        for name in answer.visibility.kept_by
    )  # fmt: skip
    place = [column.name for column in COLUMNS].index("share") + 1
    return (*COLUMNS[:place], *limits, *COLUMNS[place:])


@dataclass(frozen=True, eq=False)
class VisibleAnswer(Answer):
    """Answer of `visible`: hours, windows and sky of each target, by day and month, and the assumed limits."""

    USES = ("orbit",)

    study: Study
    targets: tuple[Target, ...]
    visibility: Visibility  # of the targets in their order

    #: One row per target.
    table = TableOf(
        "visible", _target_columns, lambda answer: [answer._row(k) for k in range(len(answer.targets))],
        title=lambda answer: f"Seen in {answer.times.days:g} days from {answer.times.iso(0.0)} UTC",
        meta=lambda answer: {"start": answer.times.iso(0.0), **answer_metadata(answer, "times.days", "study")},
    )  # fmt: skip
    #: One row per month, one column of hours per target.
    months = TableOf("months", lambda answer: (
        Column("month", itemgetter(0)),
        *(Column(target.name, itemgetter(k), "h") for k, target in enumerate(answer.targets, 1)),
    ), lambda answer: [(answer.by_month[0], *answer.by_month[1].T)])  # fmt: skip
    #: One row per target and day.
    by_day = TableOf("days", DAY_COLUMNS, "_day_rows")
    #: One row per window.
    window_table = TableOf("windows", WINDOW_COLUMNS, "_window_rows", when="writes_windows",
                           meta=("study", "times.step_s"))  # fmt: skip
    #: Active limits with their values and the sources of their defaults.
    assumptions = TableOf("assumptions", assumption_columns("limit"), "visibility.limits.assumptions", meta=())

    @property
    def headline(self) -> str:
        """The hours in which the first target is seen."""
        row, duty_cycle = self._row(0), self.visibility.limits.duty_cycle
        days = f"{self.times.days:g} days from {self.times.iso(0.0)[:10]}"
        of_several = first_of_several(len(self.targets), "targets")
        if not row["hours"]:
            return f"{row['target']} is not seen in {days}{of_several}."
        exposed = "" if duty_cycle == 1 else f" and exposed for {row['hours']:.0f} h"
        return (
            f"{row['target']} is seen for {row['hours'] / duty_cycle:.0f} h ({100 * row['share']:.1f} % of {days})"
            f"{exposed}, most in {row['best_month']}{of_several}."
        )

    @property
    def times(self) -> TimeGrid:
        """Time grid."""
        return self.visibility.track.times

    @cached_property
    def days(self) -> list[str]:
        """UTC days of the time grid, such as "2027-01-31"."""
        first, count = self.times.first_day, int(self.times.julian[1][-1]) + 1
        return np.arange(first, first + np.timedelta64(count, "D")).astype(str).tolist()

    @cached_property
    def noons(self) -> Bodies:
        """Positions of Sun and Moon at noon of each day, UTC."""
        return Bodies.at(TimeGrid(self.days[0], len(self.days), DAY_S))

    def elongation_deg(self, k: int) -> Float:
        """Return the angle of a target from the Sun at noon of each day, shape (n_day,)."""
        return elongation_deg(self.noons.sun, self.targets[k].direction)

    @cached_property
    def zodiacal(self) -> Float:
        """Sky behind each target at noon of each day, V mag arcsec^-2, (n_target, n_day); NaN near the Sun."""
        return np.array([zodiacal_light(self.noons, target.direction) for target in self.targets])

    @cached_property
    def windows(self) -> tuple[Windows, ...]:
        """Windows of each target."""
        return tuple(self.visibility.windows(k) for k in range(len(self.targets)))

    @cached_property
    def by_month(self) -> tuple[list[str], Float]:
        """Calendar months and hours of exposure, shape (n_month, n_target)."""
        return self.visibility.by_month()

    def _row(self, k: int) -> dict[str, Any]:
        """Return the row of a target, by the names of columns."""
        visibility, windows, target = self.visibility, self.windows[k], self.targets[k]
        hours, away, sky = self.by_month[1][:, k], self.elongation_deg(k), self.zodiacal[k]
        # Without a finite value, a NaN stands for all of them.
        sky = sky[np.isfinite(sky)] if np.isfinite(sky).any() else sky[:1]
        length, end_s = windows.length_s, self.times.n * self.times.step_s
        exposed, orbit_min = visibility.share[k] * visibility.limits.duty_cycle, visibility.orbit.elements.period_s / 60
        gaps_s = np.append(windows.start_s, end_s) - np.append(0.0, windows.stop_s)
        return {
            "target": target.name, "ra": target.ra_deg, "dec": target.dec_deg, "hours": visibility.hours[k],
            "share": visibility.share[k],
            **{f"leaves_{name}": shares[k] for name, shares in visibility.kept_by.items()},
            "windows": length.size, "median_window": float(np.median(length / 60)) if length.size else 0.0,
            "longest_gap": float(np.max(gaps_s)) / DAY_S, "per_orbit": float(exposed * orbit_min),
            "in_shadow": float(windows.in_shadow_s.sum() / length.sum()) if length.size else 0.0,
            "best_month": self.by_month[0][int(np.argmax(hours))] if hours.any() else "",
            "least_elongation": float(away.min()), "most_elongation": float(away.max()),
            "brightest_sky": float(sky.min()), "faintest_sky": float(sky.max()),
        }  # fmt: skip

    @property
    def views(self) -> list[View]:
        if len(self.targets) > MOST_MONTHLY:
            return super().views
        names, hours = self.by_month
        columns = (TARGET_COLUMN, *(Column(name, heading=name, format=".0f") for name in names))
        rows = [{"target": target.name} | dict(zip(names, target_hours, strict=True))
                for target, target_hours in zip(self.targets, hours.T, strict=True)]  # fmt: skip
        return [*super().views, View("Hours of exposure by month", columns, table_of(columns, rows))]

    @property
    def _day_rows(self) -> Iterator[dict[str, Any]]:
        """Rows of `by_day`, each with all days of a target."""
        for k, target in enumerate(self.targets):
            yield {"target": target.name, "day": self.days, "hours": self.visibility.by_day(k),
                   "elongation": self.elongation_deg(k), "zodiacal_light": self.zodiacal[k]}  # fmt: skip

    @property
    def _window_rows(self) -> Iterator[dict[str, Any]]:
        """Rows of `window_table`, each with all windows of a target."""
        times, z = self.times, self.visibility.track.of_date_km[:, 2]
        nodes = times.seconds[1:][(z[:-1] < 0) & (z[1:] >= 0)]
        for target, windows in zip(self.targets, self.windows, strict=True):
            start, stop = ([times.iso(float(t)) for t in ends] for ends in (windows.start_s, windows.stop_s))
            yield {"target": target.name, "start": np.array(start, str), "stop": np.array(stop, str),
                   "length": windows.length_s / 60, "in_shadow": windows.in_shadow_s / 60,
                   "orbit": np.searchsorted(nodes, windows.start_s)}  # fmt: skip

    @property
    def writes_windows(self) -> bool:
        """True if there are few enough windows for a table of them."""
        return sum(windows.start_s.size for windows in self.windows) <= MOST_WINDOWS

    @property
    def documents(self) -> dict[str, Callable[[], bytes]]:
        """Calendar of windows or, if these are not known, of the days on which a target is visible."""
        times, entries = self.times, list[tuple[str, str, str, str]]()
        by_window = self.study.orbit.orbit().resolved(times) == "tle" and self.writes_windows
        for k, target in enumerate(self.targets):
            windows, hours = self.windows[k], self.visibility.by_day(k)
            for start_s, stop_s in zip(windows.start_s, windows.stop_s, strict=True) if by_window else ():
                length = f"{(stop_s - start_s) / 60 * self.visibility.limits.duty_cycle:.0f} min of exposure"
                entries.append((times.iso(float(start_s)), times.iso(float(stop_s)), target.name, length))
            for first, last in true_runs(hours >= SEEN_H) if not by_window else ():
                mean = f"{hours[first:last].mean():.1f} h of exposure a day"
                entries.append((self.days[first], self.days[last - 1], target.name, mean))
        return {"visible.ics": partial(calendar_bytes, entries)}

    @property
    def messages(self) -> list[str]:
        """Messages on the orbit, assumptions, effects that are not modelled, and targets that are never visible."""
        never = [target.name for target, share in zip(self.targets, self.visibility.share, strict=True) if share == 0]
        lines = [f"{name} is never seen: {self.reason(name)}." for name in never]
        lines += self.study.orbit.orbit().messages(self.times)
        lines.append(
            "Mauve's own limits are not public: those used are assumptions, named with their sources in the table of "
            "assumptions. Stray light is not modelled."
        )
        if not self.writes_windows:
            lines.append(
                f"There are more than {MOST_WINDOWS} windows: their table is not written, and the calendar has days."
            )
        return lines

    def reason(self, name: str) -> str:
        """Return the reason why a target is never visible."""
        k = [target.name for target in self.targets].index(name)
        alone = [limit for limit, shares in self.visibility.kept_by.items() if shares[k] == 0]
        if not alone:
            return "its limits together leave nothing"
        ends = np.atleast_1d(getattr(self.visibility.limits, f"{alone[0]}_deg", ()))
        value = f" ({' to '.join(f'{end:g}' for end in ends)} deg)" if ends.size else ""
        return f"the limit of {alone[0].replace('_', ' ')}{value} alone leaves nothing"


@by_keywords("targets, once at the end")
def visible(study: Study, engine: Engine | Pool | None = None, progress: Progress = None) -> VisibleAnswer:
    """Compute when a study's targets are visible; its ``orbit`` defines position, time and limits.

    Examples
    --------
    >>> from mauvecl import Study, visible
    >>> study = Study().with_settings(["orbit.targets=['eps Eri']", "orbit.start=2027-01-01", "orbit.days=31"])
    >>> seen = visible(study)
    >>> seen.months["month"].tolist()
    ['2027-01']
    """
    targets = targets_of(study.orbit, study.plan)
    answer = visible_targets(study, targets)
    if progress is not None:
        progress(len(targets), len(targets))
    return answer


def visible_targets(study: Study, targets: Sequence[Target]) -> VisibleAnswer:
    """Return when targets that are already looked up are visible."""
    o, directions = study.orbit, np.array([target.direction for target in targets])
    return VisibleAnswer(study, tuple(targets), Visibility.of(o.orbit().track(o.times()), directions, o.limits))
