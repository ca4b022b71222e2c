"""Files that visitors upload into fields of the page."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from inspect import Parameter, signature
from pathlib import Path
from typing import Any

import numpy as np

from mauvecl.host.spectra.conversion import ReadSpectrum
from mauvecl.host.stars.flare_spectra import ObservedFlare
from mauvecl.host.stars.source import Source
from mauvecl.host.tables.text_lines import columns
from mauvecl.observations.frames import Frames
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened
from mauvecl.web.fields import FIELDS, UPLOADED, UPLOADED_FILE, UPLOADED_UNKNOWN
from mauvecl.web.folders import content_folder
from mauvecl.web.question import Points
from mauvecl.web.sandboxed_reader import Spectrum, read_frames_limited, read_limited
from mauvecl.web.standards import Observations

#: Largest size of an upload, bytes, and largest number of points of its spectrum.
MOST_UPLOADED, MOST_POINTS = 4 * 2**20, 200_000
#: Largest size of a file that is kept unread, such as frames; a day of resolution elements takes some 8 MiB.
MOST_KEPT_BYTES = 16 * 2**20
#: Largest number of values of frames that an answer reads: the spectra of a day.
MOST_VALUES = 2**24

#: Largest size and number of rows of an unknown spectrum, which the study in every table contains.
MOST_PAIRS_BYTES, MOST_PAIRS = 2**18, 4000


def read_upload(
    name: str,
    content: bytes,
    *,
    wavelength_unit: str | None = None,
    flux_unit: str | None = None,
    extend: str | None = None,
) -> Source:
    """Read an untrusted spectrum from a visitor.

    Parameters
    ----------
    name : str
        Name on the visitor's computer; the format follows from the content.
    content : bytes
        Packed or not.
    wavelength_unit, flux_unit, extend : str, optional
        As for `Source.read`.

    Raises
    ------
    InputError
        If it is too large or holds no usable spectrum. Called on a thread of its own; any other
        exception is reported to the visitor too.
    """
    options = {"wavelength_unit": wavelength_unit, "flux_unit": flux_unit, "extend": extend}
    return replace(_spectrum(content, Source, options), name=UPLOADED, origin="upload")


def read_added(
    name: str,
    content: bytes,
    *,
    change_wavelength_unit: str | None = None,
    change_flux_unit: str | None = None,
    change_extend: str | None = None,
) -> Source:
    """Read an untrusted spectrum of light that a change adds, like `read_upload`."""
    source = read_upload(
        name, content, wavelength_unit=change_wavelength_unit, flux_unit=change_flux_unit, extend=change_extend
    )
    return replace(source, name="added spectrum")


def read_flare(
    name: str,
    content: bytes,
    *,
    flare_wavelength_unit: str | None = None,
    flare_flux_unit: str | None = None,
    continue_at_k: float | None = None,
) -> ReadSpectrum:
    """Read an untrusted spectrum of a flare, like `read_upload`.

    Only the measured range is returned; the study that reads the file continues it.
    """
    options = {"wavelength_unit": flare_wavelength_unit, "flux_unit": flare_flux_unit, "continue_at_k": continue_at_k}
    flare = _spectrum(content, ObservedFlare, options)
    low, high = flare.measured_nm
    inside = (flare.wavelength_nm >= low) & (flare.wavelength_nm <= high)
    own = tuple(text for text in flare.messages if text.startswith(f"{flare.name}: "))
    return ReadSpectrum(flare.wavelength_nm[inside], flare.flux_flam[inside], "uploaded flare", "upload", messages=own)


def read_quiescent(
    name: str, content: bytes, *, flare_wavelength_unit: str | None = None, flare_flux_unit: str | None = None
) -> ReadSpectrum:
    """Read an untrusted spectrum of a star without its flare, which may cover any range."""
    options = {"wavelength_unit": flare_wavelength_unit, "flux_unit": flare_flux_unit}
    return replace(_spectrum(content, ReadSpectrum, options), name="uploaded star without the flare", origin="upload")


def _spectrum(content: bytes, kind: type[Spectrum], options: Mapping[str, Any]) -> Spectrum:
    check_size(content, MOST_UPLOADED)
    spectrum = read_limited(content, kind, options)
    if spectrum.wavelength_nm.size > MOST_POINTS:
        raise InputError.of("points", spectrum.wavelength_nm.size, f"at most {MOST_POINTS}")
    return spectrum


def check_size(content: bytes, most: int) -> None:
    """Raise InputError if a file is too large."""
    if len(content) > most:
        size = len(content) / 2**20
        raise InputError(f"upload of {size:.1f} MiB", f"at most {most / 2**20:g} MiB", key="upload", value=len(content))


def read_pairs(name: str, content: bytes) -> Points:
    """Read the spectrum of a nuisance parameter: text with two columns, nm and DN of the exposure.

    Raises
    ------
    InputError
        If it is too large or holds no such columns.
    """
    check_size(content, MOST_PAIRS_BYTES)
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{shortened(name)} is not text", "two columns, nm and DN", key="upload", value=name
        ) from error
    pairs = columns(f"upload {shortened(name)}", text)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not 2 <= len(pairs) <= MOST_PAIRS:
        raise InputError(
            f"{shortened(name)} does not have two columns",
            f"2 to {MOST_PAIRS} rows of two numbers, nm and DN",
            key="upload",
            value=name,
        )
    if not np.isfinite(pairs).all() or (np.diff(pairs[:, 0]) <= 0).any():
        raise InputError(
            f"{shortened(name)} does not ascend in nm", "rows in ascending order", key="upload", value=name
        )
    return tuple((float(nm), float(dn)) for nm, dn in pairs)


@dataclass(frozen=True)
class VisitorFile:
    """A visitor's file, not read until an answer needs it."""

    name: str  # name on the visitor's computer, without folders and odd characters
    content: bytes

    @classmethod
    def of(cls, name: str, content: bytes) -> VisitorFile:
        """Keep a file; raise InputError if it is too large."""
        check_size(content, MOST_KEPT_BYTES)
        plain = re.sub(r"[^A-Za-z0-9_.+-]", "_", re.split(r"[/\\]", name)[-1])[-80:].strip(".-")
        return cls(plain or "file", content)

    def written(self, folder: Path) -> Path:
        """Write the file below a folder, once, and return its path."""
        home = content_folder(
            folder, self.name.encode() + self.content, lambda new: (new / self.name).write_bytes(self.content)
        )
        return home / self.name


