"""Survey of a study's star: template bank, search, and sizes of injected flares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.flares.frames import STEADY, Components
from mauvecl.flares.shapes import shape_of
from mauvecl.schema.errors import InputError
from mauvecl.search.flare_fits import SingleFlareFit
from mauvecl.search.search import Survey
from mauvecl.search.templates import TEMPERATURES_K, Bank, Templates, frame_nuisances
from mauvecl.study.flare_light import FlareLight
from mauvecl.study.stare_expectation import energy_scale

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.study.cases import Case
    from mauvecl.study.searches import Size

#: Default range of injected sizes, in units of the size with a completeness of one half.
DEFAULT_RANGE = (0.3, 3.0)


@dataclass(frozen=True, eq=False)
class StarSurvey:
    """A star of a study with its search."""

    quiet: Expectation  # of one frame
    templates: Templates
    survey: Survey  # its only flare component is the study's flare

    @property
    def fit(self) -> SingleFlareFit:
        """Fit of detected flares."""
        return SingleFlareFit(self.survey.bank, self.templates)

    @property
    def unit_snr(self) -> float:
        """S/N of one frame for the study's flare at constant unit amplitude and known baseline."""
        x = self.survey.components
        unit = np.zeros(len(STEADY) + x.n_flares)
        unit[: len(STEADY) + 1] = 1.0
        return float(np.linalg.norm(x.means(unit)))


def survey_star(case: Case) -> StarSurvey:
    """Build the search of a case's stare."""
    frame, stare, choice, flare = case.one_frame, case.stare, case.study.search, case.study.flare
    own = frame.flare_electrons((flare.temperature_k,))
    # Templates are blackbodies if the study's flare has no temperature to vary.
    blackbody = flare.model_copy(update={"spectrum": FlareLight()})
    hot = frame if flare.spectrum.file is None else frame.with_sections(flare=blackbody)
    quiet, electrons = frame.quiet, hot.flare_electrons(TEMPERATURES_K)
    nuisances = frame_nuisances(quiet, stare, choice.spreads())
    templates = Templates.of(
        quiet,
        electrons * quiet.gain_dn_per_electron,
        TEMPERATURES_K,
        nuisances=nuisances,
        rank=choice.sums,
    )
    level = choice.level(stare, case.study.stare.orbit_s)
    bank = Bank(
        choice.half_widths_s, templates.directions[list(templates.chosen)], shape_of(choice.shape), stare.frame_s, level
    )
    survey = Survey(Components(quiet, own, templates.weights), stare, bank)
    if level.cycle and not len(survey.curves if survey.curves is not None else ()):
        raise InputError(
            "search.cycle is true but the stare has no unknown cycle", "stare.cycles", key="search.cycle", value=True
        )
    return StarSurvey(quiet, templates, survey)


@dataclass(frozen=True)
class Sizes:
    """Measure of flare size for a star: amplitude x half-width^power x per_unit."""

    of: Size
    power: int
    per_unit: float  # size of a flare of unit amplitude and a half-width of 1 s

    @classmethod
    def chosen(cls, case: Case) -> Sizes:
        """Return the measure that a case's study chooses; raises InputError for energies of a star of unknown size."""
        asked, flare_k = case.study.injections.of, case.study.flare.temperature_k
        bolometric = energy_scale(case.study, case.source, "bolometric", flare_k)
        if asked is None:
            asked = "amplitude" if bolometric is None else "energy"
        if asked == "amplitude":
            return cls("amplitude", 0, 1.0)
        area = shape_of(case.study.search.shape).equivalent_duration
        if asked == "duration":
            return cls("duration", 1, area)
        kind: Any = "bolometric" if asked == "energy" else "band"
        scale = energy_scale(case.study, case.source, kind, flare_k)
        if scale is None:
            raise InputError(
                f"injections.of = {asked!r}, but the size of {case.source.name} is unknown",
                "the star's distance_pc, or radius_rsun and effective_temperature_k",
                key="injections.of",
                value=asked,
            )
        return cls(asked, 1, area * scale.erg_per_s)

    def of_amplitude(self, amplitude: Any, half_width_s: Any) -> Any:
        """Return the sizes of amplitudes and half-widths, broadcast together."""
        return amplitude * half_width_s**self.power * self.per_unit

    def amplitude(self, size: Any, half_width_s: Any) -> Any:
        """Return the amplitudes of sizes and half-widths, broadcast together."""
        return size / (half_width_s**self.power * self.per_unit)


def injected_sizes(case: Case, sizes: Sizes, unit_snr: float, threshold: float) -> NDArray[np.float64]:
    """Return the sizes of injected flares, ascending; by default around a completeness of one half.

    `unit_snr` and `threshold` are those of the star's `StarSurvey` and its search.
    """
    asked = case.study.injections
    widths = np.array([asked.half_width_low_s, asked.half_width_high_s])
    frames = widths / case.instrument.frame_s
    # S/N of a known flare on a known baseline: (A / sigma) sqrt(square integral x half-width in frames).
    amplitude = threshold / unit_snr / np.sqrt(shape_of(case.study.search.shape).square_integral * frames)
    half = sizes.of_amplitude(amplitude, widths)
    low = DEFAULT_RANGE[0] * half.min() if asked.low is None else asked.low
    high = DEFAULT_RANGE[1] * half.max() if asked.high is None else asked.high
    if not low < high:
        raise InputError(
            f"injected sizes run from {low:.3g} to {high:.3g}",
            "low below high",
            key="injections.low",
            value=(low, high),
        )
    return np.geomspace(low, high, asked.sizes)
