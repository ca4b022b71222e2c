"""Additive noise processes: charge that reaches pixels in addition to that of light and dark current."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar, Self

from mauvecl.schema.calls import validated
from mauvecl.schema.section import Section

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mauvecl.host.expectation import Expectation

    Float = NDArray[np.float64]

#: Events in a pixel and draw with a smaller probability are neglected.
NEGLIGIBLE = 2.0**-40


@validated
class AdditiveProcess(Section, ABC):
    """Charge that each pixel collects independently in each draw, and the study section that describes it.

    Kernels draw it from a table of `charge` in a separate stream, multiply it by the gain, and add it to the other
    noise of the pixel. Subclasses are listed in `unknowns.ADDITIVE` by their study keys.
    """

    #: Number of the random stream in `layout.STREAMS`.
    stream: ClassVar[int]
    #: Name in messages and tables.
    label: ClassVar[str]

    @abstractmethod
    def charge(self, seconds: float) -> Float:
        """Return the probabilities of 0, 1, 2, ... electrons in a pixel in a time, shape (n,).

        The omitted tail has a probability below `NEGLIGIBLE`.
        """

    @abstractmethod
    def most_electrons(self, seconds: float) -> int:
        """Return the charge that a pixel exceeds in a time with a probability of at most `NEGLIGIBLE`."""

    def variance_dn2(self, quiet: Expectation) -> Float:
        """Return the added variance of each pixel in a frame, DN^2, shape (n_pixel,)."""
        import numpy as np

        charge = self.charge(quiet.frame_s)
        electrons = np.arange(charge.size)
        variance = float(charge @ electrons**2 - (charge @ electrons) ** 2)
        return np.asarray(variance * quiet.gain_dn_per_electron**2)

    @property
    def particles_per_cm2_s(self) -> float | None:
        """Rate of incident particles, or None if the process is not caused by particles from outside."""
        return None

    def with_particles(self, rate_per_cm2_s: float) -> Self:
        """Return the process at another rate of incident particles."""
        return self

    @property
    def assumption(self) -> tuple[str, str, str]:
        """Row of a table of assumptions: quantity, value and source."""
        return (self.label, "", "the study")
