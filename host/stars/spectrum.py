"""Computations with the points of a spectrum: photometry in embedded bands, checks, noise, continuation of its ends.

The photometry equals synphot's to the last bit (tested): photons per Angstrom are linear between the points of a
spectrum, and integrals are trapezoidal over the union of the points of spectrum and band. Importing synphot would take
longer than everything else that a star needs.
"""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, Literal

import astropy.units as u
import numpy as np
from astropy.constants import c, h

from mauvecl.host.arrays import PER_MAD, Bool, Float, array_cache, true_runs
from mauvecl.host.stars.library import known_band, spectrum_table
from mauvecl.host.tables.files import Numbers
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.host.instrument.instrument import LineSpread


#: Magnitude systems: that of catalogues in the band, Vega at zero in every band, or AB.
System = Literal["catalogue", "vega", "ab"]
#: Fraction of a band's throughput that a spectrum must cover.
COVERAGE = 0.99
#: Unit of flux densities.
FLUX_UNIT = u.erg / (u.s * u.cm**2 * u.AA)
#: Angstrom per nanometre, with astropy's rounding.
ANGSTROM = float(u.nm.to(u.AA))
#: h c in erg Angstrom, with astropy's rounding.
HC = float(h.cgs.value * c.to_value(u.AA / u.s))
#: Distance up to which two wavelengths count as one, Angstrom (synphot).
SAME_WAVELENGTH_A = 1e-12
#: AB = 0, erg s-1 cm-2 Hz-1 (Oke & Gunn 1983, doi 10.1086/160817: -48.60).
AB_ZERO = 10.0 ** (48.6 / -2.5)


@cache
def band(name: str) -> Numbers:
    """Return wavelengths, nm, and throughput per photon of a band, given its name or alias in any case.

    The metadata are its name, the system of catalogues in it ("AB" or "Vega"), and Vega's magnitude in the latter.
    """
    return spectrum_table(f"{known_band(name).lower().replace(' ', '_')}.ecsv", "bands")


def magnitude_scale(name: str, system: System = "catalogue") -> str:
    """Return a sentence that explains the magnitudes of a system in a band."""
    meta = band(name).meta
    meaning = "AB" if meta["system"] == "AB" else f"Vega has {meta['vega']:g}"
    meanings = {"vega": "have Vega at 0, unlike catalogues'", "ab": "are AB"}
    return f"Magnitudes in {meta['name']} {meanings.get(system, f'are as in catalogues: {meaning}')}."


@array_cache(256)
def magnitude(wavelength_nm: Float, flux_flam: Float, name: str = "V", system: System = "catalogue") -> float:
    """Return the synthetic magnitude of a flux, erg s-1 cm-2 A-1, in the band of a name or alias.

    Raises InputError if the spectrum does not cover the band or has no light in it.
    """
    chosen = _covered(wavelength_nm, name)
    grid = np.union1d(wavelength_nm, chosen["wavelength"]) * 10.0
    star = _photon_rate(grid, *_photon_density(wavelength_nm, flux_flam, chosen), chosen)
    if not star > 0.0:
        raise InputError(f"the spectrum must have light in the band {chosen.meta['name']}, but has none", key="band")
    if system == "ab" or (system == "catalogue" and chosen.meta["system"] == "AB"):
        # The mean flux per wavelength, converted at the pivot wavelength.
        at, through = chosen["wavelength"] * ANGSTROM, chosen["throughput"]
        pivot = float(np.sqrt(np.trapezoid(through * at, at) / np.trapezoid(through / at, at)))
        mean = HC * star / float(np.trapezoid(grid * _interpolate(grid, at, through), grid))
        return -2.5 * math.log10(mean * pivot**2 / c.to_value(u.AA / u.s) / AB_ZERO)
    vega = spectrum_table("vega.ecsv")
    zero = math.log10(photons(vega["wavelength"], vega["flux"], chosen.meta["name"]))
    return 2.5 * (zero - math.log10(star)) + (float(chosen.meta["vega"]) if system == "catalogue" else 0.0)


@array_cache(256)
def photons(wavelength_nm: Float, flux_flam: Float, name: str) -> float:
    """Return the photons s-1 cm-2 in a band, weighted by its throughput; see `magnitude`."""
    chosen = _covered(wavelength_nm, name)
    at, light = _photon_density(wavelength_nm, flux_flam, chosen)
    grid = np.union1d(at, chosen["wavelength"] * ANGSTROM)
    return _photon_rate(grid[np.append(np.diff(grid) > SAME_WAVELENGTH_A, True)], at, light, chosen)


