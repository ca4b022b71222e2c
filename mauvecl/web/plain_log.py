"""The server's log: a line for each thing, on standard error; no paths of the machine, no text without end."""

from __future__ import annotations

import logging
import traceback

#: Characters of a line.
MOST = 400


class Plain(logging.Formatter):
    """One line: when, who, what, and for an exception where in which module."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        parts = [self.formatTime(record), record.levelname, record.name, _line(record.getMessage())]
        if record.exc_info and record.exc_info[1] is not None:
            error = record.exc_info[1]
            parts.append(f"({type(error).__name__}: {_line(str(error))}; {_where(error)})")
        return " ".join(parts)


def _line(text: str) -> str:
    """Text from anywhere as one bounded line."""
    shown = " ".join(text.split())
    return "".join(c if c.isprintable() else "?" for c in shown[:MOST])


def _where(error: BaseException) -> str:
    """Modules and lines of a traceback: ours, or the last one."""
    frames = [(frame.f_globals.get("__name__", "?"), line) for frame, line in traceback.walk_tb(error.__traceback__)]
    ours = [one for one in frames if one[0].startswith("mauvecl.")] or frames[-1:]
    return ", ".join(f"{name} line {line}" for name, line in ours)


def install() -> None:
    """Let warnings and worse of all libraries be written so."""
    handler = logging.StreamHandler()
    handler.setFormatter(Plain())
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    # They write their own otherwise.
    for name in ("bokeh", "tornado"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [], True
        logger.setLevel(logging.WARNING)
