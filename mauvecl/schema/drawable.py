"""Base class of objects with a `plot` method; it imports neither matplotlib nor the functions that draw."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path


class Drawable:
    """An object with pictures."""

    @property
    def pictures(self) -> dict[str, Callable[..., Any]]:
        """Every picture by the name of its file; each is called with a `path`, with axes `ax`, or with neither."""
        pictures: dict[str, Callable[..., Any]] = _registry().pictures_of(self)
        return pictures

    def plot(self, path: str | Path | None = None, *, ax: Any = None) -> Any:
        """Draw the first picture and return the figure, the path of the saved file, or `ax`; needs matplotlib."""
        return self._draw(path, ax)

    def _draw(self, path: str | Path | None, ax: Any, **options: Any) -> Any:
        return next(iter(self.pictures.values()))(path, ax=ax, **options)


def documents_of(thing: Drawable) -> dict[str, Callable[[], bytes]]:
    """Return the functions that make the registered documents of an object, by file name."""
    documents: dict[str, Callable[[], bytes]] = _registry().documents_of(thing)
    return documents


def connect(find: Callable[[], Any]) -> None:
    """Name the function that imports the module of pictures; the package calls this when it is imported."""
    global _registry
    _registry = find


_registry: Callable[[], Any]
