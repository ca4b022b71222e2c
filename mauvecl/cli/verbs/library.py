"""Command of the library: list spectra, keep the user's own, fetch public ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mauvecl.cli.flags import JsonFlag, QuietFlag, option_of

if TYPE_CHECKING:
    from mauvecl.host.stars.library import OwnStar

app = typer.Typer(invoke_without_command=True, rich_markup_mode=None, add_completion=False)
ReplaceFlag = Annotated[bool, typer.Option("--replace", help="Replace what already has that name.")]


@app.callback()
def library(context: typer.Context, as_json: JsonFlag = False) -> None:
    """List the embedded spectra and your own.

    `add`, `fetch` and `remove` change yours.

    Those of the library are kept at V = 0 and need --magnitude, but for the Sun and Vega.

    Examples: mauvecl library

    mauvecl library add my-star.txt

    mauvecl library fetch "ngsl:HD 37202"
    """
    if context.invoked_subcommand is not None:
        return
    from mauvecl.host.stars.library import COLUMNS, OWN_COLUMNS, library_table
    from mauvecl.schema.tables import View, records

    table = library_table()
    if as_json:
        print(json.dumps(records(table), indent=2))
        return
    from mauvecl.cli.console import show_view

    title = "Embedded spectra (UV: mean flux over that at 540-560 nm); origin, citation: --json"
    show_view(View(title, COLUMNS, table[table["kept"] == "embedded"]))
    yours = table[table["kept"] == "yours"]
    if len(yours):
        show_view(View("Your own", OWN_COLUMNS, yours))


@app.command()
def add(
    files: Annotated[list[Path], typer.Argument(help="Text, ECSV, VOTable or FITS; FILE[COLUMN] names a column.")],
    name: Annotated[
        str | None, typer.Option(metavar="TEXT", help="For one file: another name.", show_default=False)
    ] = None,
    replace: ReplaceFlag = False,
    wavelength_unit: Annotated[str | None, option_of("star.wavelength_unit")] = None,
    flux_unit: Annotated[str | None, option_of("star.flux_unit")] = None,
    extend: Annotated[str | None, option_of("star.extend")] = None,
    quiet: QuietFlag = False,
) -> None:
    """Keep spectra of your own under a name, for --star.

    Example: mauvecl library add my-star.txt --name "HD 1234"
    """
    from mauvecl.host.stars.additions import add
    from mauvecl.schema.errors import InputError

    if name is not None and len(files) > 1:
        raise InputError(f"--name {name!r} for {len(files)} files", "one file", key="name", value=name)
    for file in files:
        star = add(file, name, replace=replace, wavelength_unit=wavelength_unit, flux_unit=flux_unit, extend=extend)
        _tell(star, quiet)


@app.command()
def fetch(
    names: Annotated[
        list[str], typer.Argument(help="Stars, such as ngsl:HD 37202; in calspec, ngsl or lowlib, or in any of them.")
    ],
    base: Annotated[
        str | None,
        typer.Option("--from", metavar="TEXT", help="Another address of the collection: a mirror.", show_default=False),
    ] = None,
    replace: ReplaceFlag = False,
    extend: Annotated[str | None, option_of("star.extend")] = None,
    quiet: QuietFlag = False,
) -> None:
    """Fetch stars of public collections of HST spectra and keep them.

    Example: mauvecl library fetch "calspec:18sco"
    """
    import sys

    from mauvecl.host.stars.additions import fetch

    for name in names:
        shown = not quiet and sys.stderr.isatty()
        _tell(fetch(name, base=base, replace=replace, show_progress=shown, extend=extend), quiet)


@app.command()
def remove(names: Annotated[list[str], typer.Argument(help="Names of kept stars.")], quiet: QuietFlag = False) -> None:
    """Remove spectra of your own.

    Example: mauvecl library remove "HD 1234"
    """
    from mauvecl.cli.console import show
    from mauvecl.host.stars.library import remove

    for name in names:
        remove(name)
        if not quiet:
            show([f"Removed {name}."])


def _tell(star: OwnStar, quiet: bool) -> None:
    from mauvecl.cli.console import show

    if quiet:
        return
    lines = [
        f"Kept {star.name}: --star {json.dumps(star.name) if ' ' in star.name else star.name}",
        *star.notes,
        *star.messages,
    ]
    if star.unscaled:
        lines.append(f"It needs --magnitude: {star.unscaled}.")
    if star.dereddened:
        lines.append("Without its dust it is too bright in the ultraviolet: --ebv reddens it again.")
    show(lines)