def _covered(wavelength_nm: Float, name: str) -> Numbers:
    """Return a band; raises InputError if the spectrum does not cover it."""
    chosen = band(name)
    inside = (chosen["wavelength"] >= wavelength_nm[0]) & (chosen["wavelength"] <= wavelength_nm[-1])
    covered, total = np.trapezoid([chosen["throughput"] * inside, chosen["throughput"]], chosen["wavelength"])
    share = covered / total
    if share < COVERAGE:
        band_nm, star_nm = (f"({nm[0]:.0f}-{nm[-1]:.0f} nm)" for nm in (chosen["wavelength"], wavelength_nm))
        needed = f"{COVERAGE:.0%} of the band {chosen.meta['name']} {band_nm}"
        raise InputError(f"the spectrum must cover {needed}, but covers {share:.0%} {star_nm}", key="band")
    return chosen


def _photon_density(wavelength_nm: Float, flux_flam: Float, chosen: Numbers) -> tuple[Float, Float]:
    """Return wavelengths, Angstrom, and photon flux densities, photons s-1 cm-2 A-1."""
    at = wavelength_nm * ANGSTROM
    light = flux_flam * at / HC
    transmitted = chosen["wavelength"][chosen["throughput"] > 0.0] * ANGSTROM
    if at[0] <= transmitted[0] and transmitted[-1] <= at[-1]:
        return at, light
    # A spectrum that ends within the band falls to zero over one more step of the same ratio, as in synphot.
    before, after = at[0] ** 2 / at[1], at[-1] ** 2 / at[-2]
    return np.array([before, *at, after]), np.array([0.0, *light, 0.0])


def _photon_rate(grid: Float, at: Float, light: Float, chosen: Numbers) -> float:
    """Integrate photons s-1 cm-2 in a band by the trapezoidal rule on a grid in Angstrom."""
    through = _interpolate(grid, chosen["wavelength"] * ANGSTROM, chosen["throughput"])
    return float(np.trapezoid(_interpolate(grid, at, light) * through, grid))


def _interpolate(grid: Float, at: Float, values: Float) -> Float:
    """Interpolate linearly and extend by the end values, with the rounding of scipy's `interpn` (synphot's choice)."""
    after = np.clip(np.searchsorted(at, grid, side="right"), 1, at.size - 1)
    share = np.clip((grid - at[after - 1]) / (at[after] - at[after - 1]), 0.0, 1.0)
    return np.asarray(values[after - 1] * (1.0 - share) + values[after] * share)


#: Range of the nominal instrument, nm (the paper's abstract).
NEEDED_NM = (200.0, 700.0)
#: The same, extended by the reach of the line spread function (the paper, section "Preparing the input spectrum").
SPAN_NM = (180.0, 750.0)
#: Fraction of `NEEDED_NM` that a spectrum must cover; with less, nearly all of the light would be another star's.
MIN_MEASURED = 1 / 3
#: Range of wavelengths, nm, outside which an assumed unit is unlikely.
PLAUSIBLE_NM = (50.0, 10_000.0)
#: A step between points is a gap if it exceeds this width, nm, and this multiple of the usual spacing.
GAP_NM, GAP_TIMES = 10.5, 10.0
#: Likely units of wavelengths without a stated unit, in nm.
_USUAL_UNITS = {"nm": 1.0, "Angstrom": 0.1, "um": 1000.0}


def measured_part(nm: Float) -> float:
    """Return the fraction of `NEEDED_NM` that at least two wavelengths cover, without gaps."""
    steps = np.diff(np.clip(nm, *NEEDED_NM))[~is_gap(np.diff(nm))]
    return float(steps.sum() / (NEEDED_NM[1] - NEEDED_NM[0]))


def is_gap(steps: Float) -> Bool:
    """Return which of the steps between wavelengths, nm, are gaps."""
    wide: Bool = (steps > GAP_NM) & (steps > GAP_TIMES * np.median(steps))
    return wide


