"""Two-line element sets, embedded or from a file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import DAY_S
from mauvecl.schema.text import shortened

from ..files.parsing import read_text
from .earth import GRAVITY, J2, RADIUS_KM
from .time_grid import utc_text


@dataclass(frozen=True)
class Elements:
    """A two-line element set."""

    first: str  # line 1
    second: str  # line 2
    source: str  # origin of the set, for reports

    def __post_init__(self) -> None:
        for number, line in enumerate((self.first, self.second), 1):
            _check(line, number)
        if self.first[2:7] != self.second[2:7]:
            raise InputError(
                f"orbital elements are of satellites {self.first[2:7]!r} and {self.second[2:7]!r}",
                "one",
                key="elements",
                value=(self.first[2:7], self.second[2:7]),
            )
        if self.satellite.error:
            raise InputError(
                f"orbital elements {shortened(self.second)} are refused by SGP4 (error {self.satellite.error})",
                "those of an orbit around the Earth",
                key="elements",
                value=self.second,
            )

    @classmethod
    def read(cls, path: str | Path) -> Elements:
        """Read the first set of a file; titles and comments are ignored.

        Raises InputError if the file holds no set or a line's checksum is wrong.
        """
        path = Path(path)
        return cls._of(read_text(path, "orbit file"), f"file {path.name}", shortened(str(path)))

    @classmethod
    def embedded(cls) -> Elements:
        """Return the public elements of Mauve that the package contains."""
        text = resources.files(__package__).joinpath("mauve.tle").read_text(encoding="utf-8")
        return cls._of(text, "public catalogue, object 66756, embedded", "the embedded elements")

    @classmethod
    def _of(cls, text: str, source: str, named: str) -> Elements:
        lines = [line.rstrip() for line in text.splitlines()]
        for one, two in pairwise(lines):
            if one.startswith("1 ") and two.startswith("2 "):
                return cls(one, two, source)
        raise InputError(
            f"orbit file {named} holds no two lines of elements",
            "a line '1 ...' before '2 ...'",
            key="elements",
            value=named,
        )

    @cached_property
    def satellite(self) -> Any:
        """Satellite record of `sgp4`."""
        from sgp4.api import WGS72, Satrec

        return Satrec.twoline2rv(self.first, self.second, WGS72)

    @property
    def name(self) -> str:
        """NORAD catalogue number."""
        return self.first[2:7].strip()

    @property
    def epoch_jd(self) -> float:
        """Epoch as a Julian date, UTC."""
        return float(self.satellite.jdsatepoch + self.satellite.jdsatepochF)

    @property
    def epoch(self) -> str:
        """Epoch in ISO 8601, UTC, to the second."""
        return utc_text(self.epoch_jd)

    @property
    def revolutions_per_day(self) -> float:
        """Mean motion."""
        return float(self.satellite.no_kozai) * 1440 / (2 * np.pi)

    @property
    def period_s(self) -> float:
        """Anomalistic period, s."""
        return DAY_S / self.revolutions_per_day

    @property
    def axis_km(self) -> float:
        """Semi-major axis, from the mean motion by Kepler's third law."""
        return float((GRAVITY / (2 * np.pi / self.period_s) ** 2) ** (1 / 3))

    @property
    def node_drift_deg_per_day(self) -> float:
        """Eastward drift of the node due to J2; the mean Sun moves by 0.98565 deg per day."""
        return float(np.degrees(-1.5 * self._oblate * np.cos(self.satellite.inclo)) * DAY_S)

    @property
    def latitude_rate_deg_per_day(self) -> float:
        """Rate of the mean argument of latitude: mean motion plus the drift of the perigee."""
        perigee = 0.75 * self._oblate * (5 * np.cos(self.satellite.inclo) ** 2 - 1)
        return 360.0 * self.revolutions_per_day + float(np.degrees(perigee)) * DAY_S

    @property
    def _oblate(self) -> float:
        """Common factor of the secular J2 rates, rad/s, with p the semi-latus rectum."""
        p = self.axis_km * (1 - self.satellite.ecco**2)
        return float(2 * np.pi / self.period_s * J2 * (RADIUS_KM / p) ** 2)


def _check(line: str, number: int) -> None:
    """Raise InputError unless a line has the right form and checksum (digits plus 1 per minus sign, modulo 10)."""
    if len(line) < 69 or not line.isascii() or not line.startswith(f"{number} "):
        raise InputError.of("elements", line, f"line {number} with 69 characters")
    checksum = sum(int(c) if c.isdigit() else c == "-" for c in line[:68]) % 10
    if line[68] != str(checksum):
        raise InputError(
            f"orbital elements {shortened(line)} end in the checksum {line[68]!r}",
            f"{checksum}: one is wrong",
            key="elements",
            value=line,
        )
