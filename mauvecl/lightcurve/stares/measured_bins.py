"""Flares measured along a stare: temperature, area and luminosity against time, in bins of a chosen S/N."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.lightcurve.stares.stare import Stare
from mauvecl.noise.unknowns import CHANGING, Changing
from mauvecl.results.measurements.fit import LEVELS, Measurement, fit
from mauvecl.results.measurements.reduction import Ranges, Reduction
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range
from mauvecl.schema.physical import Probability, Wavelength
from mauvecl.schema.tables import Column, table_of
from mauvecl.statistics.nuisances import Nuisances, spectrum_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from astropy.table import QTable

    from mauvecl.host.expectation import Expectation
    from mauvecl.results.measurements.flare_model import FlareModel

Float = NDArray[np.float64]

#: Bins span at most this many frames, which bounds the time that the search for them takes.
MOST_FRAMES_PER_BIN = 4096
#: Every n-th temperature of the model is tried for the filter that chooses the bins.
EVERY = 8
#: Bins whose known conditions agree to this many digits are fitted together.
DIGITS = 6


#: Heading, format and heading of the error of quantities in printed tables.
SHOWN = {
    "temperature": ("temperature (K)", ".0f", "error"),
    "flux_bolometric": ("bolometric flux (erg/s/cm2)", ".3g", ""),
}


@dataclass(frozen=True, eq=False)
class MeasuredBins:
    """Flares measured in bins of consecutive frames.

    Attributes
    ----------
    first, count : ndarray of int, shape (n_bin,)
        First frame of each bin, and number of frames in it.
    start_s, end_s : ndarray, shape (n_bin,)
    found : Measurement
        One row per bin. Amplitudes, fluxes and luminosities are means over the bin; energies are those within it.
    """

    first: NDArray[np.intp]
    count: NDArray[np.intp]
    start_s: Float
    end_s: Float
    found: Measurement

    def table(self) -> QTable:
        """Return times, estimates, errors and intervals, one row per bin."""
        return table_of(self.columns, [self])

    @property
    def columns(self) -> list[Column]:
        """Columns of the table; those of the quantities depend on the model."""
        found = self.found
        return [
            Column("start", "start_s", "s", "start of the bin, from the start of the stare", "from (s)", "g"),
            Column("end", "end_s", "s", "end of the bin", "to (s)", "g"),
            Column("frames", "count", "", "frames of the bin"),
            Column("snr", "found.snr", "", "S/N of the flare in the bin", "S/N", ".1f"),
            *(column for q in range(len(found.names)) for column in self._quantity(q)),
            Column("chi2", "found.chi2", "", f"chi-squared of the fit, of {found.dof} degrees of freedom"),
            Column("p_value", "found.p_value", "",
                   "probability of a chi-squared at least as large if the model is correct", "p-value", ".2g"),
        ]  # fmt: skip

    def _quantity(self, q: int) -> list[Column]:
        """Return the columns of a quantity's estimates, errors and intervals."""
        from astropy import units

        found, name = self.found, self.found.names[q]
        column, unit = name.replace(" ", "_"), str(units.Unit(found.units[q]))
        heading, spec, error = SHOWN.get(column, ("", "", ""))
        columns = [
            Column(column, lambda bins: bins.found.estimates[:, q], unit, f"{name} of the flare", heading, spec),
            Column(f"{column}_error", lambda bins: bins.found.errors[:, q], unit, "its standard error", error, spec),
        ]
        for k, level in enumerate(found.levels):
            text = f"end of its {100 * level:.4g} % interval; infinite where there is none"
            columns += [
                Column(f"{column}_low_{100 * level:.0f}", self._end("low", k, q), unit, f"lower {text}"),
                Column(f"{column}_high_{100 * level:.0f}", self._end("high", k, q), unit, f"higher {text}"),
            ]
        return columns

    @staticmethod
    def _end(side: str, level: int, q: int) -> Callable[[MeasuredBins], Float]:
        return lambda bins: np.asarray(getattr(bins.found, side)[level][:, q])


