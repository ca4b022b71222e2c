"""What a study asks of a measurement."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from mauvecl.study.part import Part

if TYPE_CHECKING:
    from mauvecl.study.study import Study

FittedModel = Literal["blackbody", "balmer", "lines"]


class MeasureQuestion(Part):
    """Which models are fitted to how many simulated exposures.

    Attributes
    ----------
    models : tuple of str
        Fitted models, the simplest first: a blackbody, with a Balmer continuum, with lines too; by default those that
        the flare's spectrum is made of, and each simpler one.
    lines : tuple of str
        Lines that are fitted; those of the flare's spectrum by default.
    fits : int
        Simulated exposures of each flare.
    bands_nm : tuple of tuple
        Wavelengths between which the light is reported.
    """

    models: tuple[FittedModel, ...] = ()
    lines: tuple[str, ...] = ()
    fits: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    bands_nm: tuple[tuple[float, float], ...] = ((200.0, 320.0), (200.0, 700.0))

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.lines:
            from mauvecl.host.stars.flare_spectra import EmissionLine

            for name in self.lines:
                EmissionLine.named(name)
        for low, high in self.bands_nm:
            if not 0 < low < high:
                raise ValueError(f"measure.bands_nm holds {low:g} to {high:g} nm, expected ascending wavelengths")
        return self


def fitted_models(study: Study) -> list[tuple[str, bool, tuple[str, ...]]]:
    """Return each fitted model: its name, whether it has a Balmer continuum, and its lines."""
    asked, light = study.measure, study.flare.spectrum
    lines = asked.lines or tuple(dict.fromkeys((*light.lines, *light.line_fluxes)))
    models = list(asked.models)
    if not models:
        models = ["blackbody"] if study.flare.is_blackbody else ["blackbody", "balmer"]
        models += ["lines"] if lines else []
    return [(name, name != "blackbody", lines if name == "lines" else ()) for name in dict.fromkeys(models)]


def without_usual_measure(data: dict[str, Any], study: Study) -> None:
    """Leave out of a study's text what it does not say of measurements."""
    if study.measure == MeasureQuestion():
        del data["measure"]
