"""Log of the server on standard error: one bounded line per entry, without paths of the machine."""

from __future__ import annotations

import logging
import traceback

#: Characters of a line.
MOST = 400


class Plain(logging.Formatter):
    """Formatter of one line: time, logger, message and, for exceptions, the location."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        parts = [self.formatTime(record), record.levelname, record.name, _line(record.getMessage())]
        if record.exc_info and record.exc_info[1] is not None:
            error = record.exc_info[1]
            parts.append(f"({type(error).__name__}: {_line(str(error))}; {_where(error)})")
        return " ".join(parts)


def _line(text: str) -> str:
    """Shorten text to one bounded line."""
    shown = " ".join(text.split())
    return "".join(c if c.isprintable() else "?" for c in shown[:MOST])


def _where(error: BaseException) -> str:
    """Return modules and lines of a traceback: those of mauvecl, or the last one."""
    frames = [(frame.f_globals.get("__name__", "?"), line) for frame, line in traceback.walk_tb(error.__traceback__)]
    ours = [one for one in frames if one[0].startswith("mauvecl.")] or frames[-1:]
    return ", ".join(f"{name} line {line}" for name, line in ours)


def install() -> None:
    """Apply the format to warnings and errors of all libraries."""
    handler = logging.StreamHandler()
    handler.setFormatter(Plain())
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    # They write their own otherwise.
    for name in ("bokeh", "tornado"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [], True
        logger.setLevel(logging.WARNING)
