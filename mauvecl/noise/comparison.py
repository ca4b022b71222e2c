"""What an observed spectrum is compared with, and by whose variances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from mauvecl.host.arguments import public
from mauvecl.host.errors import InputError
from mauvecl.host.quantities import count

#: Quiescent exposures that one stack may hold.
MOST_EXPOSURES = 1000


@public
@dataclass(frozen=True)
class Comparison:
    """The quiescent spectrum that is subtracted, and the variances that are divided by.

    Attributes
    ----------
    exposures : int
        Noisy quiescent exposures whose mean is subtracted; 0 for their expectation, which has no noise.
    estimated : bool
        Variances from the counts themselves, as an observer must, or from the model.
    """

    exposures: int = 0
    estimated: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "exposures", count("exposures", self.exposures, high=MOST_EXPOSURES))

    @classmethod
    def of(cls, reference: str = "template", variances: str = "model") -> Self:
        """From words.

        Parameters
        ----------
        reference : str
            ``"template"``, the expectation itself; ``"exposure"`` or ``"stack:n"`` with n of 1 and more exposures.
        variances : {"model", "estimated"}

        Raises
        ------
        InputError
            For other words.
        """
        if variances not in ("model", "estimated"):
            raise InputError(f"variances = {variances!r}, expected 'model' or 'estimated'")
        return cls(_exposures(reference), variances == "estimated")

    @property
    def added_variance(self) -> float:
        """Variance of what is subtracted, in that of one exposure."""
        return 1.0 / self.exposures if self.exposures else 0.0

    @property
    def plain(self) -> bool:
        """Whether nothing but the expectation and the model's variances is needed."""
        return not (self.exposures or self.estimated)


def _exposures(reference: str) -> int:
    word, colon, number = reference.partition(":")
    if not colon and word in ("template", "exposure"):
        return int(word == "exposure")
    if word == "stack" and number.isdecimal() and 1 <= int(number) <= MOST_EXPOSURES:
        return int(number)
    raise InputError(
        f"reference = {reference!r}, expected 'template', 'exposure' or 'stack:n' with n from 1 to {MOST_EXPOSURES}"
    )


#: The expectation, and the model's variances.
NOISE_FREE = Comparison()
