"""Response matrix of an instrument, from the flux of a spectrum to electrons per second and pixel, and its noise.

The flux is piecewise linear between its nodes. With P_p(l) the fraction of light of wavelength l that falls on pixel p
(the line spread function integrated over the pixel, in closed form), a pixel's rate is the integral of flux * P_p times
efficiency and area. The integral runs over panels in which every P_p is smooth. In a panel, P_p is its interpolating
polynomial through Gauss-Legendre nodes, and the flux enters through its integrals against the Lagrange polynomials of
these nodes. The matrix is therefore a product,

    response = landing @ gathering        (n_pixel, n_panel_node) @ (n_panel_node, n_wavelength)

whose first factor depends on the instrument only, and whose second has a constant cost per node of the spectrum.
Nothing is resampled and no flux is lost; results agree with adaptive quadrature to 1e-13.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, cast

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from mauvecl.host.arrays import Float
from mauvecl.host.instrument.instrument import Instrument, LineSpread
from mauvecl.host.stars.spectrum import point_noise
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.host.stars.source import Source

Order = Literal["paper", "physical"]

#: 1 erg s^-1 cm^-2 A^-1 in W cm^-2 nm^-1.
W_PER_NM_IN_FLAM = 1e-6
#: Gauss-Legendre nodes per panel.
PANEL_NODES = 10
#: Gauss-Legendre nodes per cell of the flux; exact for a linear flux times a panel's Lagrange polynomials.
CELL_NODES = 6
#: Cells processed at once, which limits the memory.
CHUNK = 20_000
#: Values of the line spread function computed at once, which fit into the processor's cache: twice as fast.
BLOCK = 8192
#: Largest number of nodes for which a response matrix is built and cached.
MATRIX_NODES = 20_000


def response_matrix(instrument: Instrument, wavelength_nm: ArrayLike, order: Order = "paper") -> csr_array:
    """Return the mean electrons per second in each pixel for unit flux at each node.

    Parameters
    ----------
    instrument : Instrument
    wavelength_nm : array_like, shape (n_wavelength,)
        Nodes of the flux, nm, strictly increasing; the flux is linear between them and zero outside.
    order : {"paper", "physical"}
        With ``paper``, the efficiency at the wavelength of the pixel is applied after the line spread function. With
        ``physical``, the efficiency at the wavelength of the light is applied before it. The results differ by up to
        4 % (G2V) or 6 % (K2.5V), by 6-11 % at 200 nm, and by 0.1 % in total. Beyond its ends an efficiency curve keeps
        its end value (an assumption), which affects only ``physical``, for light from outside the output range.

    Returns
    -------
    csr_array, shape (n_pixel, n_wavelength)
        Electrons s^-1 per (erg s^-1 cm^-2 A^-1): `response_matrix(...) @ flux_flam` is electrons per second. The
        matrix is cached and read-only.
    """
    return _response(instrument, _nodes(wavelength_nm).tobytes(), order)


def electrons_per_second(
    instrument: Instrument, wavelength_nm: ArrayLike, flux_flam: ArrayLike, order: Order = "paper"
) -> Float:
    """Return the mean electrons per second in each pixel, shape (n_pixel,), for a spectrum of any number of nodes.

    The flux at the nodes is in erg s^-1 cm^-2 A^-1; see `response_matrix`.
    """
    nodes = _nodes(wavelength_nm)
    flux = np.asarray(flux_flam, np.float64)
    if flux.shape != nodes.shape:
        fault = f"flux needs one value per wavelength, but has {flux.size} values for {nodes.size} wavelengths"
        raise InputError(fault, key="flux")
    if nodes.size <= MATRIX_NODES:
        return cast(Float, _response(instrument, nodes.tobytes(), order) @ flux)
    # Efficiencies act at the wavelength of the light, or else at that of the pixel.
    by_light = instrument if order == "physical" else None
    landing, terms = _factors(LineSpread.of(instrument), nodes, by_light)
    rate = landing @ np.sum([term @ flux for term in terms], axis=0)
    return np.asarray(rate if by_light else rate * _efficiencies(instrument))


@lru_cache(maxsize=8)
def _response(instrument: Instrument, nodes: bytes, order: Order) -> csr_array:
    """Return the response matrix for nodes, given as bytes so that the matrix can be cached."""
    by_light = instrument if order == "physical" else None
    matrix = _product(LineSpread.of(instrument), nodes, by_light)
    if by_light:
        return matrix
    scaled = matrix.copy()
    scaled.data *= np.repeat(_efficiencies(instrument), np.diff(matrix.indptr))
    return _read_only(scaled)


# Instruments that differ only in their efficiencies, such as most modes of a calibrated throughput, share these
# matrices in the paper's order.
@lru_cache(maxsize=8)
def _product(line: LineSpread, nodes: bytes, by_light: Instrument | None) -> csr_array:
    """Return the product of both factors; in the paper's order, without the efficiencies."""
    landing, (first, *terms) = _factors(line, np.frombuffer(nodes, np.float64), by_light)
    return _read_only(csr_array(landing @ sum(terms, first)))


