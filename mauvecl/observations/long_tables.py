"""Tables with a row for each pixel of each frame, as spectra."""

from __future__ import annotations

import numpy as np

from mauvecl.host.tables.table import Values
from mauvecl.schema.errors import InputError


def spectra_of_rows(
    time: tuple[Values, ...],
    flux: Values,
    error: Values | None,
    quality: Values | None,
    exposure: Values | None,
    temperature: Values | None,
    wavelength: Values,
    what: str,
) -> tuple[tuple[Values, ...], Values, Values | None, Values | None, Values | None, Values | None, Values]:
    """Return the quantities of a long table with a row for each frame; errors and quality flags for each pixel.

    Raises InputError if a frame lacks a wavelength that another has, has one twice, or has two exposure times or
    temperatures.
    """
    key = np.asarray(time[0].texts() or time[0].numbers())
    nm = wavelength.numbers()
    frames, frame = np.unique(key, return_inverse=True)
    pixels, pixel = np.unique(nm, return_inverse=True)
    counts = np.zeros((frames.size, pixels.size), np.int64)
    np.add.at(counts, (frame, pixel), 1)
    if (counts != 1).any():
        row, column = np.argwhere(counts != 1)[0]
        raise InputError(
            f"{what}: the frame at {frames[row]} has {counts[row, column]} rows of wavelength {pixels[column]:g}",
            "one row for each pixel of each frame", key="wavelength", value=float(pixels[column]),
        )  # fmt: skip
    place = np.empty(counts.shape, np.int64)
    place[frame, pixel] = np.arange(key.size)

    def spectra(values: Values | None) -> Values | None:
        return None if values is None else Values.of(values.name, values.numbers()[place], values.unit, what)

    def single(values: Values | None) -> Values | None:
        if values is None:
            return None
        texts = values.texts()
        rows = np.asarray(texts if texts is not None else values.numbers())[place]
        if (rows != rows[:, :1]).any():
            fault = f"{what}: {values.name!r} changes within a frame"
            raise InputError(fault, "one value for each frame", key=values.name)
        return Values.of(values.name, rows[:, 0], values.unit, what)

    light = spectra(flux)
    assert light is not None
    return (
        tuple(one for values in time if (one := single(values)) is not None), light, spectra(error), spectra(quality),
        single(exposure), single(temperature), Values.of(wavelength.name, pixels, wavelength.unit, what),
    )  # fmt: skip
