"""Spectra that visitors bring."""

from __future__ import annotations

from dataclasses import replace

from mauvecl.host.errors import InputError
from mauvecl.host.stars.source import Source
from mauvecl.web.fields import UPLOADED
from mauvecl.web.limited import read_limited

#: Bytes of an upload, and points of its spectrum, at most.
MOST_UPLOADED, MOST_POINTS = 4 * 2**20, 200_000


def too_large(size: float) -> str:
    """The sentence of an upload of so many bytes."""
    return f"upload of {size / 2**20:.1f} MiB, expected at most {MOST_UPLOADED / 2**20:g} MiB"


def read_upload(name: str, content: bytes) -> Source:
    """A spectrum from a visitor; nothing of it is trusted, least of all its name.

    Parameters
    ----------
    name : str
        As the visitor's computer has it; what the file is shows in its content.
    content : bytes
        Packed or not.

    Raises
    ------
    InputError
        If it is too large or holds no usable spectrum. Called on a thread of its own; any other
        exception is told to the visitor too.
    """
    if len(content) > MOST_UPLOADED:
        raise InputError(too_large(len(content)))
    source = read_limited(content)
    if source.wavelength_nm.size > MOST_POINTS:
        raise InputError(f"upload of {source.wavelength_nm.size} points, expected at most {MOST_POINTS}")
    return replace(source, name=UPLOADED, origin="upload")