def _factors(line: LineSpread, nodes: Float, by_light: Instrument | None) -> tuple[csr_array, Iterator[csr_array]]:
    """Return the first factor of the matrix, and the terms whose sum is the second."""
    # The integrand's slope jumps at the knots of the efficiency curves, which must not lie within a panel.
    knots = by_light.knots_nm if by_light else ()
    return _line_landing(line, knots), _gathering(line.panel_edges(np.array(knots)), nodes, by_light)


def _efficiencies(instrument: Instrument) -> Float:
    """Return the factors of the paper's order at the wavelengths of the pixels, shape (n_pixel,)."""
    return W_PER_NM_IN_FLAM * instrument.electrons_per_joule_cm2(instrument.wavelength_nm, held=True)


# An answer asks for those of each mode of a fitted instrument, some 16 of 7 MB each, several times.
@lru_cache(maxsize=24)
def _line_landing(line: LineSpread, knots: tuple[float, ...]) -> csr_array:
    """Return the fraction of the light at each panel node that falls on each pixel, shape (n_pixel, n_panel_node)."""
    edges = line.panel_edges(np.array(knots))
    nodes = np.ravel(edges[:-1, None] + np.diff(edges)[:, None] * (1 + leggauss(PANEL_NODES)[0]) / 2)
    centres = np.array(line.centres)
    first = np.searchsorted(nodes, centres - line.reach)
    count = np.searchsorted(nodes, centres + line.reach) - first
    indptr = np.append(0, np.cumsum(count))
    rows = np.repeat(np.arange(centres.size), count)
    columns = np.arange(indptr[-1]) - np.repeat(indptr[:-1] - first, count)
    values = np.empty(columns.size)
    for block in (slice(start, start + BLOCK) for start in range(0, columns.size, BLOCK)):
        values[block] = line.landing(nodes[columns[block]] - centres[rows[block]])
    return _read_only(csr_array((values, columns, indptr), shape=(centres.size, nodes.size)))


def _gathering(panels: Float, wavelength: Float, by_light: Instrument | None) -> Iterator[csr_array]:
    """Yield the terms of the second factor of the matrix, each of shape (n_panel_node, n_wavelength).

    An entry is the integral (nm) over a panel of one of its Lagrange polynomials times the hat function of a node, and
    times the efficiency in the physical order. A term has many cells, each within one panel and between two nodes.
    `panels` are the edges of the panels, shape (n_panel + 1,), and `wavelength` the nodes, nm.
    """
    low, high = max(panels[0], wavelength[0]), min(panels[-1], wavelength[-1])
    shape = ((panels.size - 1) * PANEL_NODES, wavelength.size)
    if not low < high:
        yield csr_array(shape)
        return
    inside = [edges[(edges > low) & (edges < high)] for edges in (panels, wavelength)]
    edges = np.unique(np.concatenate([[low], *inside, [high]]))
    (abscissa, weight), (x, weights) = leggauss(CELL_NODES), leggauss(PANEL_NODES)
    # Lagrange polynomials of a panel's nodes from Legendre polynomials, without division or cancellation.
    from_legendre = (np.arange(PANEL_NODES)[:, None] + 0.5) * legvander(x, PANEL_NODES - 1).T * weights
    for start in range(0, edges.size - 1, CHUNK):
        width = np.diff(edges[start : start + CHUNK + 1])
        middle = edges[start : start + width.size] + width / 2
        panel, node = np.searchsorted(panels, middle) - 1, np.searchsorted(wavelength, middle) - 1
        at = middle[:, None] + width[:, None] / 2 * abscissa  # (n_cell, CELL_NODES)
        mass = width[:, None] / 2 * weight
        if by_light:
            mass = mass * W_PER_NM_IN_FLAM * by_light.electrons_per_joule_cm2(at, held=True)
        span = (wavelength[node + 1] - wavelength[node])[:, None]
        right = (at - wavelength[node][:, None]) / span
        in_panel = (2 * at - (panels[panel] + panels[panel + 1])[:, None]) / np.diff(panels)[panel][:, None]
        lagrange = legvander(in_panel, PANEL_NODES - 1) @ from_legendre
        rows = np.broadcast_to(panel[:, None] * PANEL_NODES + np.arange(PANEL_NODES), (panel.size, PANEL_NODES))
        values = [np.einsum("cq,cqk->ck", mass * share, lagrange) for share in (1 - right, right)]
        columns = [np.broadcast_to((node + side)[:, None], rows.shape) for side in (0, 1)]
        index = (np.tile(rows.ravel(), 2), np.concatenate([c.ravel() for c in columns]))
        # Entries with the same index are summed.
        yield csr_array((np.concatenate([v.ravel() for v in values]), index), shape=shape)


