"""Changes between visits: indices of lines, their periods, and the smallest change that is detected.

A visit gives an estimate with a normal error, by generalised least squares with its unknowns marginalised over. Visits
are compared by chi-squared about their mean; for two visits this is the two-sided test of their difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike

from mauvecl.detection.distributions import Interval, clopper_pearson
from mauvecl.detection.nuisances import Nuisances
from mauvecl.fits.flare_model import variance_of
from mauvecl.host.arrays import Float
from mauvecl.host.exposure.expectation import Expectation
from mauvecl.host.exposure.response import W_PER_NM_IN_FLAM, Order, electrons_per_second
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.host.orbit.visibility import Windows
from mauvecl.host.stars.flare import BALMER_EDGE_NM, EmissionLine
from mauvecl.host.stars.source import Source
from mauvecl.host.stars.spectrum import photons
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError, shortened
from mauvecl.schema.fields import DEFAULT_SEED, Positive, Probability, Range, Seed, Unit, Wavelength

#: Frequencies per resolution of the time base.
OVERSAMPLING = 5
#: Smallest number of visits of which a sinusoid with a free mean leaves residuals.
MIN_VISITS = 5
#: Largest number of frequencies.
MAX_FREQUENCIES = 200_000
#: Simulated periodograms beyond the threshold.
IN_TAIL = 20


@dataclass(frozen=True, eq=False)
class PeriodRecovery:
    """Share of sinusoids whose period is recovered."""

    time_d: Float  # shape (n_visit,)
    threshold: float  # power that noise exceeds with the false-alarm probability, anywhere in the periodogram
    periods_d: Float  # shape (n_period,)
    amplitudes: Float  # shape (n_amplitude,); semi-amplitudes in standard errors of a visit
    recovered: list[list[Interval]]  # for each amplitude and period


def visit_times_d(windows: Windows, visits: int, exposure_s: float, seed: int) -> Float:
    """Draw the middles of visits, in days, ascending; they begin at any time from which an exposure fits a window."""
    room = np.maximum(windows.length_s - exposure_s, 0.0)
    if not room.sum() > 0:
        longest = windows.length_s.max(initial=0.0)
        expected = f"at most the longest window, {longest:.0f} s"
        raise InputError.of("observation.exposure_s", exposure_s, expected, unit="s")
    ends = np.cumsum(room)
    places = np.sort(np.random.default_rng(seed).uniform(0.0, ends[-1], visits))
    window = np.searchsorted(ends, places, side="right")
    start = windows.start_s[window] + places - (ends[window] - room[window])
    return np.asarray((start + exposure_s / 2) / 86_400.0)


@validated
def recover_periods(
    time_d: Annotated[Float, Unit("d")],
    periods_d: Annotated[Float, Unit("d")],
    amplitudes: Float,
    *,
    fap: Probability = 0.01,
    trials: Annotated[int, Range(1)] = 100,
    seed: Seed = DEFAULT_SEED,
    shortest_d: Annotated[Positive | None, Unit("d")] = None,
    longest_d: Annotated[Positive | None, Unit("d")] = None,
) -> PeriodRecovery:
    """Simulate how often the period of a sinusoid is found in visits with normal errors of one.

    A period is recovered if the highest peak exceeds the threshold and lies within half of the frequency resolution,
    1 / (2 time base), of the truth.

    Parameters
    ----------
    time_d : ndarray, shape (n_visit,)
    periods_d : ndarray, shape (n_period,)
    amplitudes : ndarray, shape (n_amplitude,)
        Semi-amplitudes in standard errors of a visit.
    fap : float
        Probability that noise exceeds the threshold anywhere in the periodogram, by simulation.
    trials : int
        Sinusoids of random phase for each period and amplitude.
    seed : int
    shortest_d, longest_d : float, optional
        Range of the periodogram; by default that of the periods.
    """
    from astropy.timeseries import LombScargle

    time = np.sort(np.asarray(time_d, np.float64))
    if time.size < MIN_VISITS:
        raise InputError.of("visits", time.size, f"at least {MIN_VISITS}")
    base = float(np.ptp(time))
    if not base > 0:
        raise InputError("visits must have different times, but all have the same", key="time_d")
    frequency = _frequencies(base, 1 / (longest_d or max(periods_d)), 1 / (shortest_d or min(periods_d)))
    generator = np.random.default_rng(seed)

    def peak(light: Float | float) -> tuple[float, float]:
        """Return the highest power in a light curve with noise, and its frequency."""
        values = light + generator.standard_normal(time.size)
        power = LombScargle(time, values).power(frequency, method="fast", assume_regular_frequency=True)
        best = int(np.argmax(power))
        return float(power[best]), float(frequency[best])

    def recovery(amplitude: float, period: float) -> Interval:
        phases = generator.uniform(0, 2 * np.pi, trials)
        peaks = [peak(amplitude * np.sin(2 * np.pi * time / period + phase)) for phase in phases]
        recovered = sum(power > threshold and abs(best - 1 / period) < 0.5 / base for power, best in peaks)
        return clopper_pearson(recovered, trials)

    threshold = float(np.sort([peak(0.0)[0] for _ in range(int(np.ceil(IN_TAIL / fap)))])[-IN_TAIL])
    recovered = [[recovery(amplitude, period) for period in periods_d] for amplitude in amplitudes]
    return PeriodRecovery(time, threshold, np.asarray(periods_d), np.asarray(amplitudes), recovered)


def _frequencies(base: float, low: float, high: float) -> Float:
    """Return the frequencies of a periodogram of visits over a time base, from low to high ones, shape (n,)."""
    step = 1 / (OVERSAMPLING * base)
    # Half a resolution beyond the ends, so that periods at the ends can be recovered.
    count = int(np.ceil((high - low) / step)) + OVERSAMPLING + 1
    if count > MAX_FREQUENCIES:
        fault = f"the periods need {count} frequencies (at most {MAX_FREQUENCIES})"
        raise InputError(f"{fault}; give longer ones or a shorter campaign", key="periods")
    return np.asarray(max(low - 0.5 / base, step) + step * np.arange(count))


#: Smallest share of the information on a change that unknowns may leave; a smaller one is a rounding error.
LEAST_KEPT = 1e-10
#: Share of the largest change of a pixel above which a change concerns a pixel.
LEAST_LIGHT = 1e-3


@dataclass(frozen=True)
class SmallestChanges:
    """Smallest detectable changes, in the unit of the error of a visit."""

    one: float  # difference of one visit from all others
    scatter: float  # standard deviation of a star that differs normally in each visit


@validated
def smallest_change(
    error: Positive, visits: Annotated[int, Range(2)], fap: Probability, power: Probability
) -> SmallestChanges:
    """Compute the smallest detectable changes among visits with equal errors.

    Parameters
    ----------
    error : float
        Standard error of a visit.
    visits : int
    fap : float
        False-alarm probability of the test of all visits.
    power : float
        Detection probability.

    Examples
    --------
    >>> from mauvecl.observations.visits import smallest_change
    >>> round(smallest_change(1.0, 2, 0.05, 0.9).one, 3)
    4.584
    """
    if power <= fap:
        return SmallestChanges(0.0, 0.0)
    dof = visits - 1
    cut = float(scipy.stats.chi2.isf(fap, dof))
    # Non-centrality with which the test exceeds its threshold with this probability.
    centre = scipy.special.chndtrinc(cut, dof, 1.0 - power)
    ratio = cut / float(scipy.stats.chi2.isf(power, dof))
    return SmallestChanges(float(error * np.sqrt(centre * visits / dof)), float(error * np.sqrt(ratio - 1.0)))


def pixels_of(counts_dn: Float, quiet: Expectation) -> tuple[int, int]:
    """Return the number of pixels near saturation among those that a change of the light concerns, and of all these."""
    concerned = np.abs(counts_dn) > LEAST_LIGHT * np.abs(counts_dn).max(initial=0.0)
    return int((concerned & ~variance_of(quiet)[1]).sum()), int(concerned.sum())


def error_of_change(counts_dn: Float, quiet: Expectation, unknown: Nuisances | None) -> float:
    """Return the standard error of the amplitude of a change in one exposure, from pixels that do not saturate.

    `counts_dn` is the DN of the exposure for an amplitude of one. The error is infinite if the unknowns hide the
    change, and NaN if no pixel is left.
    """
    variance, used = variance_of(quiet)
    lost, concerned = pixels_of(counts_dn, quiet)
    if lost == concerned:
        return float("nan")
    delta = np.where(used, counts_dn, 0.0)
    weights = np.divide(delta, variance, out=np.zeros_like(delta), where=used)
    information = without_unknowns = float(weights @ delta)
    if unknown:
        information -= float(np.sum((unknown.rows(variance * used, unknown.spectra * used) @ delta) ** 2))
    return information**-0.5 if information > LEAST_KEPT * without_unknowns > 0 else float("inf")


def error_of_index(weights: Float, quiet: Expectation, unknown: Nuisances | None) -> float:
    """Return the standard deviation of a weighted sum of the pixels of an exposure.

    It is infinite if a free unknown changes the sum, and NaN if a pixel with a weight is near saturation.
    """
    if (weights[~variance_of(quiet)[1]] != 0.0).any():
        return float("nan")
    variance = float(np.sum(weights**2 * quiet.variance_dn2))
    if unknown:
        moved, free = unknown.spectra @ weights, np.isinf(unknown.sd)
        if np.any(np.abs(moved[free]) > 0):
            return float("inf")
        variance += float(np.sum((moved[~free] * unknown.sd[~free]) ** 2))
    return float(np.sqrt(variance))


#: Mg II h and k with the continuum on both sides, for spectra of low resolution such as IUE's (0.6 nm), nm: an
#: assumption; definitions of Mg II indices differ between experiments, and none for stars at this resolution was found.
MG_II_NM = (278.5, 281.5)
MG_II_CONTINUUM_NM = ((275.5, 278.0), (282.0, 284.5))
#: Smallest number of pixels of the continuum, from which a straight line and its scatter follow.
MIN_CONTINUUM = 3


@dataclass(frozen=True, eq=False)
class LineIndex:
    """Lines of one or more spectra."""

    flux: Float  #: integral over the band above the continuum, in the unit of the flux times nm, shape (...)
    error: Float  #: standard error of it; NaN if the spectrum has none
    continuum: Float  #: mean of the continuum over the band
    equivalent_width_nm: Float  #: width of the continuum with the light of the line: positive in emission


def _integral_of_line(x: Float, weight: Float, share: Float) -> Float:
    """Return the factors of pixels in the integral of the straight line fitted to them, shape (..., n_pixel).

    It is a linear function of the pixels, by the weights of the least squares; `share` is the width of each pixel that
    is integrated.
    """
    design = np.stack([np.ones_like(x), x])
    normal = np.einsum("ap,...p,bp->...ab", design, weight, design)
    coefficients = np.linalg.solve(normal, (design @ share)[:, None])[..., 0]
    return np.asarray(np.einsum("...a,ap,...p->...p", coefficients, design, weight))


@validated
def line_index(
    wavelength_nm: Annotated[ArrayLike, Unit("nm")],
    flux: ArrayLike,
    error: ArrayLike | None = None,
    *,
    band_nm: tuple[Wavelength, Wavelength],
    continuum_nm: Sequence[tuple[Wavelength, Wavelength]],
) -> LineIndex:
    """Integrate a line above the straight line through windows of the continuum.

    The index is linear in the fluxes, so that its error follows exactly from those of the pixels, of the continuum's
    as well as of the band's. Pixels across a limit of the band count in part.

    Parameters
    ----------
    wavelength_nm : array_like, shape (n_pixel,)
        Middle of each pixel, ascending.
    flux, error : array_like, shape (..., n_pixel)
        Flux density per nm and its standard error, by which the continuum is weighted. Pixels of the continuum that
        are not finite, or whose error is not positive, are left out.
    band_nm : tuple of float
        Limits of the line.
    continuum_nm : sequence of tuple
        Limits of the windows of the continuum.

    Raises
    ------
    InputError
        If the spectrum does not cover the band, pixels of the band are not finite, or less than three pixels of the
        continuum are left.

    Examples
    --------
    >>> import numpy as np
    >>> from mauvecl.observations.visits import line_index
    >>> nm = np.linspace(270, 290, 201)
    >>> flux = 2.0 + np.exp(-((nm - 280) ** 2) / 2 / 0.3**2) / 0.3 / np.sqrt(2 * np.pi)
    >>> found = line_index(nm, flux, band_nm=(278.5, 281.5), continuum_nm=[(275.5, 278), (282, 284.5)])
    >>> round(float(found.flux), 4)
    1.0
    """
    nm = np.asarray(wavelength_nm, np.float64)
    if nm.ndim != 1 or nm.size < 2 or not (np.diff(nm) > 0).all():
        raise InputError.of("wavelength_nm", nm.shape, "ascending wavelengths of at least two pixels")
    light = np.asarray(flux, np.float64)
    if not light.ndim or light.shape[-1] != nm.size:
        raise InputError.of("flux", light.shape, f"{nm.size} pixels in the last axis")
    if error is not None and np.shape(error) != light.shape:
        raise InputError.of("error", np.shape(error), f"the shape of the flux, {light.shape}")
    sd = np.ones_like(light) if error is None else np.asarray(error, np.float64)
    edges = np.concatenate([[1.5 * nm[0] - nm[1] / 2], (nm[1:] + nm[:-1]) / 2, [1.5 * nm[-1] - nm[-2] / 2]])
    low, high = band_nm
    if not edges[0] <= low < high <= edges[-1]:
        raise InputError.of("band_nm", band_nm, f"ascending limits within {edges[0]:g}-{edges[-1]:g} nm")
    share = np.clip(np.minimum(edges[1:], high) - np.maximum(edges[:-1], low), 0.0, None)
    inside = share > 0
    good = np.isfinite(light) & np.isfinite(sd) & (sd > 0)
    if not good[..., inside].all():
        raise InputError("every pixel in the band needs a finite flux and an error above 0", key="flux")
    in_continuum = good & np.any([(nm >= start) & (nm <= end) for start, end in continuum_nm], axis=0)
    count = int(in_continuum.sum(axis=-1).min(initial=nm.size))
    if count < MIN_CONTINUUM:
        raise InputError(f"the continuum needs {MIN_CONTINUUM} usable pixels or more, not {count}", key="continuum_nm")
    weight = np.where(in_continuum, 1.0 / np.where(in_continuum, sd, 1.0) ** 2, 0.0)
    continuum = _integral_of_line(nm - (low + high) / 2, weight, share)
    light, sd = (np.where(in_continuum | inside, values, 0.0) for values in (light, sd))
    level = (continuum * light).sum(axis=-1)
    index = (share * light).sum(axis=-1) - level
    variance = ((share - continuum) ** 2 * sd**2).sum(axis=-1)
    mean = level / (high - low)
    return LineIndex(index, np.sqrt(variance) if error is not None else np.full_like(index, np.nan), mean, index / mean)


#: Wavelength between the two halves of the colour, nm: the middle of the output range.
COLOUR_NM = 450.0
#: Change of the natural logarithm of a flux for a change of one magnitude.
LOG_PER_MAG = 0.4 * np.log(10.0)
#: Wavelengths of spectra with edges, nm: beyond the reach of the line function, in steps far below the resolution.
GRID_NM = np.linspace(150.0, 760.0, 6101)


@dataclass(frozen=True)
class Index:
    """Definition of a line index: light in a band above a straight continuum."""

    name: str  # as in `EmissionLine.named`
    band_nm: tuple[float, float]
    continuum_nm: tuple[tuple[float, float], ...]
    published: str  # the usual definition for spectra of higher resolution, with its source


#: Indices by name. The bands are an assumption of this project: published ones, of 0.1 to 3 nm, lie within Mauve's line
#: function of 13.3 nm, so that the band is 16 nm about the lines and each continuum 12 nm beyond.
#: The published windows of Ca II and H alpha were compared with the table of ACTIN 2, that of H beta with lists of Lick
#: indices, that of Mg II with the public code of the Mg II index of SUIT; the papers themselves were not read.
INDICES = {
    index.name: index
    for index in (
        Index("Mg II", (272.0, 288.0), ((258.0, 270.0), (290.0, 302.0)),
              "solar index: 4/3 of the sum at 279.8, 280.0 and 280.2 nm over that at 276.6, 276.8, 283.2 and 283.4 nm "
              "(Heath & Schlesinger 1986, J. Geophys. Res. 91, 8672)"),
        Index("Ca II", (387.0, 403.0), ((373.0, 385.0), (405.0, 417.0)),
              "Mount Wilson S: triangles of 0.109 nm (FWHM) at 393.366 and 396.847 nm over 2 nm at 390.107 and "
              "400.107 nm (Duncan et al. 1991, ApJS 76, 383)"),
        Index("H beta", (478.0, 494.0), ((464.0, 476.0), (496.0, 508.0)),
              "Lick: 484.788-487.663 nm, continua 482.788-484.788 and 487.663-489.163 nm (Worthey et al. 1994; "
              "Trager et al. 1998, ApJS 116, 1)"),
        Index("H alpha", (648.0, 664.0), ((634.0, 646.0), (666.0, 678.0)),
              "0.16 nm at 656.281 nm over 1.075 nm at 655.087 and 0.875 nm at 658.031 nm "
              "(Gomes da Silva et al. 2011, arXiv:1109.0321)"),
    )
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Change:
    """A change of a star's spectrum by one unit."""

    name: str
    unit: str  # unit of the change; empty if it is relative
    meaning: str  # meaning of a change of one unit
    counts_dn: Float  # shape (n_pixel,); DN of the exposure that it adds, for a small change

    def size(self, linear: float) -> float:
        """Return the size of a change that brightens, in its unit, from its light over `counts_dn`."""
        return float(np.log1p(LOG_PER_MAG * linear) / LOG_PER_MAG) if self.unit == "mag" else linear

    @classmethod
    def named(
        cls, name: str, star: Source, quiet: Expectation, instrument: Instrument, order: Order, file: Source | None,
        band: str,
    ) -> Self:  # fmt: skip
        """Return a change by name: lines, ``balmer jump``, ``colour``, a band as in ``200-320``, or ``spectrum``.

        The star is at its brightness, and the expectation that of one exposure. ``spectrum`` adds the light of `file`,
        which is measured in `band`.
        """
        nm, unit = GRID_NM, ""
        starlight = np.interp(nm, star.wavelength_nm, star.flux_flam, left=0.0, right=0.0)
        words = name.strip().casefold()
        if words == "balmer jump":
            flux = starlight * _share_below(BALMER_EDGE_NM)
            meaning = "relative change of the light below the Balmer edge"
        elif words == "colour":
            flux, unit = LOG_PER_MAG * starlight * _share_below(COLOUR_NM), "mag"
            meaning = f"brightening of the light below {COLOUR_NM:g} nm against that above"
        elif words == "spectrum":
            if file is None:
                raise InputError("the change 'spectrum' needs a file; give `change.file`", key="change.file")
            of_star, of_file = (photons(source.wavelength_nm, source.flux_flam, band) for source in (star, file))
            if not of_file > 0:
                fault = f"the spectrum of {file.name} must have light in the band {band}, but has none"
                raise InputError(fault, key="change.band")
            nm, flux = file.wavelength_nm, of_star / of_file * file.flux_flam
            meaning = f"light of {file.name} over that of the star in {band}"
        elif (limits := _parse_band(name)) is not None:
            flux = starlight * (_share_below(limits[1]) - _share_below(limits[0]))
            meaning = f"relative change of the light in {limits[0]:g}-{limits[1]:g} nm"
        else:
            try:
                line = EmissionLine.named(name)
            except InputError:
                lines = ", ".join(INDICES)
                expected = f"a line such as {lines}, a band such as 200-320, balmer jump, colour or spectrum"
                raise InputError.of("change.of", shortened(name), expected) from None
            nm = np.unique(np.concatenate([nm, line.nodes_nm]))
            flux, unit, meaning = line.profile(nm), "erg / (s cm2)", f"flux of {line.name}"
        rate = electrons_per_second(instrument, nm, flux, order)
        return cls(name.strip(), unit, meaning, rate * _exposure_dn_per_electron(quiet, instrument))


