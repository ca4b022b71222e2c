"""The ends of a spectrum: what it must span, what may be continued, and by what."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .columns import NEEDED_NM, looks_like
from .scatter import point_noise
from .values import BRIGHTEST, FAINTEST, check_values

if TYPE_CHECKING:
    from ..instrument.line import Line

Float = NDArray[np.float64]

#: What the line function reaches from `NEEDED_NM`, nm (the paper, section "Preparing the input spectrum").
SPAN_NM = (180.0, 750.0)
#: Light that the outermost pixel may be given by a continuation, in parts of the brightest's: a choice of ours.
MOST_CONTINUED = 0.01
#: Width over which a level is taken, at an end or at a join, nm; and of the brightest, a resolution element.
END_NM, JOIN_NM, ELEMENT_NM = 5.0, 10.0, 10.5
#: A level to scale by must be so many times its error.
JOIN_ERRORS = 5.0
#: A gap between points is told beyond this width, nm, and this multiple of the usual spacing.
GAP_NM, GAP_TIMES = 10.5, 10.0


def check_points(name: str, wavelength: Float, flux: Float) -> None:
    """Refuse what is no spectrum: two equal columns, wavelengths finite and rising.

    Raises
    ------
    InputError
    """
    if wavelength.ndim != 1 or wavelength.shape != flux.shape or wavelength.size < 2:
        raise InputError(
            f"spectrum {name} has {wavelength.shape} wavelengths and {flux.shape} fluxes, expected two equal columns"
        )
    bad = np.flatnonzero(~(np.isfinite(wavelength) & (wavelength > 0.0)))
    if bad.size:
        raise InputError(
            f"spectrum {name}: wavelength {wavelength[bad[0]]:g} at point {bad[0] + 1}, expected a finite number "
            "above 0"
        )
    # Steps below the rounding of a change of units are none.
    back = np.flatnonzero(np.diff(wavelength) <= 0)
    if back.size:
        i = int(back[0])
        raise InputError(
            f"spectrum {name}: wavelength {wavelength[i + 1]:g} nm at point {i + 2} follows {wavelength[i]:g} nm, "
            "expected increasing wavelengths"
        )
    check_values(name, wavelength, flux)


def check_span(name: str, wavelength: Float, extra: str = "") -> None:
    """Refuse a spectrum that does not hold all that is needed.

    Raises
    ------
    InputError
    """
    low, high = float(wavelength[0]), float(wavelength[-1])
    if low > NEEDED_NM[0] or high < NEEDED_NM[1]:
        raise InputError(
            f"spectrum {name} spans {low:g}-{high:g} nm{extra}, expected at least {NEEDED_NM[0]:g}-{NEEDED_NM[1]:g} "
            f"nm{looks_like(low, high)}: --extend continues it by a library spectrum"
        )


def without_undefined_ends(name: str, wavelength: Float, flux: Float) -> tuple[Float, Float, tuple[str, ...]]:
    """Leave out the ends from their innermost undefined point on, outside what is needed, and say so."""
    bad = ~np.isfinite(flux)
    if not bad.any():
        return wavelength, flux, ()
    low, high = (np.flatnonzero(bad & side) for side in (wavelength < NEEDED_NM[0], wavelength > NEEDED_NM[1]))
    start = int(low[-1]) + 1 if low.size else 0
    stop = int(high[0]) if high.size else wavelength.size
    kept = wavelength[start:stop]
    if kept.size < 2:
        raise InputError(f"spectrum {name} has no defined flux in {NEEDED_NM[0]:g}-{NEEDED_NM[1]:g} nm, expected some")
    note = f"cut to {kept[0]:.1f}-{kept[-1]:.1f} nm: undefined flux beyond"
    return kept, flux[start:stop], (note,)


def check_flux(name: str, wavelength: Float, flux: Float) -> None:
    """Refuse fluxes that are no numbers, hold no light, or signs for missing ones.

    Raises
    ------
    InputError
    """
    bad = np.flatnonzero(~np.isfinite(flux))
    if bad.size:
        i = int(bad[0])
        raise InputError(
            f"spectrum {name}: flux {flux[i]} at point {i + 1}, {wavelength[i]:g} nm, expected a finite number"
        )
    inside = (wavelength >= NEEDED_NM[0]) & (wavelength <= NEEDED_NM[1])
    most, least = (float(f(flux[inside])) if inside.any() else 0.0 for f in (np.max, np.min))
    if max(abs(most), abs(least)) > BRIGHTEST or 0.0 < most < FAINTEST:
        raise InputError(
            f"spectrum {name}: the highest flux in 200-700 nm is {most:.3g} and the lowest {least:.3g} erg/s/cm2/A, "
            f"expected {FAINTEST:g} to {BRIGHTEST:g}"
        )
    if most <= 0.0:
        what = "every flux is zero" if not flux.any() else f"no flux in 200-700 nm is above zero, the highest {most:g}"
        raise InputError(f"spectrum {name}: {what}, expected some light")
    if least < -most:
        at = wavelength[inside][int(np.argmin(flux[inside]))]
        raise InputError(
            f"spectrum {name}: flux {least:g} at {at:g} nm lies farther below zero than any in 200-700 nm lies above, "
            "expected measured noise at most: it may stand for no measurement"
        )


def remarks(wavelength: Float, flux: Float) -> tuple[str, ...]:
    """What an answer must say of a spectrum's points in the span: negative ones, zeros in a row, gaps."""
    inside = (wavelength >= SPAN_NM[0]) & (wavelength <= SPAN_NM[1])
    nm, values = wavelength[inside], flux[inside]
    told = []
    negative = int(np.count_nonzero(values < 0.0))
    if negative:
        i = int(np.argmin(values))
        told.append(
            f"{negative} of its {nm.size} points in {SPAN_NM[0]:g}-{SPAN_NM[1]:g} nm have a negative flux, the lowest "
            f"{values[i]:.3g} at {nm[i]:.1f} nm: measured noise, kept; --bin-nm bins it"
        )
    # Runs of at least three zeros are no measurement of light.
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (values == 0.0).astype(np.int8), [0]])))
    runs = [
        (a, b) for a, b in edges.reshape(-1, 2) if b - a >= 3 and nm[b - 1] >= NEEDED_NM[0] and nm[a] <= NEEDED_NM[1]
    ]
    if runs:
        where = ", ".join(f"{nm[a]:.1f}-{nm[b - 1]:.1f}" for a, b in runs[:3])
        told.append(f"its flux is exactly zero at {where} nm: no data, or no light")
    steps = np.diff(nm)
    if steps.size:
        wide = np.flatnonzero((steps > GAP_NM) & (steps > GAP_TIMES * np.median(steps)))
        if wide.size:
            i = int(wide[np.argmax(steps[wide])])
            told.append(f"it has no point between {nm[i]:.1f} and {nm[i + 1]:.1f} nm, where a straight line is taken")
    return tuple(told)


