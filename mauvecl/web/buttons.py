"""Buttons that give files."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import panel as pn

if TYPE_CHECKING:
    from mauvecl.web.page import Page


def download(page: Page, label: str, file: str, make: Callable[[], io.BytesIO], width: int = 200) -> Any:
    """A button that gives a file of that name."""
    return pn.widgets.FileDownload(
        callback=partial(page.safely, make), filename=file, label=label, embed=False, auto=True, width=width
    )


def study(page: Page, label: str, name: str, make: Callable[[], io.BytesIO], width: int = 200) -> Any:
    """A button that gives a study: with an uploaded star beside it, it is an archive."""

    def made() -> io.BytesIO:
        button.filename = f"{name}.zip" if page.uploaded else f"{name}.toml"
        return make()

    button = download(page, label, f"{name}.toml", made, width)
    return button


def downloads(page: Page, name: str, *, with_study: bool = False) -> Any:
    """Buttons that give an answer's table and picture, and the study where it is not the question's own."""
    buttons = [
        download(page, f"{name} ({ending})", f"mauvecl-{name}.{ending}", partial(page.file, name, ending))
        for ending in ("ecsv", "fits", "png")
    ]
    if with_study:
        buttons.append(study(page, f"{name} (study)", name, partial(page.study_of, name)))
    return pn.FlexBox(*buttons)