@validated
def measure_along(
    frames: ArrayLike,
    quiet: Expectation,
    model: FlareModel,
    nuisances: Nuisances | None = None,
    *,
    snr_per_bin: Annotated[float, Range(0, open_low=True)] = 20.0,
    stare: Stare | None = None,
    levels: Sequence[Probability] = LEVELS,
    skipped_nm: Sequence[tuple[Wavelength, Wavelength]] = (),
) -> MeasuredBins:
    """Measure a flare against time, in bins of consecutive frames in which it reaches an S/N.

    Each bin is the shortest run of frames after the previous bin in which a matched filter reaches `snr_per_bin`; its
    frames are added up and fitted as one exposure (`fit`). Frames without enough light before, between and after
    flares are not in any bin. The filter has the temperature that fits the brightest part of the stare. Since noise
    also decides where a bin ends, amplitudes are biased high by about one standard error over `snr_per_bin`; below an
    S/N of 8, noise alone occasionally produces bins.

    Parameters
    ----------
    frames : array_like, shape (n_frame, n_pixel)
        Raw DN of single frames.
    quiet : Expectation
        One frame of the quiescent star.
    model : FlareModel
        Model of one frame.
    nuisances : Nuisances, optional
        Unknown amplitudes of known spectra, for one frame; each bin has its own constant amplitudes.
    snr_per_bin : float
    stare : Stare, optional
        Times, known conditions and unknown changes of the frames; frames without gaps and changes by default. An
        unknown change of the stare has its prior in each bin, unless `nuisances` has one of the same name. Bins do
        not extend over gaps.
    levels : sequence of float
        Nominal coverage of the intervals.
    skipped_nm : sequence of tuple
        Wavelength ranges of pixels that are not used.

    Raises
    ------
    InputError
        If the frames have another shape, the expectation has several frames, or no bin reaches the S/N.
    """
    raw, stare = checked_frames(frames, quiet, stare)
    if not 0.0 < snr_per_bin < np.inf:
        raise InputError.of("snr_per_bin", snr_per_bin, "a number above 0")
    bins = _bins(raw, quiet, model, nuisances, known_strengths(stare, quiet), stare, snr_per_bin, skipped_nm)
    if not bins:
        raise InputError.of("snr_per_bin", snr_per_bin, "an S/N that a bin of the stare reaches")
    first, end = np.array(bins).T
    return fit_bins(raw, quiet, model, nuisances, stare, first, end - first, levels, skipped_nm)


def checked_frames(frames: ArrayLike, quiet: Expectation, stare: Stare | None) -> tuple[Float, Stare]:
    """Return raw frames of a stare and the stare; raises InputError unless they and the expectation agree."""
    raw = np.asarray(frames, np.float64)
    if raw.ndim != 2:
        raise InputError(
            f"frames of the shape {raw.shape}", "two dimensions: frames and pixels", key="frames", value=raw.shape
        )
    if stare is None:
        here = quiet.conditions["temperature_c"]
        stare = Stare.of(max(len(raw), 1) * quiet.frame_s, frame_s=quiet.frame_s, temperature_c=here)
    n_pixel = quiet.wavelength_nm.size
    if raw.shape != (stare.n_frames, n_pixel):
        raise InputError(
            f"frames of the shape {raw.shape}", f"{(stare.n_frames, n_pixel)}", key="frames", value=raw.shape
        )
    if not np.isfinite(raw).all():
        raise InputError("frames hold undefined values", "finite numbers", key="frames")
    if quiet.n_frames != 1:
        raise InputError.of("n_frames", quiet.n_frames, "one frame of the quiescent star")
    return raw, stare


def fit_bins(
    raw: Float,
    quiet: Expectation,
    model: FlareModel,
    nuisances: Nuisances | None,
    stare: Stare,
    first: NDArray[np.intp],
    count: NDArray[np.intp],
    levels: Sequence[float] = LEVELS,
    skipped_nm: Ranges = (),
) -> MeasuredBins:
    """Fit bins of frames; parameters as for `measure_along`, with the first frames of bins and their numbers."""
    known, end = known_strengths(stare, quiet), first + count
    alike: dict[tuple[float, ...], list[int]] = {}
    for k, (a, b) in enumerate(zip(first, end, strict=True)):
        mean = [*known[a:b].mean(axis=0), *spreads_of(stare, a, b).values()]
        alike.setdefault((float(b - a), *np.round(mean, DIGITS).tolist()), []).append(k)
    parts = []
    for (length, star, sky, dark, light, *spreads), rows in alike.items():
        n = int(length)
        stacked = replace(
            quiet, n_frames=n, source_electrons=star * quiet.source_electrons,
            sky_electrons=sky * quiet.sky_electrons, dark_dn=dark * quiet.dark_dn,
            neighbour_electrons=light * quiet.neighbour_electrons,
        )  # fmt: skip
        unknown = Nuisances.of(stacked, {}) if nuisances is None else replace(nuisances, spectra=n * nuisances.spectra)
        for of, sd in zip(CHANGING, spreads, strict=True):
            unknown = _with_change(unknown, stacked, of, sd)
        added = np.array([raw[first[k] : end[k]].sum(axis=0) for k in rows])
        own = unknown if unknown.names else None
        parts.append(fit(added, stacked, model.stacked(n, light), own, levels=levels, skipped_nm=skipped_nm))
    order = np.argsort(np.concatenate(list(alike.values())))
    found = Measurement.joined(parts).rows(order)
    return MeasuredBins(first, count, stare.start_s[first], stare.start_s[end - 1] + stare.frame_s, found)