def likely_unit(low: float, high: float, unit: str) -> str | None:
    """Return the only unit other than `unit` in which the numbers cover the required range, or None."""
    ends = np.array([low, high])
    shares = {name: measured_part(ends * factor) for name, factor in _USUAL_UNITS.items() if name != unit}
    fitting = [name for name, share in shares.items() if share >= MIN_MEASURED and low > 0.0]
    # Short ultraviolet spectra cover part of the range in Angstrom, but would start in the infrared in nm.
    if not fitting and shares.get("Angstrom", 0.0) > 0.0 and low > 900.0:
        fitting = ["Angstrom"]
    return fitting[0] if len(fitting) == 1 else None


def check_assumed_unit(values: Float, unit: str) -> None:
    """Raise InputError if another unit of the wavelengths is as likely as the assumed one."""
    finite = values[np.isfinite(values)]
    if not finite.size or unit not in _USUAL_UNITS:
        return
    ends, factor = np.array([finite.min(), finite.max()]), _USUAL_UNITS[unit]
    low, high = ends
    covered, likely = measured_part(ends * factor), likely_unit(low, high, unit)
    in_likely = 0.0 if likely is None else measured_part(ends * _USUAL_UNITS[likely])
    fault = f"wavelengths from {low:g} to {high:g} without a stated unit"
    needed, remedy = f"of {NEEDED_NM[0]:g}-{NEEDED_NM[1]:g} nm", "give their unit: `wavelength_unit"
    if likely is not None and (covered < MIN_MEASURED or in_likely >= max(covered, 1.0 - 1e-9)):
        fault += f" look like {likely}, in which they cover {in_likely:.0%} {needed}, and {covered:.0%} in {unit}"
        alternative = f" or `wavelength_unit={unit!r}`" if covered >= MIN_MEASURED else ""
        raise InputError(f"{fault}; {remedy}={likely!r}`{alternative}", key="wavelength_unit")
    if covered < MIN_MEASURED:
        fault += f" cover {covered:.0%} {needed}, not at least a third, in {unit}"
    elif low * factor < PLAUSIBLE_NM[0] or high * factor > PLAUSIBLE_NM[1]:
        fault += f" extend beyond {PLAUSIBLE_NM[0]:g}-{PLAUSIBLE_NM[1]:g} nm in {unit}"
    else:
        return
    raise InputError(f"{fault}; {remedy}` names it", key="wavelength_unit")


#: Range of wavelengths, nm, from gamma rays to metre waves, whose products stay within double precision.
NEAREST_NM, FARTHEST_NM = 1e-6, 1e9
#: Smallest relative distance of two wavelengths; each conversion rounds by about 1e-16.
CLOSEST = 1e-12
#: Range of a spectrum's largest flux, erg s-1 cm-2 A-1, from 1e-21 for the faintest stars to 1e10 at a white dwarf's
#: surface, with margins.
FAINTEST, BRIGHTEST = 1e-40, 1e30
#: Largest fraction of the brightest pixel's light that a continuation may add to the outermost pixel (a choice).
MAX_CONTINUED = 0.01
#: Number of neighbouring points from whose scatter the noise of a point is estimated.
WINDOW = 51
#: Widths over which a level at an end or join, and the brightest flux (a resolution element), are averaged, nm.
END_NM, JOIN_NM, ELEMENT_NM = 5.0, 10.0, 10.5
#: Smallest ratio of a level to its error for which another spectrum can be scaled to it.
MIN_JOIN_SNR = 5.0


def check_points(name: str, wavelength: Float, flux: Float) -> None:
    """Raise InputError for points, nm and erg s-1 cm-2 A-1, of unequal number, out of range or not increasing."""
    if wavelength.ndim != 1 or wavelength.shape != flux.shape or wavelength.size < 2:
        fault = f"spectrum {name} has {wavelength.shape} wavelengths and {flux.shape} fluxes"
        raise InputError(f"{fault}, but needs two equal columns of at least two points", key="flux")
    outside = np.flatnonzero(~((wavelength >= NEAREST_NM) & (wavelength <= FARTHEST_NM)))
    if outside.size:
        where, accepted = f"spectrum {name}, point {outside[0] + 1}", f"between {NEAREST_NM:g} and {FARTHEST_NM:g} nm"
        raise InputError.of("wavelength", wavelength[outside[0]], accepted, where=where)
    back = np.flatnonzero(np.diff(wavelength) < CLOSEST * wavelength[1:])
    if back.size:
        i = int(back[0])
        pair = f"{float(wavelength[i + 1])!r} nm at point {i + 2} follows {float(wavelength[i])!r} nm"
        fault = f"spectrum {name}: wavelengths must increase, by at least {CLOSEST:g} of their value"
        raise InputError(f"{fault}, but {pair}", key="wavelength")
    # Undefined ends are cut later.
    largest = float(np.abs(flux[np.isfinite(flux)]).max(initial=0.0))
    if largest and not FAINTEST <= largest <= BRIGHTEST:
        raise InputError.of("flux", largest, f"{FAINTEST:g} to {BRIGHTEST:g}", where=f"spectrum {name}, largest value")


