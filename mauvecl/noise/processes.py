"""Optional noise processes with separate random streams, disabled by default.

Their values are unknown to the observer: references and variances remain those of the expectation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mauvecl.noise import layout
from mauvecl.noise.prior_tables import table_of
from mauvecl.noise.priors import Normal, Prior, Uniform
from mauvecl.noise.unknowns import PROCESSES, Conditions, SignalPart
from mauvecl.schema.calls import public
from mauvecl.schema.errors import InputError
from mauvecl.schema.quantities import count, number

__all__ = ["NONE", "CosmicRays", "Factors", "Normal", "Prior", "Processes", "Uniform"]

Float = NDArray[np.float64]

#: Numbers of hits in a pixel and draw with a smaller probability are neglected.
NEGLIGIBLE = 2.0**-40


@public
@dataclass(frozen=True)
class CosmicRays:
    """Hits by charged particles; the defaults are assumptions (INSTRUMENT.md: outside the South Atlantic Anomaly).

    Attributes
    ----------
    rate_per_cm2_s : float
        Hits per area and time.
    area_cm2 : float
        Area of the whole detector: 2048 pixels of 14 x 200 um.
    pixels : int
        Number of pixels that share the area; a hit affects one pixel.
    electrons : tuple of float, shape (2,)
        Smallest and largest number of electrons of a hit.
    weights : tuple of float, optional
        Relative probabilities of the integers in this range; equal by default.
    """

    rate_per_cm2_s: float = 1.0
    area_cm2: float = 0.057
    pixels: int = 2048
    electrons: tuple[float, float] = (500.0, 1000.0)
    weights: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "rate_per_cm2_s", number("cosmic-ray rate", self.rate_per_cm2_s, "1 / (cm2 s)"))
        object.__setattr__(self, "area_cm2", number("detector area", self.area_cm2, "cm2"))
        object.__setattr__(self, "pixels", count("pixels", self.pixels, low=1))
        low, high = self.electrons
        if not (0 <= self.rate_per_cm2_s <= 1e6 and 0 < self.area_cm2 < 1e4 and self.pixels > 0):
            raise InputError(
                f"cosmic rays of {self.rate_per_cm2_s:g} per cm^2 s on {self.area_cm2:g} cm^2 and {self.pixels} pixels",
                "a rate of 0 to 1e6, an area and pixels above 0",
                key="rate_per_cm2_s",
                value=self.rate_per_cm2_s,
            )
        if not 1 <= low <= high <= 100_000:
            raise InputError.of("electrons", (low, high), "1 to 100000, ascending", where="cosmic rays")
        if self.weights is not None:
            wanted = int(high) - int(low) + 1
            if len(self.weights) != wanted or min(self.weights) < 0 or not 0 < sum(self.weights) < np.inf:
                raise InputError(
                    f"{len(self.weights)} weights of the cosmic rays' electrons",
                    f"{wanted} of 0 and above",
                    key="weights",
                    value=self.weights,
                )

    def charge(self, seconds: float) -> Float:
        """Compute the distribution of the charge that a pixel collects in a time, a compound Poisson distribution.

        Returns
        -------
        ndarray, shape (n,)
            Probabilities of 0, 1, 2, ... electrons; the omitted tail has a probability below `NEGLIGIBLE`.
        """
        seconds = number("time", seconds, "s", low=0.0)
        low, high = (int(e) for e in self.electrons)
        hits, most = self._hits(seconds), self.most_electrons(seconds)
        size = 1 << (most + 1).bit_length()
        if size > 2**24:
            raise InputError(
                f"cosmic rays free up to {most} electrons in a pixel and draw",
                f"at most {2**23}: lower the rate, the charge or the exposure",
                key="rate_per_cm2_s",
                value=most,
            )
        one = np.zeros(size)
        one[low : high + 1] = 1.0 if self.weights is None else self.weights
        # This is the generating function of a Poisson number of hits; charges beyond `size` would alias.
        spectrum = np.exp(hits * (np.fft.rfft(one / one.sum()) - 1.0))
        return np.maximum(np.fft.irfft(spectrum, size)[: most + 1], 0.0)

    def most_electrons(self, seconds: float) -> int:
        """Return the charge that a pixel exceeds in a time with a probability of at most `NEGLIGIBLE`."""
        from scipy import special

        hits = self._hits(number("time", seconds, "s", low=0.0))
        most = max(1, int(hits))
        while special.pdtrc(most, hits) > NEGLIGIBLE:
            most += 1
        return most * int(self.electrons[1])

    def _hits(self, seconds: float) -> float:
        """Return the mean number of hits in one pixel."""
        return self.rate_per_cm2_s * self.area_cm2 / self.pixels * seconds


@public
@dataclass(frozen=True)
class Processes:
    """Optional noise processes; those that are None are disabled.

    Attributes
    ----------
    cosmic_rays : CosmicRays, optional
        Hits by charged particles.
    jitter : Prior, optional
        Fraction of the light that a frame loses by pointing jitter, in addition to the expectation's losses; drawn per
        frame. The paper expects ``Uniform(0, 0.05)``.
    detector_temperature : Prior, optional
        Temperature in deg C, drawn per realisation; the dark current follows the instrument's law.
    light_loss, pointing_loss : Prior, optional
        Replacements of the instrument's values, drawn per realisation.
    qe_scale : Prior, optional
        Factor on the quantum efficiency, drawn per realisation.
    sky_level : Prior, optional
        Factor on the sky's light, drawn per realisation.
    """

    cosmic_rays: CosmicRays | None = None
    jitter: Prior | None = None
    detector_temperature: Prior | None = None
    light_loss: Prior | None = None
    pointing_loss: Prior | None = None
    qe_scale: Prior | None = None
    sky_level: Prior | None = None

    @property
    def modulations(self) -> tuple[tuple[str, SignalPart], ...]:
        """Names of the enabled priors and the part of the signal that each changes."""
        return tuple((name, varied.of) for name, varied in PROCESSES.items() if getattr(self, name) is not None)

    def factors(self, conditions: Conditions) -> Factors:
        """Compute the quantile tables of the priors' factors on light, dark or sky.

        Parameters
        ----------
        conditions : mapping of float
            Values of the expectation: ``temperature_c``, ``dark_slope_per_c``, ``light_loss``, ``pointing_loss``.
        """
        tables = np.empty((len(self.modulations), 2 * layout.PRIOR_NODES), np.float32)
        ends = {"light": (1.0, 1.0), "dark": (1.0, 1.0), "sky": (1.0, 1.0)}
        centre = dict.fromkeys(ends, 1.0)
        for row, (name, factor) in enumerate(self.modulations):
            prior, varied = getattr(self, name), PROCESSES[name]
            change = partial(varied.change, conditions)
            first, last = prior.quantile(np.array([0.0, 1.0]))
            if not (varied.low <= first and last <= varied.high):
                raise InputError(
                    f"the prior of {name} runs from {first:g} to {last:g}",
                    f"{varied.low:g} to {varied.high:g}",
                    key=name,
                    value=(first, last),
                )
            tables[row], middle = table_of(prior, change)
            centre[factor] *= 1.0 + middle
            least, most = sorted(1.0 + change(np.array([first, last])))
            ends[factor] = ends[factor][0] * float(least), ends[factor][1] * float(most)
        return Factors(tables, centre["light"], centre["dark"], centre["sky"], ends["light"], ends["dark"], ends["sky"])


@dataclass(frozen=True, eq=False)
class Factors:
    """Factors of priors on light, dark and sky; factors on light include the sky's light.

    Attributes
    ----------
    tables : ndarray of float32, shape (n_modulation, 2 * layout.PRIOR_NODES)
        Quantile tables; see `prior_tables.table_of`.
    light, dark, sky : float
        Factors at the priors' medians, to which the tables are relative.
    light_ends, dark_ends, sky_ends : tuple of float, shape (2,)
        Smallest and largest factors of all priors together.
    """

    tables: NDArray[np.float32]
    light: float
    dark: float
    sky: float
    light_ends: tuple[float, float]
    dark_ends: tuple[float, float]
    sky_ends: tuple[float, float]

    @staticmethod
    def on_light(light: float, sky: float, share: Float) -> Float:
        """Return the factor on each pixel's total light, of which the sky has this share, shape (n_pixel,)."""
        return np.asarray(light * (1.0 + (sky - 1.0) * share))


NONE = Processes()
