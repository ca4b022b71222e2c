"""Words that stand for a missing value in a cell of a text."""

from __future__ import annotations

import re

#: As archives and programs write them, in lower case; an empty cell has no value in any case.
MISSING_WORDS = ("", "null", "none", "n/a", "na", "--", "---", "-", "...", "masked", "indef", "<na>")
#: The same in the usual cases of letters.
SPELT = tuple(dict.fromkeys(how(word) for word in MISSING_WORDS for how in (str, str.upper, str.capitalize)))
_NO_VALUE = {*MISSING_WORDS, "nan", "nat"}


def is_missing(cell: str) -> bool:
    """Return whether a cell has no value: it is empty, or one of the words for that."""
    return cell.strip().lower() in _NO_VALUE


def is_missing_position(text: str) -> bool:
    """Return whether a text is a pair of missing values, such as "nan nan" or "--, --"."""
    words = re.split(r"\s*[,;]\s*|\s+", text.strip().strip("()[]").strip())
    return len(words) == 2 and all(map(is_missing, words))
