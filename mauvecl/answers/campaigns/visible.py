"""When targets can be seen from the orbit: windows, hours by day and month, elongation and zodiacal light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from mauvecl.answers.answer import Answer
from mauvecl.answers.campaigns.calendars import Entry, calendar_bytes
from mauvecl.host.orbit.bodies import Bodies
from mauvecl.host.orbit.season import elongation_deg, zodiacal_light
from mauvecl.host.orbit.targets import Target
from mauvecl.host.orbit.time_grid import DAY_S, TimeGrid
from mauvecl.host.orbit.visibility import Visibility, Windows
from mauvecl.schema.calls import public
from mauvecl.schema.tables import make_table
from mauvecl.study.labels import describe_columns, stack_tables
from mauvecl.study.orbits import targets_of
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from mauvecl.device.engine import Engine
    from mauvecl.host.expectation import Expectation
    from mauvecl.runs.pool import Pool
    from mauvecl.study.assumptions import Use

Float = NDArray[np.float64]

#: Rows of the table of windows beyond which it is not written.
MOST_WINDOWS = 100_000
#: Hours of exposure in a day from which a day without single windows counts as one on which the target is seen.
SEEN_H = 0.5


@dataclass(frozen=True, eq=False)
class VisibleAnswer(Answer):
    """What `visible` answers.

    Attributes
    ----------
    study : Study
    targets : tuple of Target
    visibility : Visibility
        Columns in the order of the targets.
    """

    USES: ClassVar[tuple[Use, ...]] = ("orbit",)

    study: Study
    targets: tuple[Target, ...]
    visibility: Visibility

    @property
    def times(self) -> TimeGrid:
        """The times that are looked at."""
        return self.visibility.track.times

    @cached_property
    def days(self) -> list[str]:
        """Its UTC days, such as "2027-01-31"."""
        first = np.datetime64(self.times.iso(0.0)[:10], "D")
        count = int(np.floor(self.times.julian[1][-1])) + 1
        return [str(first + n) for n in range(count)]

    @cached_property
    def noons(self) -> Bodies:
        """Sun and Moon at the noon of each day, UTC."""
        return Bodies.at(TimeGrid(self.days[0], len(self.days), DAY_S))

    def elongation_deg(self, k: int) -> Float:
        """Angle of a target from the Sun at noon of each day, (n_day,)."""
        return elongation_deg(self.noons.sun, self.targets[k].direction)

    @cached_property
    def zodiacal(self) -> Float:
        """V mag arcsec^-2 behind each target at noon of each day, (n_target, n_day); NaN near the Sun."""
        return np.array([zodiacal_light(self.noons, one.direction) for one in self.targets])

    @cached_property
    def windows(self) -> tuple[Windows, ...]:
        """Those of each target."""
        return tuple(self.visibility.windows(k) for k in range(len(self.targets)))

    @property
    def table(self) -> QTable:
        """One row per target."""
        seen, (names, hours) = self.visibility, self.visibility.by_month()
        every = range(len(self.targets))
        lengths = [one.length_s / 60 for one in self.windows]
        dark = [float(w.in_shadow_s.sum() / w.length_s.sum()) if w.length_s.size else 0.0 for w in self.windows]
        best = [names[int(np.argmax(hours[:, k]))] if hours[:, k].any() else "" for k in every]
        away = [self.elongation_deg(k) for k in every]
        light = [one[np.isfinite(one)] for one in self.zodiacal]
        brightest, faintest = ([float(end(one)) if one.size else np.nan for one in light] for end in (np.min, np.max))
        per_orbit = [float(np.mean(seen.by_orbit(k))) for k in every]
        sky = "mag / arcsec2"
        columns: list[tuple[object, ...]] = [
            ("target", [one.name for one in self.targets]),
            ("ra", [one.ra_deg for one in self.targets], "", "deg"),
            ("dec", [one.dec_deg for one in self.targets], "", "deg"),
            ("hours", seen.hours, "exposure in the whole time, with the duty cycle", "h"),
            ("share", seen.share, "of the time in which the target is seen"),
            *(
                (f"leaves_{name}", kept, f"share of the time that the limit of {name} alone leaves")
                for name, kept in seen.kept_by.items()
            ),
            ("windows", [one.size for one in lengths], "stretches in which it is seen"),
            (
                "median_window",
                [float(np.median(one)) if one.size else 0.0 for one in lengths],
                "length of a stretch",
                "min",
            ),
            ("longest_gap", [self._longest_gap_d(k) for k in every], "longest time without one", "day"),
            ("per_orbit", per_orbit, "exposure in a mean orbit", "min"),
            ("in_shadow", dark, "share of the windows in the Earth's shadow"),
            ("best_month", best, "that with most exposure"),
            ("least_elongation", [float(one.min()) for one in away], "least angle from the Sun", "deg"),
            ("most_elongation", [float(one.max()) for one in away], "largest angle from the Sun", "deg"),
            ("brightest_sky", brightest, "zodiacal light at its brightest, V, where the table has it", sky),
            ("faintest_sky", faintest, "zodiacal light at its faintest, V", sky),
        ]
        about = {"start": self.times.iso(0.0), "days": self.times.days}
        return describe_columns(make_table(columns, **about, study=self.study.text()))

    def _longest_gap_d(self, k: int) -> float:
        """Days without a window."""
        one = self.windows[k]
        ends = (
            np.concatenate([[0.0], one.stop_s]),
            np.concatenate([one.start_s, [self.times.n * self.times.step_s]]),
        )
        return float(np.max(ends[1] - ends[0])) / DAY_S

    @property
    def months(self) -> QTable:
        """One row per month, one column of hours per target."""
        names, hours = self.visibility.by_month()
        each = ((one.name, hours[:, k], "", "h") for k, one in enumerate(self.targets))
        return make_table([("month", names), *each], study=self.study.text())

    @property
    def by_day(self) -> QTable:
        """One row per target and day."""
        told = "V at noon; none where the table has none, near the Sun"
        parts = (
            (
                {"target": one.name},
                make_table(
                    [
                        ("day", self.days),
                        ("hours", self.visibility.by_day(k), "", "h"),
                        ("elongation", self.elongation_deg(k), "angle from the Sun at noon", "deg"),
                        ("zodiacal_light", self.zodiacal[k], told, "mag / arcsec2"),
                    ]
                ),
            )
            for k, one in enumerate(self.targets)
        )
        return stack_tables(parts, study=self.study.text())

    @property
    def window_table(self) -> QTable:
        """One row per window."""
        times, z = self.times, self.visibility.track.of_date_km[:, 2]
        nodes = times.seconds[1:][(z[:-1] < 0) & (z[1:] >= 0)]
        nothing, orbits = np.array([], "U19"), "ascending nodes since the start of the plan"
        parts = (
            (
                {"target": one.name},
                make_table(
                    [
                        ("start", [times.iso(float(t)) for t in windows.start_s] or nothing),
                        ("stop", [times.iso(float(t)) for t in windows.stop_s] or nothing),
                        ("length", windows.length_s / 60, "", "min"),
                        ("in_shadow", windows.in_shadow_s / 60, "of it, in the Earth's shadow", "min"),
                        ("orbit", np.searchsorted(nodes, windows.start_s), orbits),
                    ]
                ),
            )
            for one, windows in zip(self.targets, self.windows, strict=True)
        )
        return stack_tables(parts, study=self.study.text(), step_s=times.step_s)

    @property
    def assumptions(self) -> Table:
        """Each limit in force, with its value and where its default is from."""
        from astropy.table import Table

        rows = self.visibility.limits.assumptions
        return Table(rows=rows, names=("limit", "value", "source"))

    @property
    def tables(self) -> dict[str, Table]:
        """Targets, months, days, windows, assumptions."""
        tables: dict[str, Table] = {"visible": self.table, "months": self.months, "days": self.by_day}
        if self._writes_windows:
            tables["windows"] = self.window_table
        return tables | {"assumptions": self.assumptions}

    @property
    def _writes_windows(self) -> bool:
        return sum(one.start_s.size for one in self.windows) <= MOST_WINDOWS

    @property
    def documents(self) -> dict[str, Callable[[], bytes]]:
        """The calendar: each window, or where these are not known the days on which a target is seen."""
        return {"visible.ics": partial(calendar_bytes, self.entries(), "Mauve")}

    def entries(self) -> list[Entry]:
        """Appointments of the calendar."""
        times, entries = self.times, list[Entry]()
        single = self.study.orbit.orbit().resolved(times) == "tle" and self._writes_windows
        for k, one in enumerate(self.targets):
            if single:
                windows = self.windows[k]
                entries += [
                    Entry(times.iso(float(a)), times.iso(float(b)), one.name, f"{(b - a) / 60:.0f} min of exposure")
                    for a, b in zip(windows.start_s, windows.stop_s, strict=True)
                ]
                continue
            hours = self.visibility.by_day(k)
            edges = np.flatnonzero(np.diff(np.concatenate([[False], hours >= SEEN_H, [False]])))
            for first, last in zip(edges[::2], edges[1::2], strict=True):
                mean = f"{hours[first:last].mean():.1f} h of exposure a day"
                entries.append(Entry(self.days[first], self.days[last - 1], one.name, mean))
        return entries

    @property
    def inputs(self) -> list[Expectation]:
        """None: nothing is exposed."""
        return []

    @property
    def messages(self) -> list[str]:
        """What the orbit is, what is assumed, what is not modelled, and which targets are never seen."""
        never = [one.name for one, part in zip(self.targets, self.visibility.share, strict=True) if part == 0]
        lines = [f"{name} is never seen: {self.reason(name)}." for name in never]
        lines += self.study.orbit.orbit().messages(self.times)
        lines.append(
            "Mauve's own limits are not public: those used are assumptions, named with their sources in the table of "
            "assumptions. Stray light is not modelled."
        )
        if not self._writes_windows:
            lines.append(
                f"There are more than {MOST_WINDOWS} windows: their table is not written, and the calendar has days."
            )
        return lines

    def reason(self, name: str) -> str:
        """Why a target is never seen."""
        k = [one.name for one in self.targets].index(name)
        alone = [limit for limit, kept in self.visibility.kept_by.items() if kept[k] == 0]
        return f"the limit of {alone[0]} alone leaves nothing" if alone else "its limits together leave nothing"


#: Columns of the table of targets.


@public
def visible(
    study: Study, engine: Engine | Pool | None = None, progress: Callable[[int, int], None] | None = None
) -> VisibleAnswer:
    """When a study's targets are seen.

    Parameters
    ----------
    study : Study
        Its ``orbit`` says from where, when, and what must hold.
    engine : Engine or Pool, optional
        Not used: nothing is drawn.
    progress : callable, optional
        Called once, with the number of targets, at the end.

    Raises
    ------
    InputError
        If there are no targets, or one is unknown; for elements that cannot be followed that far.

    Examples
    --------
    >>> from mauvecl import Study, visible
    >>> study = Study().with_settings(["orbit.targets=['eps Eri']", "orbit.start=2027-01-01", "orbit.days=31"])
    >>> seen = visible(study)
    >>> seen.months["month"].tolist()
    ['2027-01']
    """
    targets = tuple(targets_of(study))
    o = study.orbit
    track = o.orbit().track(o.times())
    directions = np.array([one.direction for one in targets])
    answer = VisibleAnswer(study, targets, Visibility.of(track, directions, o.limits.limits()))
    if progress is not None:
        progress(len(targets), len(targets))
    return answer
