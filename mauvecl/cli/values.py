"""Values of flags as text: numbers, counts such as 1e6, and lists such as 7,8."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import partial
from types import NoneType
from typing import Annotated, Any, get_args, get_origin

from mauvecl.schema.parsing import count, number, refusal, several


def as_text(kind: Any) -> tuple[Any, str, Callable[[str, str], Any] | None]:
    """Return the type of a flag as text, the flag's name, and a reader of its value if it is a number.

    Parameters
    ----------
    kind : Annotated
        A type and a `typer.Option`, whose limits the reader applies.
    """
    if get_origin(kind) is not Annotated:
        return kind, "", None
    wanted, option, *_ = get_args(kind)
    (inner, *_) = [one for one in (get_args(wanted) or (wanted,)) if one is not NoneType]
    many = get_origin(inner) is list or get_origin(wanted) is list
    each = get_args(inner)[0] if get_origin(inner) is list else inner
    if each not in (float, int):
        return kind, "", None
    option, low, high = copy(option), option.min, option.max
    option.min = option.max = None
    option.metavar = ("NUMBER" if each is float else "INTEGER") + (",..." if many else "")
    flag = next((one for one in option.param_decls or () if one.startswith("--")), "")
    read = partial(within, read=number if each is float else count, low=low, high=high)
    texts: Any = list[str] if many else str
    return Annotated[texts | None, option], flag, partial(several, read=read) if many else read


def within(text: str, flag: str, *, read: Callable[[str, str], Any], low: float | None, high: float | None) -> Any:
    """Read a number between two ends, either of which may be missing."""
    value = read(text, flag)
    if (low is not None and not value >= low) or (high is not None and not value <= high):
        reach = f"at least {low:g}" if high is None else f"{low:g} to {high:g}"
        raise refusal(flag, text, reach)
    return value