@dataclass(frozen=True)
class Upload:
    """Kind of file that a field takes."""

    read: Callable[..., Any]  # reads a file from its name and content, and from the values of `options` by name
    entered: str = UPLOADED_FILE  # text of the field that stands for the file
    most: int = MOST_UPLOADED  # largest number of bytes

    @cached_property
    def options(self) -> tuple[str, ...]:
        """Fields that say how the file is read: the keyword-only parameters of the function that reads it."""
        parameters = signature(self.read).parameters.values()
        return tuple(one.name for one in parameters if one.kind is Parameter.KEYWORD_ONLY)

    @cached_property
    def keys(self) -> dict[str, str]:
        """Names of `options` by their names in the messages of readers."""
        return {
            key: name
            for name in self.options
            for key in ("wavelength_unit", "flux_unit", "extend")
            if name.endswith(key)
        }


#: Files by the field that takes them.
UPLOADS: Mapping[str, Upload] = {
    "star": Upload(read_upload, UPLOADED),
    "flare_file": Upload(read_flare),
    "flare_quiescent": Upload(read_quiescent),
    "change_file": Upload(read_added),
    "own_unknown": Upload(read_pairs, UPLOADED_UNKNOWN, most=MOST_PAIRS_BYTES),
    **{name: Upload(VisitorFile.of, most=MOST_KEPT_BYTES) for name, field in FIELDS.items() if field.kind == "upload"},
    "observations": Upload(Observations.of, most=MOST_KEPT_BYTES),
}


def read_frames_of(
    file: VisitorFile, mapping: VisitorFile | None, key: str, *, quality_bits: str | None = None
) -> Frames:
    """Read the frames of a visitor's file, through a mapping if there is one, without those of the quality bits.

    Raises InputError with the name of the field if it holds no frames.
    """
    files = {file.name: file.content}
    how = None
    if mapping is not None:
        how = mapping.name if mapping.name != file.name else f"mapping-{mapping.name}"
        files[how] = mapping.content
    with reported_for(key, file.name):
        return read_frames_limited(files, how, quality_bits)


@contextmanager
def reported_for(key: str, name: str) -> Iterator[None]:
    """Raise the errors of a reader as those of a field, with the name of the file."""
    try:
        yield
    except InputError as error:
        found = InputError(str(error), key=key, value=name)
        found.expected = error.expected
        raise found from error