def spreads_of(stare: Stare, first: int, end: int) -> dict[Changing, float]:
    """Return the standard deviations of the unknown changes of a stare, averaged over some frames."""
    found = {of: sd**2 / (end - first) for of, sd in stare.jitters.items()} | {"star": 0.0}
    for one in stare.unknowns:
        found[one.of] += (one.sd * float(one.curve[first:end].mean())) ** 2
    if stare.pointing is not None:
        found["light"] += stare.pointing.depth**2
    return {of: float(np.sqrt(found[of])) for of in CHANGING}


def _with_change(unknown: Nuisances, quiet: Expectation, of: Changing, sd: float) -> Nuisances:
    """Return nuisance parameters with an unknown change of a stare, unless they have one of the same kind."""
    name = {"temperature": "dark"}.get(of, of)
    if not sd > 0.0 or name in unknown.names:
        return unknown
    if name == "star":
        return unknown.with_spectrum(name, quiet.net_source_dn, sd)
    return unknown.joined(Nuisances.of(quiet, {name: sd})) if spectrum_of(name, quiet).any() else unknown


def known_strengths(stare: Stare, quiet: Expectation) -> Float:
    """Return known strengths of star, sky, dark, and flare and neighbours in each frame, shape (n_frame, 4)."""
    return np.column_stack([stare.light * stare.star, stare.light * stare.sky, stare.dark_factor(quiet), stare.light])


def less_known(raw: Float, quiet: Expectation, known: Float, weights: Float) -> Float:
    """Return weighted sums, (n_frame, n_sum), of frames less their means without a flare for `known_strengths`."""
    means = np.vstack([quiet.net_source_dn, quiet.sky_dn, quiet.dark_dn, quiet.neighbour_dn, quiet.bias_dn])
    strengths = np.column_stack([known, np.ones(len(known))])
    return np.asarray(raw @ weights.T - strengths @ (means @ weights.T))


def _bins(
    raw: Float,
    quiet: Expectation,
    model: FlareModel,
    nuisances: Nuisances | None,
    known: Float,
    stare: Stare,
    snr: float,
    skipped_nm: Ranges,
) -> list[tuple[int, int]]:
    """Return first frames and ends of the shortest runs of frames in which a matched filter reaches an S/N."""
    reduction = Reduction.of(model, quiet, None, nuisances, skipped_nm)
    sums = less_known(raw, quiet, known, reduction.weights)
    total = np.vstack([np.zeros(sums.shape[1]), np.cumsum(sums, axis=0)])
    shapes = reduction.hot[::EVERY] / np.linalg.norm(reduction.hot[::EVERY], axis=1)[:, None]
    widths = 2 ** np.arange(int(np.log2(len(raw))) + 1)
    best = [((total[w:] - total[:-w]) @ shapes.T).max(axis=0) / np.sqrt(w) for w in widths]
    node = int(np.argmax(np.max(best, axis=0)))
    light = model.hot[::EVERY][node]
    weights = shapes[node] @ reduction.weights
    # The variance of a frame's value is one plus that of the flare's photons, which is proportional to its light.
    per_value = float(weights**2 @ (quiet.gain_dn_per_electron * light) / (weights @ light))
    value = total @ shapes[node]
    bins = []
    gaps = np.flatnonzero(np.diff(stare.numbers) > 1) + 1
    for begin, stop in zip([0, *gaps], [*gaps, len(raw)], strict=True):
        start = int(begin)
        for end in range(int(begin) + 1, int(stop) + 1):
            earliest = max(start, end - MOST_FRAMES_PER_BIN)
            gain = value[end] - value[earliest:end]
            variance = np.arange(end - earliest, 0, -1) + per_value * np.maximum(gain, 0.0)
            reached = np.flatnonzero(gain >= snr * np.sqrt(variance))
            if reached.size:
                bins.append((earliest + int(reached[-1]), end))
                start = end
    return bins
