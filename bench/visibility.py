"""How long a year of visibility takes: a hundred targets, a step a minute, all limits, without a network.

    python bench/visibility.py [--targets 100] [--days 365] [--step 60] [--output bench/results/visibility.ecsv]

Processor seconds accompany wall seconds, which other work on the machine disturbs. Sockets are closed off first.
"""

from __future__ import annotations

import argparse
import resource
import socket
import sys
import time
from pathlib import Path

import numpy as np
from astropy.table import QTable


def no_network(*_: object, **__: object) -> None:
    """Refuse every connection."""
    raise OSError("no network in this bench")


def cpu_s() -> float:
    """Return the processor time of this process, s."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Measure the parts, one after the other, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--targets", type=int, default=100)
    parser.add_argument("--days", type=float, default=365.0)
    parser.add_argument("--step", type=float, default=60.0)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "visibility.ecsv")
    given = parser.parse_args()
    socket.socket.connect = no_network  # type: ignore[method-assign]
    started = time.perf_counter(), cpu_s()
    rows: list[tuple[str, float, float]] = []

    def done(what: str) -> None:
        rows.append((what, time.perf_counter() - started[0] - sum(r[1] for r in rows),
                     cpu_s() - started[1] - sum(r[2] for r in rows)))  # fmt: skip

    from mauvecl.host.orbit.orbit import Orbit, Target, TimeGrid
    from mauvecl.host.orbit.visibility import Visibility, zodiacal_light

    done("imports")
    rng = np.random.default_rng(1)
    places = rng.uniform(0, 360, given.targets), np.degrees(np.arcsin(rng.uniform(-0.7, 0.5, given.targets)))
    target = np.array([Target("made up", *place, "drawn").direction for place in zip(*places, strict=True)])
    track = Orbit.load().track(TimeGrid("2027-01-01", given.days, given.step))
    assert track.position_km.size
    done("orbit")
    assert track.bodies.sun.size
    done("Sun and Moon")
    visible = Visibility.of(track, target)
    done("limits")
    windows = sum(visible.windows(k).start_s.size for k in range(given.targets))
    visible.by_month()
    done("windows, hours by month")
    noons = Orbit.load().track(TimeGrid("2027-01-01", given.days, 86_400.0)).bodies
    for one in target:
        zodiacal_light(noons, one)
    done("zodiacal light of each day")
    rows.append(("together", sum(r[1] for r in rows), sum(r[2] for r in rows)))
    table = QTable(rows=rows, names=("part", "wall_s", "cpu_s"))
    table.meta = {
        "targets": given.targets,
        "days": given.days,
        "step_s": given.step,
        "windows": windows,
        "wanted": "a year for 100 targets at 60 s under 30 s on 2 cores, offline",
    }
    given.output.parent.mkdir(parents=True, exist_ok=True)
    table.write(given.output, format="ascii.ecsv", overwrite=True)
    for part, wall, cpu in rows:
        sys.stdout.write(f"{part:28s} {wall:7.2f} s wall {cpu:7.2f} s processor\n")


if __name__ == "__main__":
    main()
