"""Numbers and months as a plan writes them."""

from __future__ import annotations

import calendar
import math


def two_digits(value: float) -> str:
    """Format a number with two significant digits, or without decimals if it is large."""
    return f"{value:.0f}" if value == 0 or value >= 9.95 else f"{value:#.2g}"


def energy(value: float, unit: str = "") -> str:
    """Format an energy with two significant digits, or "none" if it is not finite."""
    return f"{value:.1e}{unit}" if math.isfinite(value) else "none"


def months(names: str) -> str:
    """Return months such as 2027-01 by name, with their years."""
    years: dict[str, list[str]] = {}
    for name in names.split():
        years.setdefault(name[:4], []).append(calendar.month_abbr[int(name[5:])])
    return ", ".join(f"{' '.join(each)} {year}" for year, each in years.items())
