"""Sphinx configuration."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import jupyter_client
from astropy.table import Table
from pydantic import BaseModel
from pydantic_core import PydanticUndefined
from typer.main import get_command

from mauvecl.cli.app import app
from mauvecl.host import VERSION
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.schema.fields import Flag, Help, Range, Unit, as_typed, first, metadata_of
from mauvecl.schema.section import fields_of, model_in
from mauvecl.study.study import Study

project = "mauvecl"
author = "the mauvecl developers"
release = version = VERSION
extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    # Equations without another server.
    "sphinx-mathjax-offline",
]
myst_heading_anchors = 3
myst_enable_extensions = ["dollarmath", "amsmath"]
# Notebooks and the gallery are executed at every build. An error in one is a warning that holds its traceback, which -W
# makes an error of the build.
nb_execution_mode = "force"
nb_execution_timeout = 900
nb_execution_show_tb = True
nb_merge_streams = True


class EncryptedKernels(jupyter_client.AsyncKernelManager):
    """Kernels that talk through encrypted sockets; they print a warning of others."""

    transport_encryption = "auto"


# nbclient imports its default class from here when it starts a kernel.
jupyter_client.AsyncKernelManager = EncryptedKernels
html_theme = "pydata_sphinx_theme"
# Every page on the left of every page.
html_sidebars = {"**": ["globaltoc.html"]}
html_theme_options: dict[str, Any] = {"navbar_center": [], "show_toc_level": 2}
# A site with the documentation of several versions gives the address of their list; without it nothing is fetched.
if list_of_versions := os.environ.get("DOCS_VERSIONS"):
    html_theme_options |= {
        "switcher": {"json_url": list_of_versions, "version_match": VERSION},
        "navbar_start": ["navbar-logo", "version-switcher"],
    }
html_static_path = ["_static"]
html_css_files = ["wide.css"]
smartquotes = False
html_title = f"mauvecl {VERSION}"
exclude_patterns = ["_build", "_generated", "jupyter_execute", "**.ipynb_checkpoints"]
numpydoc_show_class_members = False
autodoc_typehints = "none"


def bench_tables() -> None:
    """Write the benchmarks' last results as tables that a page includes."""
    folder = Path(__file__).parent / "_generated"
    folder.mkdir(exist_ok=True)
    for path in (Path(__file__).parent.parent / "bench" / "results").glob("*.ecsv"):
        table = Table.read(path)
        head = [f"{name} ({table[name].unit})" if table[name].unit else name for name in table.colnames]
        rows = [head, *([format(row[name], table[name].info.format or "") for name in table.colnames] for row in table)]
        lines = [".. list-table::", "   :header-rows: 1", ""]
        for row in rows:
            lines += [f"   {'* -' if i == 0 else '  -'} {cell}" for i, cell in enumerate(row)]
        lines += ["", *(f"- {key}: {value}" for key, value in table.meta.items()), ""]
        (folder / f"{path.stem}.rst").write_text("\n".join(lines), encoding="utf-8")


def reference_of(section: type[BaseModel]) -> Iterator[dict[str, str]]:
    """Yield the row of each key of a section and of the sections in it, in the order of their declaration."""
    for path, field in fields_of(section):
        if (help := first(field, Help)) is None:
            continue
        value = field.get_default(call_default_factory=True)
        reach, unit = first(field, Range) or Range(), (first(field, Unit) or Unit("")).name
        yield {
            "path": ".".join(path),
            "meaning": help.text
            + (f": {help.choices}" if help.choices else "")
            + (f", {help.more}" if help.more else ""),
            "accepted": accepted_words(field.annotation, unit, reach),
            "default": help.default or ("required" if value is PydanticUndefined else default_text(value)),
            "flags": ", ".join(name for flag in metadata_of(field, Flag) for name in flag.names),
        }