def check_measured(name: str, wavelength: Float, unit: str = "nm") -> None:
    """Raise InputError if a spectrum itself covers less than a third of 200-700 nm; `unit` is that of its file."""
    covered = measured_part(wavelength)
    if covered >= MIN_MEASURED - 1e-9:
        return
    low, high = float(wavelength[0]), float(wavelength[-1])
    likely = likely_unit(low, high, "nm") if unit == "nm" else None
    meant = f"; as numbers these look like {likely}: `wavelength_unit={likely!r}`" if likely else ""
    fault = f"spectrum {name} covers {low:g}-{high:g} nm, {covered:.0%} of {NEEDED_NM[0]:g}-{NEEDED_NM[1]:g} nm"
    raise InputError(f"{fault}, but needs at least a third, which `extend` can continue{meant}", key="extend")


def cut_undefined_ends(name: str, wavelength: Float, flux: Float) -> tuple[Float, Float, tuple[str, ...]]:
    """Cut ends outside 200-700 nm at their innermost undefined point, and return a note."""
    bad = ~np.isfinite(flux)
    if not bad.any():
        return wavelength, flux, ()
    low, high = (np.flatnonzero(bad & side) for side in (wavelength < NEEDED_NM[0], wavelength > NEEDED_NM[1]))
    start = int(low[-1]) + 1 if low.size else 0
    stop = int(high[0]) if high.size else wavelength.size
    defined = wavelength[start:stop]
    if defined.size < 2:
        raise InputError(f"spectrum {name} needs defined fluxes in {NEEDED_NM[0]:g}-{NEEDED_NM[1]:g} nm", key="flux")
    note = f"cut to {defined[0]:.1f}-{defined[-1]:.1f} nm: undefined flux beyond"
    return defined, flux[start:stop], (note,)


def check_flux(name: str, wavelength: Float, flux: Float) -> None:
    """Raise InputError for fluxes that are not finite, are all zero, or contain marks of missing values."""
    bad = np.flatnonzero(~np.isfinite(flux))
    if bad.size:
        i = int(bad[0])
        where = f"spectrum {name}, point {i + 1} at {wavelength[i]:g} nm"
        raise InputError.of("flux", flux[i], "a finite number", where=where)
    inside = (wavelength >= NEEDED_NM[0]) & (wavelength <= NEEDED_NM[1])
    most, least = (float(f(flux[inside])) if inside.any() else 0.0 for f in (np.max, np.min))
    if max(abs(most), abs(least)) > BRIGHTEST or 0.0 < most < FAINTEST:
        fault = f"spectrum {name}: the highest flux in 200-700 nm is {most:.3g} and the lowest {least:.3g} erg/s/cm2/A"
        raise InputError(f"{fault}, but fluxes must reach {FAINTEST:g} and not exceed {BRIGHTEST:g}", key="flux")
    if most <= 0.0:
        reason = "every flux is zero" if not flux.any() else f"the highest flux there is {most:g}"
        raise InputError(f"spectrum {name} must have light in 200-700 nm, but {reason}", key="flux")
    if least < -most:
        at = wavelength[inside][int(np.argmin(flux[inside]))]
        fault = f"flux {least:g} at {at:g} nm must not lie farther below zero than any in 200-700 nm lies above"
        raise InputError(f"spectrum {name}: {fault}; the value may mark a missing measurement", key="flux")


