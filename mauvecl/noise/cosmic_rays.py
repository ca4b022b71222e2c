"""Cosmic rays: hits of single pixels by charged particles."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Self

from pydantic import model_validator

from mauvecl.noise.additive import NEGLIGIBLE, AdditiveProcess
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Unit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Float = NDArray[np.float64]

#: Rate of hits per area.
ParticleRate = Annotated[float, Unit("1 / (cm2 s)"), Range(0, 1e6)]


@validated
class CosmicRays(AdditiveProcess):
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

    stream: ClassVar[int] = 3
    label: ClassVar[str] = "cosmic rays"

    rate_per_cm2_s: ParticleRate = 1.0
    area_cm2: Annotated[float, Unit("cm2"), Range(0, 1e4, open_low=True)] = 0.057
    pixels: Annotated[int, Range(1)] = 2048
    electrons: tuple[float, float] = (500.0, 1000.0)
    weights: tuple[float, ...] | None = None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        low, high = self.electrons
        if not 1 <= low <= high <= 100_000:
            raise InputError.of("electrons", (low, high), "1 to 100000, ascending", where="cosmic rays")
        if self.weights is not None:
            wanted = int(high) - int(low) + 1
            if len(self.weights) != wanted or min(self.weights) < 0 or not sum(self.weights) > 0:
                raise InputError.of("weights", self.weights, f"{wanted} of 0 and above", where="cosmic rays")
        return self

    def charge(self, seconds: Annotated[float, Unit("s"), Range(0)]) -> Float:
        """Return the distribution of the charge that a pixel collects in a time, a compound Poisson distribution."""
        import numpy as np

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
        return np.asarray(np.maximum(np.fft.irfft(spectrum, size)[: most + 1], 0.0))

    def most_electrons(self, seconds: Annotated[float, Unit("s"), Range(0)]) -> int:
        """Return the charge that a pixel exceeds in a time with a probability of at most `NEGLIGIBLE`."""
        from scipy import special

        hits = self._hits(seconds)
        most = max(1, int(hits))
        while special.pdtrc(most, hits) > NEGLIGIBLE:
            most += 1
        return most * int(self.electrons[1])

    def _hits(self, seconds: float) -> float:
        """Return the mean number of hits in one pixel."""
        return self.rate_per_cm2_s * self.area_cm2 / self.pixels * seconds

    @property
    def particles_per_cm2_s(self) -> float:
        """Rate of incident particles."""
        return self.rate_per_cm2_s

    def with_particles(self, rate_per_cm2_s: ParticleRate) -> Self:
        """Return the process at another rate of incident particles."""
        return self.model_copy(update={"rate_per_cm2_s": rate_per_cm2_s})

    @property
    def assumption(self) -> tuple[str, str, str]:
        """Row of a table of assumptions: quantity, value and source."""
        low, high = self.electrons
        return ("charge of a hit", f"{low:g} to {high:g} electrons in one pixel", "assumption; adds to the noise")
