"""Spectra reduced to weighted sums piece by piece, for files that are larger than memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.files.size_limits import limit_bytes
from mauvecl.host.tables.table import Values
from mauvecl.observations.frames import dead_pixel_remarks, live_pixels
from mauvecl.schema.errors import InputError

Float = NDArray[np.float64]
#: Light, errors and quality of frames, and remarks.
Light = tuple[Float, Float | None, Float | None, tuple[str, ...]]


@dataclass(frozen=True, eq=False)
class PixelStatistics:
    """Light and noise of each pixel over the frames without a fault, arrays of shape (n_pixel,).

    Attributes
    ----------
    count : ndarray of int
        Frames in which the pixel is finite.
    mean : ndarray
    scatter : ndarray
        Standard deviation of a frame, from differences of neighbouring frames: slow changes have no part in it.
    stated : ndarray or None
        Root of the mean of the squared errors that the file states.
    """

    count: NDArray[np.int64]
    mean: Float
    scatter: Float
    stated: Float | None


@dataclass(frozen=True, eq=False)
class WeightedSums:
    """Weighted sums of the pixels of each frame."""

    sums: Float  # shape (n_frame, n_weight); NaN for frames with a pixel that is not finite
    errors: Float | None  # from the stated errors of the pixels, which are taken to be independent
    pixels: PixelStatistics
    dead: int  # number of pixels that are left out, because they are not finite in most frames

    def light(self, number: int, what: str, quality: Values | None) -> Light:
        """Return the sums of one weight with their errors, the quality of the frames and remarks."""
        error = None if self.errors is None else self.errors[:, number]
        return self.sums[:, number], error, _flags(quality), dead_pixel_remarks(self.dead, what)


def weighted_sums(
    flux: Values, error: Values | None, quality: Values | None, weights: Float | None = None
) -> WeightedSums:
    """Reduce spectra to weighted sums, reading them twice in pieces.

    Parameters
    ----------
    flux, error, quality : Values
        Flux of shape (n_frame, n_pixel); quality of this shape or (n_frame,), zero where nothing is wrong.
    weights : ndarray, shape (n_weight, n_pixel), optional
        By default the sum over all pixels.
    """
    n, n_pixel = flux.shape
    given = np.ones((1, n_pixel)) if weights is None else np.atleast_2d(np.asarray(weights, np.float64))
    if given.shape[1] != n_pixel or not np.isfinite(given).all():
        raise InputError.of("weights", given.shape, f"finite numbers of shape (n_weight, {n_pixel})", where=flux.what)
    statistics, finite = _statistics(flux, error, quality)
    live = live_pixels(finite, n, flux.what)
    sums = np.empty((n, len(given)))
    errors = None if error is None else np.empty_like(sums)
    for part in flux.pieces:
        sums[part] = _piece(flux, quality, part)[:, live] @ given[:, live].T
        if error is not None and errors is not None:
            errors[part] = np.sqrt(error.rows(part.start, part.stop)[:, live] ** 2 @ given[:, live].T ** 2)
    return WeightedSums(sums, errors, statistics, int((~live).sum()))


def _piece(flux: Values, quality: Values | None, part: slice) -> Float:
    """Return rows of spectra, NaN in pixels with their own quality flag."""
    values = flux.rows(part.start, part.stop)
    if quality is not None and len(quality.shape) == 2:
        flags = quality.rows(part.start, part.stop) != 0
        values[flags & ~flags.all(axis=1, keepdims=True)] = np.nan
    return values


def _flags(quality: Values | None) -> Float | None:
    """Return one flag for each frame; of flags for each pixel those of frames in which every pixel has one."""
    if quality is None:
        return None
    if len(quality.shape) == 1:
        return quality.numbers()
    rows = (quality.rows(part.start, part.stop) for part in quality.pieces)
    return np.concatenate([np.where((one != 0).all(axis=1), np.abs(one).max(axis=1), 0.0) for one in rows])


def _statistics(
    flux: Values, error: Values | None, quality: Values | None
) -> tuple[PixelStatistics, NDArray[np.int64]]:
    """Return statistics of frames without a fault, and how often each pixel is finite in any frame."""
    n_pixel = flux.shape[1]
    finite, count, pairs = np.zeros((3, n_pixel), np.int64)
    total, squares, stated = np.zeros((3, n_pixel))
    before = np.full((1, n_pixel), np.nan)
    for part in flux.pieces:
        values = _piece(flux, quality, part)
        finite += np.isfinite(values).sum(axis=0)
        if quality is not None and len(quality.shape) == 1:
            values[quality.rows(part.start, part.stop) != 0] = np.nan
        fine = np.isfinite(values)
        values[~fine] = np.nan
        steps = np.diff(np.concatenate([before, values]), axis=0)
        count += fine.sum(axis=0)
        pairs += np.isfinite(steps).sum(axis=0)
        total += np.nansum(values, axis=0)
        squares += np.nansum(steps**2, axis=0)
        if error is not None:
            stated += np.where(fine, error.rows(part.start, part.stop) ** 2, 0.0).sum(axis=0)
        before = values[-1:].copy()
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, scatter = total / count, np.sqrt(squares / pairs / 2.0)
        return PixelStatistics(count, mean, scatter, None if error is None else np.sqrt(stated / count)), finite


def whole_or_reduced(flux: Values, error: Values | None, quality: Values | None) -> Light:
    """Read light whole if it fits into memory, else reduced to its sum over wavelength."""
    n_bytes = 8 * int(np.prod(flux.shape)) * (1 if error is None else 2)
    limit = limit_bytes("MAUVECL_LARGEST_CONTENT_MIB")
    if len(flux.shape) == 1 or n_bytes <= limit:
        light = np.empty(flux.shape)
        for part in flux.pieces:
            light[part] = _piece(flux, quality, part)
        return light, None if error is None else error.numbers(), _flags(quality), ()
    found = weighted_sums(flux, error, quality)
    remarks = (
        f"{flux.what} has {n_bytes / 2**20:.0f} MiB of spectra, more than {limit >> 20} MiB: they were summed over "
        "wavelength while they were read; MAUVECL_LARGEST_CONTENT_MIB sets the limit",
    )
    light, sd, flags, more = found.light(0, flux.what, quality)
    return light, sd, flags, (*remarks, *more)
