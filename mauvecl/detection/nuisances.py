"""Nuisance parameters: unknown amplitudes of known spectra, which statistics marginalise over.

The covariance of an exposure is C = V + U^T S U with the diagonal V of the noise, the nuisance spectra U and the
variances S of their amplitudes. An amplitude of infinite variance is projected out.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.arrays import ContentEquality, Float
from mauvecl.host.tables.files import LARGEST, SMALLEST, read_text
from mauvecl.noise.unknowns import NUISANCES
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError, shortened

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation


@validated
@dataclass(frozen=True, eq=False)
class Nuisances(ContentEquality):
    """Unknown amplitudes of known spectra."""

    names: tuple[str, ...]
    spectra: Float  # DN of the exposure for unit amplitude, shape (k, n_pixel)
    sd: Float  # prior standard deviations of the amplitudes, infinite for a flat prior, shape (k,)
    # Relative change of the light of a flare for unit amplitude: 1 for a factor on all light, 0 by default; shape
    # (k, n_pixel). Fits of flares use it; statistics test for a flare, and use the spectra without one.
    of_flare: Float = field(default_factory=lambda: np.zeros((0, 0)))
    mean: Float = field(default_factory=lambda: np.zeros(0))  # prior means in fits of flares, 0 by default, shape (k,)
    # Values of the factor on all light, in standard deviations from its mean, and their probabilities, if its prior is
    # not normal, shape (2, n); fits of flares use it.
    factor_prior: Float = field(default_factory=lambda: np.zeros((2, 0)))

    def __post_init__(self) -> None:
        shapes = np.shape(self.spectra), np.shape(self.sd)
        if len(shapes[0]) != 2 or shapes[0][:1] != shapes[1] or shapes[1] != (len(self.names),):
            raise InputError(
                f"each unknown must have one spectrum and one standard deviation, but {len(self.names)} names have "
                f"spectra of the shape {shapes[0]} and standard deviations of the shape {shapes[1]}",
                key="names",
            )
        for name, spectrum, sd in zip(self.names, self.spectra, self.sd, strict=True):
            if not np.isfinite(spectrum).all():
                raise InputError(f"the spectrum of the unknown {name!r} must be finite everywhere", key="spectra")
            if not sd > 0:
                raise InputError(
                    f"the standard deviation of the unknown {name!r} must be above 0 or 'free', not {sd:g}", key="sd"
                )
        for name, expected in zip(("of_flare", "mean"), shapes, strict=True):
            values = np.asarray(getattr(self, name), np.float64)
            values = values if values.size else np.zeros(expected)
            if values.shape != expected or not np.isfinite(values).all():
                raise InputError(
                    f"{name} of the unknowns must be finite and of the shape {expected}; its shape is {values.shape}",
                    key=name,
                )
            object.__setattr__(self, name, values)

    @classmethod
    def of(cls, quiet: Expectation, sd: Mapping[str, float], own: Mapping[str, Float] | None = None) -> Nuisances:
        """Compute the nuisance spectra of a quiescent exposure.

        `sd` holds prior standard deviations by name, of `NUISANCES` or `own`, infinite to project a parameter out;
        `own` holds user-defined spectra, DN of the exposure for unit amplitude, shape (n_pixel,). Raises InputError for
        a spectrum that has another shape, or is zero in all pixels.
        """
        own, shape = own or {}, quiet.wavelength_nm.shape
        spectra, of_flare = (np.zeros((len(sd), *shape)) for _ in range(2))
        for k, name in enumerate(sd):
            spectrum = np.asarray(own[name], np.float64) if name in own else spectrum_of(name, quiet)
            if name not in own and (change := NUISANCES[name].of_flare) is not None:
                of_flare[k] = change(quiet)
            if spectrum.shape != shape:
                raise InputError(
                    f"the spectrum of the unknown {name!r} must have one value for each of the {shape[0]} pixels, but "
                    f"has the shape {spectrum.shape}",
                    key="own",
                )
            if not spectrum.any():
                message = f"the unknown {name!r} must change pixels of {quiet.name}, but changes none"
                raise InputError(message, key="own")
            spectra[k] = spectrum
        return cls(tuple(sd), spectra, np.array(list(sd.values()), np.float64), of_flare)

    def _line(self) -> str:
        priors = zip(self.names, self.sd, strict=True)
        return ", ".join(f"{name} +-{sd:g}" if np.isfinite(sd) else f"{name} free" for name, sd in priors)

    def __bool__(self) -> bool:
        return bool(self.names)

    @property
    def free(self) -> int:
        """Number of projected-out parameters."""
        return int(np.isinf(self.sd).sum())

    def without(self, names: Collection[str]) -> Nuisances:
        """Return all parameters but those named."""
        return self._rows([i for i, name in enumerate(self.names) if name not in names])

    def _rows(self, rows: list[int]) -> Nuisances:
        spectra, sd, of_flare, mean = (values[rows] for values in (self.spectra, self.sd, self.of_flare, self.mean))
        return Nuisances(tuple(self.names[i] for i in rows), spectra, sd, of_flare, mean, self.factor_prior)

    def with_spectrum(self, name: str, spectrum: Float, sd: float) -> Nuisances:
        """Return the parameters with another one that leaves the light of a flare as it is."""
        self._check_pixels(spectrum=spectrum)
        return self.joined(Nuisances((name,), spectrum[None], np.array([sd])))

    def _check_pixels(self, **arrays: Float) -> None:
        """Raise InputError unless arrays have a value for each pixel."""
        expected = (self.spectra.shape[1],)
        for key, values in arrays.items():
            if values.shape != expected:
                raise InputError.of(key, values.shape, f"the shape {expected}, one value for each pixel")

    def joined(self, other: Nuisances) -> Nuisances:
        """Return these parameters and others."""
        spectra, of_flare = np.vstack([self.spectra, other.spectra]), np.vstack([self.of_flare, other.of_flare])
        sd, mean = np.append(self.sd, other.sd), np.append(self.mean, other.mean)
        prior = np.hstack([self.factor_prior, other.factor_prior])
        return Nuisances((*self.names, *other.names), spectra, sd, of_flare, mean, prior)

    def with_prior(self, name: str, mean: float, sd: float) -> Nuisances:
        """Return the parameters with another prior of one amplitude."""
        chosen = np.array([parameter == name for parameter in self.names])
        return replace(self, sd=np.where(chosen, sd, self.sd), mean=np.where(chosen, mean, self.mean))

    @property
    def _are_factors(self) -> NDArray[np.bool_]:
        """Mask of the parameters that multiply all light, that of a flare included, shape (k,)."""
        return np.asarray((self.of_flare == 1.0).all(axis=1))

    @property
    def has_factor(self) -> bool:
        """Whether the last parameter multiplies all light, that of a flare included; see `around`."""
        return bool(self._are_factors[-1:].any())

    def around(self, flare_dn: Float) -> Nuisances:
        """Return the parameters for fits of a flare next to one that is recorded with these DN.

        The factor on all light is the last one, and its spectrum is that without a flare: fits find the flare as it is
        recorded. The spectra of the others include the flare.
        """
        self._check_pixels(flare_dn=flare_dn)
        order, factors = [*range(len(self.names))], np.flatnonzero(self._are_factors)
        if factors.size:
            order.append(order.pop(int(factors[0])))
        spread = self._rows(order)
        spectra = spread.spectra + spread.of_flare * flare_dn
        if factors.size:
            spectra[-1] = spread.spectra[-1]
        return replace(spread, spectra=spectra)

    @property
    def mean_factor(self) -> float:
        """Prior mean of the factor on all light, that of a flare included."""
        return 1.0 + float(self.mean[self._are_factors].sum())

    @property
    def mean_dn(self) -> Float:
        """Mean change of the exposure by the priors' means, DN, shape (n_pixel,)."""
        return np.asarray(self.mean @ self.spectra)

    def fitted_dn(self, counts: Float, variance: Float, flare_dn: Float) -> Float:
        """Return the light of the unknowns, fitted together with a flare to counts less the star's, all (n_pixel,).

        The variance is infinite for pixels that are left out.
        """
        self._check_pixels(counts=counts, variance=variance, flare_dn=flare_dn)
        # The amplitude of the flare has a flat prior.
        sd = np.append(self.sd, np.inf)
        amplitudes = fitted_amplitudes(np.vstack([self.spectra, flare_dn]), sd, counts, variance)
        return np.asarray(amplitudes[:-1] @ self.spectra)

    def finite(self, spectra: Float) -> Float:
        """Return the spectra with finite priors times their standard deviations, shape (k_finite, n)."""
        has_prior = np.isfinite(self.sd)
        return np.asarray(spectra[has_prior] * self.sd[has_prior, None])

    def rows(self, variance: Float, spectra: Float) -> Float:
        """Return the rows of x^T C^-1 x = sum x^2 / v - sum (rows @ x)^2 (Woodbury identity), shape (k, n).

        The diagonal v, `variance`, is zero for unused values. Raises InputError if projected-out spectra are linearly
        dependent.
        """
        inverse = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0)
        information = np.diag(self.sd**-2.0) + (spectra * inverse) @ spectra.T
        # Scaled to standard deviations, because amplitudes have different units.
        scale = np.sqrt(np.diag(information))
        eigenvalues = np.linalg.eigvalsh(information / np.outer(scale, scale))
        if eigenvalues[0] < 1e-10:
            raise InputError(
                f"the unknowns {', '.join(self.names)} cannot be distinguished in these pixels; use fewer of them or "
                "standard deviations instead of 'free'",
                key="nuisances",
            )
        return np.asarray(np.linalg.solve(np.linalg.cholesky(information), spectra * inverse))