def remarks(wavelength: Float, flux: Float) -> tuple[str, ...]:
    """Return messages about a spectrum's points in 180-750 nm: negative fluxes, zeros in a row, gaps."""
    inside = (wavelength >= SPAN_NM[0]) & (wavelength <= SPAN_NM[1])
    nm, values = wavelength[inside], flux[inside]
    messages = []
    negative = int(np.count_nonzero(values < 0.0))
    if negative:
        i = int(np.argmin(values))
        messages.append(
            f"{negative} of its {nm.size} points in {SPAN_NM[0]:g}-{SPAN_NM[1]:g} nm "
            f"{'has' if negative == 1 else 'have'} a negative flux, the lowest {values[i]:.3g} at {nm[i]:.1f} nm: "
            "measured noise, kept; `bin_nm` bins it"
        )
    # Runs of at least three zeros are not measurements.
    first, stop = true_runs(values == 0.0).T
    runs = zip(nm[first], nm[stop - 1], stop - first, strict=True)
    dark = [(low, high) for low, high, n in runs if n >= 3 and high >= NEEDED_NM[0] and low <= NEEDED_NM[1]]
    if dark:
        where = ", ".join(f"{low:.1f}-{high:.1f}" for low, high in dark[:3])
        messages.append(f"its flux is exactly zero at {where} nm: no data, or no light")
    steps = np.diff(nm)
    if steps.size and (wide := is_gap(steps)).any():
        i = int(np.argmax(np.where(wide, steps, 0.0)))
        messages.append(f"it has no point between {nm[i]:.1f} and {nm[i + 1]:.1f} nm, where its flux is interpolated")
    return tuple(messages)


def continue_ends(
    name: str,
    wavelength: Float,
    flux: Float,
    needed_nm: tuple[float, float] = NEEDED_NM,
    line: LineSpread | None = None,
    *,
    dark_only: bool = False,
) -> tuple[Float, Float, tuple[str, ...]]:
    """Continue the ends of a spectrum at their level, within reach of the line spread function, and return messages.

    `needed_nm` is the range of the pixels; the line spread function, by default that of the nominal instrument, reaches
    beyond it as `SPAN_NM` beyond `NEEDED_NM`. With `dark_only`, ends that are too bright or within the range of the
    pixels are left unchanged; otherwise a continuation must be at most `MAX_CONTINUED` of the brightest pixel's light.
    """
    span = (needed_nm[0] - NEEDED_NM[0] + SPAN_NM[0], needed_nm[1] - NEEDED_NM[1] + SPAN_NM[1])
    if wavelength[0] <= span[0] and wavelength[-1] >= span[1]:
        return wavelength, flux, ()
    if line is None:
        from mauvecl.host.instrument.instrument import Instrument, LineSpread

        line = LineSpread.of(Instrument.load("mauve"))
    messages = []
    edges = np.arange(needed_nm[0], needed_nm[1] + 0.1, ELEMENT_NM)
    brightest = max(float(mean_fluxes(wavelength, flux, edges).max()), np.finfo(float).tiny)
    for side, sign, word in ((0, 1, "starts"), (-1, -1, "ends")):
        end, goal = wavelength[side], span[side]
        if sign * (end - goal) <= 0:
            continue
        near = np.abs(wavelength - end) <= END_NM
        level = max(float(flux[near].mean()), 0.0)
        # Light in the outermost pixel from beyond the end.
        beyond = sign * (end - needed_nm[side])
        share = float(line.below(np.array([beyond]))[0]) * level / brightest
        if dark_only and (beyond > 0 or share > MAX_CONTINUED):
            continue
        if share > MAX_CONTINUED:
            invented = f"{share:.1%} of the brightest pixel's light would be invented"
            fault = f"spectrum {name} must reach {goal:g} nm, but {word} at {end:g} nm, where it is bright: {invented}"
            raise InputError(f"{fault}; `extend` continues it by a library spectrum", key="extend")
        messages.append(
            f"it {word} at {end:g} nm and is continued to {goal:g} nm at its end's level, {level:.3g}: at most "
            f"{100 * share:.2g} % of the brightest pixel's light"
        )
        wavelength, flux = attach(wavelength, goal, side == 0), attach(flux, level, side == 0)
    return wavelength, flux, tuple(messages)


def attach(values: Float, more: Float | float, before: bool) -> Float:
    """Return values with more of them before or after."""
    return np.append(more, values) if before else np.append(values, more)


def supplement(nm: Float, more_nm: Float, apart_nm: float) -> Float:
    """Return wavelengths supplemented by more within their range that are not next to one of them."""
    inside = more_nm[(more_nm > nm[0]) & (more_nm < nm[-1])]
    after = np.searchsorted(nm, inside)
    is_new = np.minimum(nm[after] - inside, inside - nm[after - 1]) > apart_nm
    return np.union1d(nm, inside[is_new]) if is_new.any() else nm