def _share_below(edge_nm: float) -> Float:
    """Return factors at `GRID_NM` of light that ends at a wavelength, with the sum and mean of a sharp edge.

    The flux is linear between the wavelengths, and the factor of each is the share of its triangle below the edge.
    """
    distance = np.clip((edge_nm - GRID_NM) / (GRID_NM[1] - GRID_NM[0]), -1.0, 1.0)
    return np.asarray(np.where(distance < 0.0, (1.0 + distance) ** 2, 2.0 - (1.0 - distance) ** 2) / 2.0)


def _parse_band(name: str) -> tuple[float, float] | None:
    try:
        low, high = map(float, name.split("-"))
    except ValueError:
        return None
    if not 0 < low < high:
        raise InputError.of("change.of", name, "a band of ascending wavelengths, such as 200-320", unit="nm")
    return low, high


def _exposure_dn_per_electron(quiet: Expectation, instrument: Instrument) -> Float:
    """Return the DN of an exposure for a rate of one electron per second, shape (n_pixel,)."""
    return np.asarray(quiet.exposure_s * quiet.gain_dn_per_electron * instrument.per_pixel("response", 1.0))


def flux_per_dn(quiet: Expectation, instrument: Instrument) -> Float:
    """Return the flux density, erg s-1 cm-2 nm-1, for one DN of the exposure in each pixel, shape (n_pixel,).

    This is the calibration of an observer: counts over the effective area at the wavelength of the pixel.
    """
    flam = W_PER_NM_IN_FLAM * instrument.electrons_per_joule_cm2(instrument.wavelength_nm)
    per_flam = flam * instrument.dispersion_nm_per_pixel * _exposure_dn_per_electron(quiet, instrument)
    # Per nm in place of per Angstrom.
    return np.divide(10.0, per_flam, out=np.zeros_like(per_flam), where=per_flam > 0)
