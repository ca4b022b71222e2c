"""Windows as a calendar in the format iCalendar (RFC 5545)."""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Iterable
from dataclasses import dataclass

from mauvecl.host.version import VERSION


@dataclass(frozen=True)
class Entry:
    """Appointment in a calendar."""

    #: UTC, ISO 8601 to the second; dates without time make an entry of whole days, including the last.
    start: str
    stop: str
    title: str
    text: str = ""


def calendar_bytes(entries: Iterable[Entry], name: str) -> bytes:
    """Return a calendar as the bytes of an .ics file."""
    lines = [
        "BEGIN:VCALENDAR",
        "VERSION:2.0",
        f"PRODID:-//mauvecl//mauvecl {VERSION}//EN",
        f"X-WR-CALNAME:{_text(name)}",
    ]
    for entry in entries:
        unique = hashlib.sha256("\0".join((entry.start, entry.stop, entry.title)).encode()).hexdigest()[:24]
        lines += [
            "BEGIN:VEVENT",
            f"UID:{unique}@mauvecl",
            # A fixed time, so that equal plans give equal files.
            f"DTSTAMP:{_moment(entry.start).removeprefix(':').removeprefix(';VALUE=DATE:')[:8]}T000000Z",
            f"DTSTART{_moment(entry.start)}",
            f"DTEND{_moment(_day_after(entry.stop) if _is_day(entry.stop) else entry.stop)}",
            f"SUMMARY:{_text(entry.title)}",
            *([f"DESCRIPTION:{_text(entry.text)}"] if entry.text else []),
            "TRANSP:TRANSPARENT",
            "END:VEVENT",
        ]
    lines.append("END:VCALENDAR")
    return "".join(f"{_folded(line)}\r\n" for line in lines).encode()


def _is_day(text: str) -> bool:
    return len(text) == 10


def _moment(text: str) -> str:
    plain = text.replace("-", "").replace(":", "")
    return f";VALUE=DATE:{plain}" if _is_day(text) else f":{plain}Z"


def _day_after(text: str) -> str:
    return (datetime.date.fromisoformat(text) + datetime.timedelta(days=1)).isoformat()


def _text(value: str) -> str:
    for special in ("\\", ";", ","):
        value = value.replace(special, "\\" + special)
    return value.replace("\n", "\\n")


def _folded(line: str) -> str:
    """Fold a line to at most 75 bytes; continuation lines begin with a space."""
    parts: list[str] = []
    part = ""
    for character in line:
        if len((part + character).encode()) > (75 if not parts else 74):
            parts.append(part)
            part = ""
        part += character
    return "\r\n ".join([*parts, part])