@cache
def _line() -> Line:
    from ..instrument.instrument import Instrument
    from ..instrument.line import Line

    return Line.of(Instrument.load("mauve"))


def continued(name: str, wavelength: Float, flux: Float) -> tuple[Float, Float, tuple[str, ...]]:
    """A spectrum that ends within the line function's reach, continued at the level of its end, which is told.

    Raises
    ------
    InputError
        If the light so made up would matter, and another spectrum must say how it goes on.
    """
    if wavelength[0] <= SPAN_NM[0] and wavelength[-1] >= SPAN_NM[1]:
        return wavelength, flux, ()
    check_span(name, wavelength)
    told = []
    brightest = _brightest(wavelength, flux)
    for blue in (True, False):
        end, goal = (wavelength[0], SPAN_NM[0]) if blue else (wavelength[-1], SPAN_NM[1])
        if (end <= goal) if blue else (end >= goal):
            continue
        near = np.abs(wavelength - end) <= END_NM
        level = max(float(flux[near].mean()), 0.0)
        # Light of the outermost pixel that comes from beyond the end.
        beyond = end - NEEDED_NM[0] if blue else NEEDED_NM[1] - end
        share = float(_line().below(np.array([beyond]))[0]) * level / brightest
        word = "starts" if blue else "ends"
        if share > MOST_CONTINUED:
            raise InputError(
                f"spectrum {name} {word} at {end:g} nm, where it is bright: {share:.1%} of the brightest pixel's light "
                f"would be made up, expected a spectrum to {goal:g} nm: --extend continues it by a library spectrum"
            )
        told.append(
            f"it {word} at {end:g} nm and is continued to {goal:g} nm at its end's level, {level:.3g}: at most "
            f"{100 * share:.2g} % of the brightest pixel's light"
        )
        wavelength, flux = (
            (np.append(goal, wavelength), np.append(level, flux))
            if blue
            else (np.append(wavelength, goal), np.append(flux, level))
        )
    return wavelength, flux, tuple(told)