def fitted_amplitudes(rows: Float, sd: Float, values: Float, variance: Float) -> Float:
    """Return the most likely amplitudes, (k,), of known rows, (k, n), in values, with normal priors of mean zero."""
    information = (rows / variance) @ rows.T + np.diag(sd**-2.0)
    # Scaled, because amplitudes have different units.
    scale = np.sqrt(np.diag(information))
    scaled, *_ = np.linalg.lstsq(information / np.outer(scale, scale), (rows / variance) @ values / scale)
    return np.asarray(scaled / scale)


def spectrum_of(name: str, quiet: Expectation) -> Float:
    """Return the spectrum of one of `NUISANCES`, DN of the exposure for unit amplitude, shape (n_pixel,)."""
    if name not in NUISANCES:
        raise InputError(
            f"the unknown {name!r} has no spectrum; use one of {', '.join(NUISANCES)} or a file", key="nuisances"
        )
    return np.asarray(NUISANCES[name].spectrum(quiet))


def join_names(names: Sequence[str]) -> str:
    """Join names for a sentence: "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def read_at_pixels(kind: Literal["weights", "spectrum"], name: str, path: Path, wavelength_nm: Float) -> Float:
    """Read weights per DN of a statistic, or the spectrum of an unknown in DN per exposure, and apply `at_pixels`."""
    from mauvecl.host.tables.text_tables import columns

    source, unit = f"{kind} {shortened(path.name)} of {shortened(name)}", "DN" if kind == "spectrum" else kind
    rows = columns(source, read_text(path, kind), f"wavelengths and {unit}", "nm")
    return at_pixels(source, unit, rows, wavelength_nm)


def at_pixels(source: str, kind: str, rows: Float, wavelength_nm: Float) -> Float:
    """Interpolate rows of wavelength, nm, and value linearly to pixels, 0 outside their range.

    `source` and `kind` name the source and its values in messages.
    """
    if rows.ndim != 2 or rows.shape[1] != 2:
        raise InputError(f"{source} must have two columns, nm and {kind}, but have the shape {rows.shape}", key=source)
    if not np.all(np.diff(rows[:, 0]) > 0):
        raise InputError(f"{source} must ascend in wavelength", key=source)
    sizes = np.abs(rows)
    bad = ~((rows == 0) | ((sizes >= SMALLEST) & (sizes <= LARGEST)))
    if bad.any():
        raise InputError(
            f"{source} must be 0 or of a size from {SMALLEST:g} to {LARGEST:g}, but hold {rows[bad][0]:g}", key=source
        )
    values = np.interp(wavelength_nm, rows[:, 0], rows[:, 1], left=0.0, right=0.0)
    if not values.any():
        raise InputError(
            f"{source} must differ from 0 somewhere in {wavelength_nm.min():.0f}-{wavelength_nm.max():.0f} nm",
            key=source,
        )
    return np.asarray(values)
