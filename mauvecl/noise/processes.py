"""Optional noise: processes with separate random streams, disabled by default, and the noise of comparisons.

Their values are unknown to the observer: references and variances remain those of the expectation. This module stands
apart from the registry of its rows, so that a process that is added to the registry at run time is a field of
`Processes`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from pydantic import create_model

from mauvecl.noise.disturbances import AdditiveProcess, ParticleRate, PriorField
from mauvecl.noise.unknowns import ADDITIVE, PROCESSES, SignalPart
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range
from mauvecl.schema.section import Section

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
        """True if the comparison uses only the expectation and the variances of the model."""
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


_keys: Any = {name: (kind | None, None) for name, kind in ADDITIVE.items()} | dict.fromkeys(
    PROCESSES, (PriorField | None, None)
)


@validated
class Processes(create_model("_Processes", __base__=Section, **_keys)):  # type: ignore[misc]
    """Optional noise processes, and the study section that enables them; those that are None are disabled.

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

    @property
    def additive(self) -> dict[str, AdditiveProcess]:
        """Enabled additive processes by name."""
        return {name: process for name in ADDITIVE if (process := getattr(self, name)) is not None}

    @property
    def modulations(self) -> tuple[tuple[str, SignalPart], ...]:
        """Names of the enabled priors and the part of the signal that each changes."""
        return tuple((name, varied.of) for name, varied in PROCESSES.items() if getattr(self, name) is not None)

    @property
    def additive_only(self) -> Self:
        """The processes without priors."""
        copy: Self = self.model_copy(update=dict.fromkeys(PROCESSES))
        return copy

    @property
    def particle_processes(self) -> list[AdditiveProcess]:
        """Enabled processes that incident particles cause."""
        return [process for process in self.additive.values() if process.particles_per_cm2_s is not None]

    @property
    def particles_per_cm2_s(self) -> float:
        """Largest rate of incident particles of the enabled processes; zero without any."""
        return max((process.particles_per_cm2_s or 0.0 for process in self.particle_processes), default=0.0)

    def with_particles(self, rate_per_cm2_s: ParticleRate) -> Self:
        """Return a copy in which all processes caused by incident particles have this rate, enabled if necessary."""
        every = {name: getattr(self, name) or kind() for name, kind in ADDITIVE.items()}
        caused = {name: process for name, process in every.items() if process.particles_per_cm2_s is not None}
        update = {name: process.with_particles(rate_per_cm2_s) for name, process in caused.items()}
        copy: Self = self.model_copy(update=update)
        return copy


NONE = Processes()