def _brightest(wavelength: Float, flux: Float) -> float:
    """Highest mean over a resolution element in what is needed."""
    edges = np.arange(NEEDED_NM[0], NEEDED_NM[1] + 0.1, ELEMENT_NM)
    return max(float(means(wavelength, flux, edges).max()), np.finfo(float).tiny)


def means(wavelength: Float, flux: Float, edges: Float) -> Float:
    """Mean fluxes between edges, of a flux that is straight between its points; shape (n_edge - 1,)."""
    grid = np.union1d(wavelength, edges)
    values = np.interp(grid, wavelength, flux)
    area = np.concatenate([[0.0], np.cumsum(np.diff(grid) * (values[1:] + values[:-1]) / 2)])
    mean: Float = np.diff(area[np.searchsorted(grid, edges)]) / np.diff(edges)
    return mean


def extended(
    name: str, wavelength: Float, flux: Float, extension: str, beyond: Float, shape: Float
) -> tuple[Float, Float, tuple[str, ...]]:
    """A spectrum with another's ends where that one reaches farther, scaled to it at the join, which is told.

    Parameters
    ----------
    name : str
    wavelength, flux : ndarray, shape (n,)
    extension : str
        The other's name.
    beyond, shape : ndarray, shape (m,)
        Its wavelengths, nm, and fluxes.

    Raises
    ------
    InputError
        If there is no light at a join to scale by.
    """
    told = []
    # Zeros in a row at an end are no data, which another spectrum is asked for.
    light = np.flatnonzero(flux != 0.0)
    if light.size > 1 and light[-1] - light[0] + 1 < flux.size:
        wavelength, flux = (array[light[0] : light[-1] + 1] for array in (wavelength, flux))
        told.append(f"its ends of zeros are cut: {wavelength[0]:g}-{wavelength[-1]:g} nm are left")
    for blue in (True, False):
        end = float(wavelength[0] if blue else wavelength[-1])
        more = beyond < end if blue else beyond > end
        if not more.any():
            continue
        join, own, other = _join(name, wavelength, flux, extension, beyond, shape, blue)
        added = shape[more] * (own / other)
        told.append(
            f"{'below' if blue else 'above'} {end:g} nm it is continued by {extension}, scaled by {own / other:.4g} to "
            f"agree at {join[0]:g}-{join[1]:g} nm"
        )
        wavelength, flux = (
            (np.append(beyond[more], wavelength), np.append(added, flux))
            if blue
            else (np.append(wavelength, beyond[more]), np.append(flux, added))
        )
    return wavelength, flux, tuple(told) or (f"its extension {extension} reaches no farther and is not used",)


def _join(
    name: str, wavelength: Float, flux: Float, extension: str, beyond: Float, shape: Float, blue: bool
) -> tuple[Float, float, float]:
    """The range in which two spectra are compared, as wide as the first one's noise asks, and their means there."""
    low, high = max(wavelength[0], beyond[0]), min(wavelength[-1], beyond[-1])
    if not low < high:
        raise InputError(
            f"spectrum {name} spans {wavelength[0]:g}-{wavelength[-1]:g} nm and its extension {extension} "
            f"{beyond[0]:g}-{beyond[-1]:g} nm, expected them to overlap"
        )
    noise = point_noise(flux)
    for width in JOIN_NM * 2.0 ** np.arange(6):
        join = np.clip([low, low + width] if blue else [high - width, high], low, high)
        own, other = (float(means(x, y, join)[0]) for x, y in ((wavelength, flux), (beyond, shape)))
        near = (wavelength >= join[0]) & (wavelength <= join[1])
        error = float(np.sqrt(np.sum(noise[near] ** 2))) / max(int(near.sum()), 1)
        if own > JOIN_ERRORS * error and other > 0.0 and np.isfinite(own / other):
            return join, own, other
    raise InputError(
        f"spectrum {name} and its extension {extension} have mean fluxes of {own:g} and {other:g} at "
        f"{join[0]:g}-{join[1]:g} nm, expected light in both to scale by"
    )
