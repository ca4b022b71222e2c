"""Reference and variances with which an observed spectrum is compared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, Self

from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range

#: Largest number of quiescent exposures in a stack.
MAX_EXPOSURES = 1000


@validated
@dataclass(frozen=True)
class Comparison:
    """Subtracted quiescent spectrum and the variances that weight the residuals.

    Attributes
    ----------
    exposures : int
        Number of noisy quiescent exposures whose mean is subtracted; 0 for the noise-free expectation.
    estimated : bool
        Whether variances are estimated from the counts, as an observer must, instead of taken from the model.
    """

    exposures: Annotated[int, Range(0, MAX_EXPOSURES)] = 0
    estimated: bool = False

    @classmethod
    def of(cls, reference: str = "template", variances: Literal["model", "estimated"] = "model") -> Self:
        """Create a comparison from its names in a study.

        Parameters
        ----------
        reference : str
            ``"template"`` for the expectation, ``"exposure"`` for one exposure, ``"stack:n"`` for n exposures.
        variances : {"model", "estimated"}
        """
        return cls(_exposures(reference), variances == "estimated")

    @property
    def added_variance(self) -> float:
        """Variance of the subtracted spectrum, relative to that of one exposure."""
        return 1.0 / self.exposures if self.exposures else 0.0

    @property
    def plain(self) -> bool:
        """Whether only the expectation and the model's variances are used."""
        return not (self.exposures or self.estimated)


def _exposures(reference: str) -> int:
    word, colon, number = reference.partition(":")
    if not colon and word in ("template", "exposure"):
        return int(word == "exposure")
    if word == "stack" and number.isdecimal() and 1 <= int(number) <= MAX_EXPOSURES:
        return int(number)
    raise InputError.of("reference", reference, f"'template', 'exposure' or 'stack:n' with n from 1 to {MAX_EXPOSURES}")


#: Comparison with the expectation by the model's variances.
NOISE_FREE = Comparison()
