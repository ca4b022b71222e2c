"""Indices of lines at Mauve's resolution, and the spectra of changes of lines, bands, jump and colour."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.exposure.response import W_PER_NM_IN_FLAM, Order, electrons_per_second
from mauvecl.host.stars.bands import photons
from mauvecl.host.stars.flare_spectra import BALMER_EDGE_NM, EmissionLine
from mauvecl.observations.line_index import line_index
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.stars.source import Source

Float = NDArray[np.float64]

#: Wavelength between the two halves of the colour, nm: the middle of the output range.
COLOUR_NM = 450.0
#: Change of the natural logarithm of a flux for a change of one magnitude.
LOG_PER_MAG = 0.4 * np.log(10.0)
#: Wavelengths at which spectra with edges are computed, nm: beyond the reach of the line function, in steps far below
#: the resolution.
GRID_NM = np.linspace(150.0, 760.0, 6101)


@dataclass(frozen=True)
class Index:
    """Definition of a line index: light in a band above a straight continuum."""

    name: str  # as in `EmissionLine.named`
    band_nm: tuple[float, float]
    continuum_nm: tuple[tuple[float, float], ...]
    published: str  # the usual definition for spectra of higher resolution, with its source

    @property
    def lines(self) -> EmissionLine:
        """The lines in the band."""
        return EmissionLine.named(self.name)


#: Indices by name. The bands are an assumption of this project: published ones, of 0.1 to 3 nm, lie within Mauve's line
#: function of 13.3 nm, so that the band is 16 nm about the lines and each continuum 12 nm beyond.
#: The published windows of Ca II and H alpha were compared with the table of ACTIN 2, that of H beta with lists of Lick
#: indices, that of Mg II with the public code of the Mg II index of SUIT; the papers themselves were not read.
INDICES = {
    one.name: one
    for one in (
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
        cls,
        name: str,
        star: Source,
        quiet: Expectation,
        instrument: Instrument,
        order: Order,
        file: Source | None,
        band: str,
    ) -> Self:
        """Return a change by name.

        Parameters
        ----------
        name : str
            A line or group of lines, ``balmer jump``, ``colour``, a band as in ``200-320``, or ``spectrum``.
        star : Source
            At its brightness.
        quiet : Expectation
            One exposure.
        order : {"paper", "physical"}
        file : Source, optional
            Light that the change ``spectrum`` adds.
        band : str
            In which the light of that spectrum is measured.
        """
        nm, unit = GRID_NM, ""
        own = np.interp(nm, star.wavelength_nm, star.flux_flam, left=0.0, right=0.0)
        words = name.strip().casefold()
        if words == "balmer jump":
            flux, meaning = own * _below(BALMER_EDGE_NM), "relative change of the light below the Balmer edge"
        elif words == "colour":
            flux, unit = LOG_PER_MAG * own * _below(COLOUR_NM), "mag"
            meaning = f"brightening of the light below {COLOUR_NM:g} nm against that above"
        elif words == "spectrum":
            if file is None:
                raise InputError("the change 'spectrum' has no file", "`change.file`", key="change.file")
            scale = photons(star.wavelength_nm, star.flux_flam, band) / photons(
                file.wavelength_nm, file.flux_flam, band
            )
            nm, flux = file.wavelength_nm, scale * file.flux_flam
            meaning = f"light of {file.name} over that of the star in {band}"
        elif (limits := _band(name)) is not None:
            flux = own * (_below(limits[1]) - _below(limits[0]))
            meaning = f"relative change of the light in {limits[0]:g}-{limits[1]:g} nm"
        else:
            line = _line(name)
            nm = np.unique(np.concatenate([nm, line.nodes_nm]))
            flux, unit, meaning = line.profile(nm), "erg / (s cm2)", f"flux of {line.name}"
        rate = electrons_per_second(instrument, nm, flux, order)
        return cls(name.strip(), unit, meaning, rate * exposure_dn_per_electron(quiet, instrument))


def _below(edge_nm: float) -> Float:
    """Return factors at `GRID_NM` of light that ends at a wavelength.

    Flux is linear between the wavelengths, and the factor of each is the share of its triangle below the edge, so that
    the light and its mean wavelength are those of a sharp edge.
    """
    distance = np.clip((edge_nm - GRID_NM) / (GRID_NM[1] - GRID_NM[0]), -1.0, 1.0)
    return np.asarray(np.where(distance < 0.0, (1.0 + distance) ** 2, 2.0 - (1.0 - distance) ** 2) / 2.0)


def _band(name: str) -> tuple[float, float] | None:
    try:
        low, high = (float(part) for part in name.split("-"))
    except ValueError:
        return None
    if not 0 < low < high:
        raise InputError.of("change.of", name, "a band of ascending wavelengths, such as 200-320", unit="nm")
    return low, high


def _line(name: str) -> EmissionLine:
    try:
        return EmissionLine.named(name)
    except InputError:
        raise InputError.of(
            "change.of", shortened(name),
            f"a line such as {', '.join(INDICES)}, a band such as 200-320, balmer jump, colour or spectrum",
        ) from None  # fmt: skip


def covered_indices(quiet: Expectation) -> list[Index]:
    """Return the indices whose band and continua lie within the pixels."""
    first, last = quiet.wavelength_nm[0], quiet.wavelength_nm[-1]
    return [one for one in INDICES.values() if first <= one.continuum_nm[0][0] and one.continuum_nm[-1][1] <= last]


def exposure_dn_per_electron(quiet: Expectation, instrument: Instrument) -> Float:
    """Return the DN of an exposure for a rate of one electron per second, shape (n_pixel,)."""
    return np.asarray(quiet.exposure_s * quiet.gain_dn_per_electron * instrument.per_pixel("response", 1.0))


def flux_per_dn(quiet: Expectation, instrument: Instrument) -> Float:
    """Return the flux density, erg s-1 cm-2 nm-1, for one DN of the exposure in each pixel, shape (n_pixel,).

    This is the calibration of an observer: counts over the effective area at the wavelength of the pixel.
    """
    flam = W_PER_NM_IN_FLAM * instrument.electrons_per_joule_cm2(instrument.wavelength_nm)
    per_flam = flam * instrument.dispersion_nm_per_pixel * exposure_dn_per_electron(quiet, instrument)
    # Per nm in place of per Angstrom.
    return np.divide(10.0, per_flam, out=np.zeros_like(per_flam), where=per_flam > 0)


@dataclass(frozen=True, eq=False)
class IndexValue:
    """A line index of a star in one exposure."""

    index: Index
    weights: Float  # shape (n_pixel,); the index, erg s-1 cm-2, for one DN of the exposure in each pixel
    value: float  # of the mean exposure
    equivalent_width_nm: float  # positive in emission
    captured: float  # share of a line's flux that the index holds at Mauve's resolution

    @classmethod
    def of(cls, index: Index, quiet: Expectation, instrument: Instrument, order: Order) -> Self:
        """Compute an index; raises InputError if the instrument does not cover its bands."""
        calibration = flux_per_dn(quiet, instrument)
        nm = quiet.wavelength_nm
        # The index is linear in the pixels near it.
        windows = (index.band_nm, *index.continuum_nm)
        near = (nm > min(low for low, _ in windows) - 1.0) & (nm < max(high for _, high in windows) + 1.0)
        find = partial(line_index, nm[near], band_nm=index.band_nm, continuum_nm=index.continuum_nm)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Pixels of the band alone have no continuum, and no equivalent width.
            part = find(np.eye(int(near.sum())))
        weights = np.zeros(nm.size)
        weights[near] = part.flux * calibration[near]
        mean = find((calibration * quiet.signal_dn)[near])
        lines = index.lines
        rate = electrons_per_second(instrument, lines.nodes_nm, lines.profile(lines.nodes_nm), order)
        captured = float(weights @ (rate * exposure_dn_per_electron(quiet, instrument)))
        return cls(index, weights, float(mean.flux), float(mean.equivalent_width_nm), captured)
