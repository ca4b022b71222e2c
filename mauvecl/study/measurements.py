"""Study section for measurements."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from mauvecl.schema.errors import InputError
from mauvecl.schema.section import Section

if TYPE_CHECKING:
    from mauvecl.study.sections import Flare

FittedModel = Literal["blackbody", "balmer", "lines"]


class MeasureQuestion(Section):
    """Models that are fitted to simulated exposures.

    Attributes
    ----------
    models : tuple of str
        Fitted models, simplest first: a blackbody, with a Balmer continuum, and with lines; by default the model of the
        flare's spectrum and all simpler ones.
    lines : tuple of str
        Fitted lines; by default those of the flare's spectrum.
    fits : int
        Number of simulated exposures per flare.
    bands_nm : tuple of tuple
        Wavelength ranges for which the flux is reported.
    snr_per_bin : float, optional
        S/N of the bins of frames in which the flares of the study's stare are measured against time.
    """

    models: tuple[FittedModel, ...] = ()
    lines: tuple[str, ...] = ()
    fits: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    bands_nm: tuple[tuple[float, float], ...] = ((200.0, 320.0), (200.0, 700.0))
    snr_per_bin: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.lines:
            from mauvecl.host.stars.flare_spectra import EmissionLine

            for name in self.lines:
                EmissionLine.named(name)
        for low, high in self.bands_nm:
            if not 0 < low < high:
                raise InputError.of("measure.bands_nm", (low, high), "ascending wavelengths", unit="nm")
        return self


def fitted_models(asked: MeasureQuestion, flare: Flare) -> list[tuple[str, bool, tuple[str, ...]]]:
    """Return the name of each fitted model, whether it has a Balmer continuum, and its lines."""
    light = flare.spectrum
    lines = asked.lines or tuple(dict.fromkeys((*light.lines, *light.line_fluxes)))
    models = list(asked.models)
    if not models:
        models = ["blackbody"] if flare.is_blackbody else ["blackbody", "balmer"]
        models += ["lines"] if lines else []
    return [(name, name != "blackbody", lines if name == "lines" else ()) for name in dict.fromkeys(models)]


def drop_default_measure(data: dict[str, Any], asked: MeasureQuestion) -> None:
    """Remove the section from a study's data if it has its default values, in place."""
    if asked == MeasureQuestion():
        del data["measure"]