def accepted_words(annotation: Any, unit: str, reach: Range) -> str:
    """Describe the values of a type in words."""
    parts = get_args(annotation)
    if get_origin(annotation) is Annotated:
        return accepted_words(parts[0], unit, reach)
    if get_origin(annotation) in (Union, UnionType):
        return " or ".join(dict.fromkeys(accepted_words(part, unit, reach) for part in parts if part is not NoneType))
    if get_origin(annotation) is Literal:
        return ", ".join(map(str, parts))
    if get_origin(annotation) is tuple:
        several = parts[-1] is Ellipsis
        return f"list of {accepted_words(parts[0], unit, reach)}" if several else f"{len(parts)} numbers"
    if get_origin(annotation) is dict:
        return f"table of {accepted_words(parts[1], unit, reach)}"
    if model_in(annotation) is not None:
        return "table"
    if annotation in (float, int):
        return reach.words(unit, whole=annotation is int)
    return {str: "text", bool: "true or false", Path: "path"}.get(annotation, "file")


def default_text(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(default_text, value))}]"
    return as_typed(value)


def write_keys(section: type[BaseModel], name: str, columns: tuple[str, ...]) -> None:
    """Write the reference of all keys of a section as a table that a page includes."""
    widths = {"meaning": 36, "accepted": 22, "default": 12, "flags": 10}
    lines = [".. list-table::", "   :header-rows: 1", f"   :widths: 20 {' '.join(str(widths[one]) for one in columns)}"]
    lines += ["", "   * - key", *(f"     - {one}" for one in columns)]
    for key in reference_of(section):
        lines += [
            f"   * - .. index:: single: {key['path']} ({name.split('_')[0]} key)",
            "",
            f"       ``{key['path']}``",
            "",
            *(f"     - {key[one].replace('*', chr(92) + '*')}" for one in columns),
        ]
    (Path(__file__).parent / "_generated" / f"{name}.rst").write_text("\n".join(lines) + "\n", encoding="utf-8")


def command_lines(command: Any, path: str, rule: str = "=") -> list[str]:
    """Return the help of a command and of those below it, with an index entry for each flag."""
    lines = [path, rule * len(path), ""]
    if own := getattr(command, "commands", {}):
        lines += [escaped(paragraph(command.help)), ""]
    else:
        lines += [f".. program:: {path}", "", *described(command.help or "")]
        for one in command.params:
            if one.param_type_name == "argument":
                lines += [f".. option:: {one.name.upper()}", "", f"   {escaped(one.help)}", ""]
            elif one.name not in ("help", "help_all"):
                names = ", ".join([*one.opts, *one.secondary_opts])
                lines += [f".. option:: {names}", "", f"   {escaped(one.help)}", ""]
    for name, inner in own.items():
        lines += command_lines(inner, f"{path} {name}", "-")
    return lines


def described(text: str) -> list[str]:
    """Return the paragraphs of a help text; those that are marked to be kept as they are become blocks of code."""
    lines = []
    for one in text.split("\n\n"):
        if one.strip(" \n").startswith("\b"):
            lines += [
                ".. code-block:: none",
                "",
                *(f"   {line.strip()}" for line in one.strip("\b \n").splitlines()),
                "",
            ]
        else:
            lines += [escaped(" ".join(one.split())), ""]
    return lines


def paragraph(text: str | None) -> str:
    """Return the first paragraph in one line."""
    return " ".join((text or "").split("\n\n")[0].split())


def escaped(text: str | None) -> str:
    """Return help as text that reStructuredText does not read as markup."""
    plain = (text or "").replace(chr(92), chr(92) * 2).strip()
    return "".join(f"{chr(92)}{one}" if one in "*`|_" else one for one in plain)


def write_commands() -> None:
    """Write a page for each command, and a list of them that a page includes."""
    folder, listed = Path(__file__).parent / "commands", list[str]()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name, one in get_command(app).commands.items():  # type: ignore[attr-defined]
        (folder / f"{name}.rst").write_text("\n".join(command_lines(one, f"mauvecl {name}")) + "\n", encoding="utf-8")
        listed.append(f"- :doc:`{name} </commands/{name}>`: {escaped(paragraph(one.help))}\n")
    (folder.parent / "_generated" / "commands.rst").write_text("".join(listed), encoding="utf-8")


bench_tables()
write_commands()
write_keys(Study, "study_keys", ("meaning", "accepted", "default", "flags"))
write_keys(Instrument, "instrument_keys", ("meaning", "accepted"))
