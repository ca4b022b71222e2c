"""Registry of pictures: decorators that register the class and name of each picture."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, TypeVar

from mauvecl.pictures.style import AXES
from mauvecl.schema.errors import InputError

F = TypeVar("F", bound=Callable[..., Any])
#: Modules that a search for pictures must not import, since matplotlib is loaded only when a picture is drawn.
WITHOUT_PICTURES = ("figure",)


@dataclass(frozen=True)
class Entry:
    """Function that draws a picture or writes a document of a class."""

    name: str  # name of the file
    make: Callable[..., Any]
    #: Arguments of `make` for a thing; the thing itself without it.
    given: Callable[[Any], tuple[Any, ...]] | None = None
    #: Arguments of `make` for each of several numbered pictures of a thing.
    each: Callable[[Any], Iterable[tuple[Any, ...]]] | None = None
    when: Callable[[Any], bool] | None = None  # whether a thing has the picture

    def of(self, thing: Any) -> list[tuple[int, str, Callable[..., Any]]]:
        """Return number, name and bound function of each picture of an object."""
        if self.when is not None and not self.when(thing):
            return []
        if self.each is not None:
            return [(n, f"{self.name}-{n}", partial(self.make, *given)) for n, given in enumerate(self.each(thing), 1)]
        given = (thing,) if self.given is None else self.given(thing)
        return [(0, self.name, partial(self.make, *given))]


#: Entries by class name, since importing the classes would import every answer.
PICTURES: defaultdict[str, list[Entry]] = defaultdict(list)
DOCUMENTS: defaultdict[str, list[Entry]] = defaultdict(list)


def picture_of(kind: str, name: str, **how: Any) -> Callable[[F], F]:
    """Register a function as a picture of a class; `plot` draws the first one.

    Parameters
    ----------
    kind : str
        Name of the class, as in ``"LimitAnswer"``.
    name : str
        Name of the picture's file without its ending.
    **how
        `given`, `each` and `when`; see `Entry`.
    """
    return _registers(PICTURES, kind, name, how)


def document_of(kind: str, name: str, **how: Any) -> Callable[[F], F]:
    """Register a function that returns the bytes of a document, such as a report; `name` has an extension."""
    return _registers(DOCUMENTS, kind, name, how)


def _registers(entries: defaultdict[str, list[Entry]], kind: str, name: str, how: dict[str, Any]) -> Callable[[F], F]:
    def register(make: F) -> F:
        entries[kind].append(Entry(name, make, **how))
        return make

    return register


def pictures_of(thing: Any) -> dict[str, Callable[..., Any]]:
    """Return every picture of an object by file name, as functions of `path` and `ax`."""
    return {name: partial(_draw, draw) for name, draw in _found(PICTURES, thing)}


def documents_of(thing: Any) -> dict[str, Callable[[], bytes]]:
    """Return the function of each document of an object, by file name."""
    return dict(_found(DOCUMENTS, thing))


def _found(entries: defaultdict[str, list[Entry]], thing: Any) -> list[tuple[str, Callable[..., Any]]]:
    """Return the entries of an object's class, numbered ones in the order of their numbers."""
    load()
    own = next((entries[kind.__name__] for kind in type(thing).__mro__ if kind.__name__ in entries), [])
    made = sorted((one for entry in own for one in entry.of(thing)), key=lambda one: one[0])
    return [(name, make) for _, name, make in made]


@cache
def load() -> None:
    """Import all modules of pictures, so that they register their functions."""
    for module in iter_modules([str(Path(__file__).parent)]):
        if module.name not in WITHOUT_PICTURES:
            import_module(f"{__package__}.{module.name}")


def _draw(draw: Callable[..., Any], path: str | Path | None = None, *, ax: Any = None, **options: Any) -> Any:
    """Draw a picture and return the figure, the path of the saved file, or `ax`."""
    if ax is not None and not (hasattr(ax, "plot") and hasattr(ax, "figure")):
        raise InputError.of("ax", ax, "axes, as returned by plt.subplots")
    before = AXES.set(ax)
    try:
        drawn = draw(path=path, **options)
    finally:
        AXES.reset(before)
    return drawn if ax is None else ax
