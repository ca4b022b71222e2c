"""Closed-form answers to a visitor's question."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.answers.detection.unknown_cost import cost_lines, marginal_lines, unknown_cost
from mauvecl.detection.distributions import Gaussian, Mixture
from mauvecl.detection.requests import STATISTICS
from mauvecl.schema.errors import InputError
from mauvecl.study.messages import collect_messages
from mauvecl.web.fields import UNKNOWN, star_words
from mauvecl.web.interpolated_form import InterpolatedForm

if TYPE_CHECKING:
    from mauvecl.detection.statistics import DetectionForms
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.stars.source import Source
    from mauvecl.study.cases import Case
    from mauvecl.study.study import Study
    from mauvecl.web.question import Question

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ClosedForms:
    """Closed-form answer to a question."""

    question: Question
    case: Case
    #: Content of the visitor's files, as arguments of the verb by name.
    given: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls, question: Question, folder: Path, *, headline: bool = True, given: Mapping[str, Any] | None = None
    ) -> ClosedForms:
        """Answer a question.

        Raises InputError for incompatible values.

        Parameters
        ----------
        folder : Path
            Folder to which an uploaded spectrum is written for the study.
        headline : bool
            Whether the chance of detection is asked, without which a star may be too bright for it.
        given : mapping, optional
            Contents of the visitor's files.
        """
        case = question.case(folder)
        if question.as_bright_as_observed:
            values = {**question.values, "amplitude_percent": 100 * case.amplitudes[0]}
            question = replace(question, values=values)
        closed = cls(question, case, given or {})
        if headline:
            _ = closed.odds
        return closed

    @cached_property
    def odds(self) -> DetectionForms:
        """Closed form of the requested statistic, for Gaussian noise."""
        one, setting = STATISTICS[self.question.statistic], self.case.setting(self.quiet, self.flare)
        if not setting.used.any():
            name = self.quiet.name
            raise InputError(f"every pixel of {name} is saturated", "a fainter star", key="magnitude", value=name)
        one.check(setting)
        return one.detection_forms(setting, self.flare, self.question.fap)

    @cached_property
    def chance(self) -> float:
        """Probability of detection; NaN if the flare saturates every used pixel."""
        used = self.case.setting(self.quiet, self.flare).used
        return float("nan") if self.flare.saturated[used].all() else self.odds.probability

    @property
    def study(self) -> Study:
        """The question as a study."""
        return self.case.study

    @property
    def quiet(self) -> Expectation:
        """Expectation of the star without the flare."""
        return self.case.quiet

    @property
    def flare(self) -> Expectation:
        """Expectation of the star with the flare."""
        return self.case.flares[0]

    def assuming(self, unknown: str, *, instrument: str | None = None) -> ClosedForms:
        """Return the answer to the question with another choice of what is unknown, or another payload."""
        question = {"unknown": unknown, "instrument": instrument or self.question.instrument}
        if question.items() <= self.question.values.items():
            return self
        study = self.study
        sections: dict[str, Any] = {"nuisances": study.nuisances.model_copy(update={"usual": unknown == UNKNOWN[1]})}
        if question["instrument"] != self.question.instrument:
            sections["observation"] = study.observation.model_copy(update={"instrument": question["instrument"]})
        case = self.case.with_sections(**sections)
        return ClosedForms(replace(self.question, values={**self.question.values, **question}), case)

    @cached_property
    def light(self) -> tuple[Source, Source]:
        """The star at the telescope, without and with the flare."""
        return self.case.source, self.case.flaring(self.case.amplitudes[0])

    @cached_property
    def null(self) -> InterpolatedForm:
        """Distribution of the statistic without a flare, for pictures."""
        return InterpolatedForm(self.odds.null)

    @cached_property
    def seen(self) -> InterpolatedForm:
        """Distribution of the statistic with the flare, for pictures."""
        return InterpolatedForm(self.odds.flaring)

    @cached_property
    def messages(self) -> list[str]:
        """Messages for the visitor, the most severe first."""
        nuisances = self.study.nuisances
        cost = unknown_cost("this flare", self.quiet, self.flare, nuisances, self.study.run.comparison())
        return [
            *collect_messages([self.quiet, self.flare]),
            *marginal_lines(nuisances),
            *cost_lines([cost], nuisances),
        ]

    @property
    def words(self) -> str:
        """Question in words, as part of a sentence."""
        q, x = self.question, self.quiet
        frames = "one frame" if x.n_frames == 1 else f"{x.n_frames} frames"
        star = "your own star" if q.uploaded is not None else star_words(q.star)
        return (
            f"a {q.amplitude_percent:g} % flare ({self.study.flare.light().describe()}) on {star} of {q.band} = "
            f"{q.magnitude:g}, in {x.exposure_s:g} s ({frames})"
        )

    def at(self, light: float, rises: Float, *, sky: bool = False) -> list[DetectionForms]:
        """Return the closed forms for scaled light, or an empty list if the star saturates every pixel.

        Parameters
        ----------
        light : float
            Factor on the light of star and flare.
        rises : ndarray, shape (n_rise,)
            Factors on the flare's amplitude.
        sky : bool
            Whether the sky's light changes with the star's, as for another throughput.
        """
        q, base = self.question, self.quiet
        one, rise = STATISTICS[q.statistic], self.flare.source_electrons - base.source_electrons
        behind = base.sky_electrons * (light if sky else 1.0)
        quiet = replace(base, source_electrons=light * base.source_electrons, sky_electrons=behind)
        setting = self.case.setting(quiet)
        if not setting.used.any():
            return []
        electrons = (light * (base.source_electrons + more * rise) for more in rises)
        return [one.detection_forms(setting, replace(quiet, source_electrons=light), q.fap) for light in electrons]

    @property
    def slow(self) -> bool:
        """Whether closed forms are slow: sums of squares integrated over random factors."""
        return isinstance(self.odds.null, Mixture) and not isinstance(self.odds.null.parts[0], Gaussian)

    @property
    def excess(self) -> tuple[Float, Float]:
        """Flare minus quiet in standard deviations of the noise, per pixel and per resolution element."""
        x = self.quiet
        rise = np.where(x.saturated, 0.0, self.flare.signal_dn - x.signal_dn)
        noise2 = np.where(x.saturated, 0.0, x.variance_dn2)
        pixel = np.divide(rise, np.sqrt(x.variance_dn2))
        total = x.per_element(noise2)
        element = np.divide(x.per_element(rise), np.sqrt(total), out=np.zeros(total.size), where=total > 0)
        return pixel, element


def percent(value: float) -> str:
    """Format a probability, with bounds instead of 0 and 100 %."""
    if value != value:
        return "no number"
    if value > 0.9999:
        return "> 99.99 %"
    if value < 0.0001:
        return "< 0.01 %"
    shown = 100 * value
    return f"{shown:.2f} %" if shown < 1 or shown > 99 else f"{shown:.1f} %"


def between(low: float, high: float) -> str:
    """Format an interval of probabilities."""
    ends = dict.fromkeys([percent(low), percent(high)])
    return " to ".join(ends)


def short(value: float) -> str:
    """Format a number with three significant digits and no power of ten."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