def _read_only(matrix: csr_array) -> csr_array:
    # Cached matrices are shared, so neither callers nor scipy's in-place clean-up may change them.
    matrix.sum_duplicates()
    matrix.data.setflags(write=False)
    return matrix


def _nodes(wavelength_nm: ArrayLike) -> Float:
    """Return the nodes of a flux as an array; raise InputError unless they are finite and strictly increasing."""
    nodes = np.ascontiguousarray(wavelength_nm, np.float64)
    if nodes.ndim != 1 or nodes.size < 2 or not np.isfinite(nodes).all() or not (np.diff(nodes) > 0).all():
        fault = "a spectrum must have at least two finite, strictly increasing wavelengths, in nm"
        raise InputError(fault, key="wavelength_nm")
    return nodes


#: Accepted distance of a mean below zero, in standard errors; noise exceeds it in one of 740 independent pixels.
MAX_SIGMA_BELOW_ZERO = 3.0
#: Negative means up to this fraction of the largest mean are rounding errors of the quadrature.
ROUNDING = 1e-12


def negative_means_message(
    source: Source, instrument: Instrument, electrons: Float, drawn: Float, order: Order
) -> tuple[str, ...]:
    """Return the message on pixels with a negative mean, which counts as no light.

    `electrons` and `drawn`, shape (n_pixel,), are the means of a frame and their standard deviation in the exposure.
    """
    below = electrons < -ROUNDING * max(float(electrons.max()), 0.0)
    if not below.any() or not (source.flux_flam < 0.0).any():
        return ()
    # A pixel weights the points by its response r and their spacing d. The variance of its mean, the sum of
    # (r d sigma)^2, is approximated by mean(r), weighted by r, times the sum of r d (d sigma^2), which holds where the
    # noise changes slowly. The mean of r is the integral of the square of the line spread function over a pixel.
    nm, line = source.wavelength_nm, LineSpread.of(instrument)
    offset = np.linspace(-line.reach, line.reach, 4001)
    density = float(np.trapezoid((line.landing(offset) / line.pixel) ** 2, offset))
    variance = density * electrons_per_second(instrument, nm, np.ones_like(nm), order)
    variance *= electrons_per_second(instrument, nm, np.gradient(nm) * point_noise(source.flux_flam) ** 2, order)
    # A negative mean below the exposure's noise does not matter.
    error = np.hypot(np.sqrt(variance) * instrument.frame_s, drawn)
    worst = int(np.argmin(electrons + MAX_SIGMA_BELOW_ZERO * error))
    nm = instrument.wavelength_nm
    if electrons[worst] < -MAX_SIGMA_BELOW_ZERO * error[worst]:
        mean = f"{electrons[worst]:.3g} electrons per frame at {nm[worst]:.1f} nm"
        fault = f"the spectrum of {source.name} must be of non-negative light, but gives a mean of {mean}"
        error_of_it = f"beyond {MAX_SIGMA_BELOW_ZERO:g} times its error of {error[worst]:.2g}"
        raise InputError(f"{fault}, {error_of_it}: bin the spectrum (`bin_nm`) or correct it", key="bin_nm")
    return (
        f"{source.name}: the means of {int(below.sum())} of {below.size} pixels, from {nm[below][0]:.1f} to "
        f"{nm[below][-1]:.1f} nm, lie below zero, within their error (measured noise of the spectrum), and are "
        "taken as no light.",
    )