def mean_fluxes(wavelength: Float, flux: Float, edges: Float) -> Float:
    """Return the mean fluxes between edges of a piecewise linear flux, shape (n_edge - 1,)."""
    grid = np.union1d(wavelength, edges)
    values = np.interp(grid, wavelength, flux)
    area = np.concatenate([[0.0], np.cumsum(np.diff(grid) * (values[1:] + values[:-1]) / 2)])
    mean: Float = np.diff(area[np.searchsorted(grid, edges)]) / np.diff(edges)
    return mean


def extend(
    name: str, wavelength: Float, flux: Float, extension: tuple[str, Float, Float], ultraviolet: tuple[str, ...]
) -> tuple[Float, Float, tuple[str, ...]]:
    """Continue a spectrum by a longer one (name, wavelengths, fluxes), scaled at the join, and return messages.

    They include those on the `ultraviolet` of the extension if it continues the spectrum to the blue.
    """
    longer, nm, level = extension
    messages = []
    # Consecutive zeros at an end are missing data.
    light = np.flatnonzero(flux != 0.0)
    if light.size > 1 and light[-1] - light[0] + 1 < flux.size:
        wavelength, flux = (array[light[0] : light[-1] + 1] for array in (wavelength, flux))
        messages.append(f"its ends of zeros are cut: {wavelength[0]:g}-{wavelength[-1]:g} nm remain")
    check_measured(name, wavelength)
    for blue in (True, False):
        end = float(wavelength[0] if blue else wavelength[-1])
        more = nm < end if blue else nm > end
        if not more.any():
            continue
        join, scale = _join(f"spectrum {name} and its extension {longer}", (wavelength, flux), (nm, level), blue)
        messages.append(
            f"{'below' if blue else 'above'} {end:g} nm it is continued by {longer}, scaled by {scale:.4g} to "
            f"agree at {join[0]:g}-{join[1]:g} nm"
        )
        if blue:
            messages += [f"in {longer}, {message}" for message in ultraviolet]
        wavelength, flux = attach(wavelength, nm[more], blue), attach(flux, level[more] * scale, blue)
    return wavelength, flux, tuple(messages) or (f"its extension {longer} reaches no farther and is not used",)


def _join(title: str, first: tuple[Float, Float], second: tuple[Float, Float], blue: bool) -> tuple[Float, float]:
    """Return the range in which two spectra are compared, widened by the noise of the first, and their ratio there."""
    low, high = max(first[0][0], second[0][0]), min(first[0][-1], second[0][-1])
    if not low < high:
        spans = (f"{nm[0]:g}-{nm[-1]:g} nm" for nm, _ in (first, second))
        raise InputError(f"{title} must overlap, but span {' and '.join(spans)}", key="extend")
    noise = point_noise(first[1])
    for width in JOIN_NM * 2.0 ** np.arange(6):
        join = np.clip([low, low + width] if blue else [high - width, high], low, high)
        level, longer = (float(mean_fluxes(nm, light, join)[0]) for nm, light in (first, second))
        near = (first[0] >= join[0]) & (first[0] <= join[1])
        error = float(np.sqrt(np.sum(noise[near] ** 2))) / max(int(near.sum()), 1)
        if level > MIN_JOIN_SNR * error and longer > 0.0 and np.isfinite(level / longer):
            return join, level / longer
    fault = f"{title} must both have light to scale by, but have mean fluxes of {level:g} and {longer:g}"
    raise InputError(f"{fault} at {join[0]:g}-{join[1]:g} nm", key="extend")


def point_noise(flux_flam: Float) -> Float:
    """Return the standard deviation of each point from the scatter around it, shape (n,).

    The median of |2 F_i - F_(i-2) - F_(i+2)| is sqrt(6) / PER_MAD of a point's error (Stoehr et al. 2008, ASP
    Conf. Ser. 394, 505). Adjacent points are not used, since their errors are correlated.
    """
    from scipy.ndimage import median_filter

    if flux_flam.size < 5:
        return np.zeros_like(flux_flam)
    second = np.abs(2 * flux_flam[2:-2] - flux_flam[:-4] - flux_flam[4:])
    scatter = median_filter(np.pad(second, 2, mode="edge"), size=WINDOW, mode="nearest")
    return np.asarray(PER_MAD / np.sqrt(6.0) * scatter)
