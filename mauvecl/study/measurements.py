"""Study section for measurements."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import model_validator

from mauvecl.schema import parsing
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, Help, Range, Widget
from mauvecl.schema.physical import Positive, Wavelength
from mauvecl.schema.section import Section

if TYPE_CHECKING:
    from mauvecl.study.sections import Flare

FittedModel = Literal["blackbody", "balmer", "lines", "two-temperatures"]


class MeasureQuestion(Section):
    """Models that are fitted to simulated exposures."""

    models: Annotated[
        tuple[FittedModel, ...],
        Help("Fitted model", default="the flare's, and simpler ones"),
        Flag("--model", read=parsing.words),
    ] = ()
    lines: Annotated[
        tuple[str, ...],
        Help("Line that the model 'lines' fits", default="the flare's"),
        Flag("--fit-line", read=parsing.words),
    ] = ()
    fits: Annotated[int, Range(1, 1_000_000), Help("Simulated exposures of each flare"), Flag("--fits")] = 1000
    bands_nm: Annotated[
        tuple[tuple[Wavelength, Wavelength], ...], Help("Wavelength ranges for which the flux is reported")
    ] = ((200.0, 320.0), (200.0, 700.0))
    skipped_nm: Annotated[
        tuple[tuple[Wavelength, Wavelength], ...],
        Help("Wavelengths that fits leave out, from:to", "as in 322:368"),
        Flag("--skip", kind=list[str], read=parsing.wavelengths),
        Widget(
            label="Leave out wavelengths",
            hint="Ranges in nm that fits do not use, such as 322:368, or 200:250, 322:368.",
            group="Measurement",
            unit="nm",
        ),
    ] = ()
    snr_per_bin: Annotated[
        Positive | None,
        Help("S/N of bins of frames in which the flares of the study's stare are measured against time"),
        Flag("--snr-per-bin"),
        Widget(
            label="S/N of bins",
            hint="Simulated fits then also measure the flare of a stare of one orbit against time, in bins of frames "
            "in which it reaches this S/N. Nothing: they do not.",
            group="Measurement",
        ),
    ] = None
    joint_fit: Annotated[
        bool,
        Help(
            "Fit shape, temperature and, if it falls, cooling of the flare to all frames of the study's stare together"
        ),
        Flag("--joint-fit"),
        Widget(
            label="Joint fit",
            hint="Simulated fits then also fit shape and spectrum of the flare to all frames of a stare of one orbit "
            "together: its peak, half-width, amplitude and temperature.",
            group="Measurement",
        ),
    ] = False

    @property
    def along_stare(self) -> bool:
        """True if flares are measured along a stare."""
        return self.snr_per_bin is not None or self.joint_fit

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.lines:
            from mauvecl.host.stars.flare_spectra import EmissionLine

            for name in self.lines:
                EmissionLine.named(name)
        for key in ("bands_nm", "skipped_nm"):
            for low, high in getattr(self, key):
                if not 0 < low < high:
                    raise InputError.of(f"measure.{key}", (low, high), "ascending wavelengths", unit="nm")
        return self


def fitted_models(asked: MeasureQuestion, flare: Flare) -> list[tuple[FittedModel, bool, tuple[str, ...]]]:
    """Return the name of each fitted model, whether it has a Balmer continuum, and its lines."""
    light = flare.spectrum
    lines = asked.lines or tuple(dict.fromkeys((*light.lines, *light.line_fluxes)))
    models = list(asked.models)
    if not models:
        models = ["blackbody"]
        if light.second_area is not None:
            models += ["two-temperatures"]
        elif not flare.is_blackbody:
            models += ["balmer", "lines"] if lines else ["balmer"]
    # Next to two blackbodies, lines are fitted without a Balmer continuum.
    with_lines = "two-temperatures" if light.second_area is not None else "lines"
    return [(name, name in ("balmer", "lines"), lines if name in ("lines", with_lines) else ())
            for name in dict.fromkeys(models)]  # fmt: skip
