"""A visitor's question as a study, and its closed forms, which answer at once."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import special
from scipy.interpolate import PchipInterpolator

from mauvecl.answers.closed_forms import unknown_cost, unknown_lines
from mauvecl.answers.limit import LimitSearch
from mauvecl.detection.distributions import Gaussian, Mixture
from mauvecl.detection.requests import STATISTICS
from mauvecl.host.arrays import Float
from mauvecl.host.exposure.expectation import entirely_saturated
from mauvecl.schema.columns import chance_range, chance_text
from mauvecl.schema.errors import InputError
from mauvecl.study.cases import Case, Loader, collect_messages
from mauvecl.study.questions import SPECTRUM
from mauvecl.study.study import Study, set_key
from mauvecl.web.fields import ASKED_UNDER, FIELDS, IDEAL, REALISTIC, UNKNOWN, WITH_FILE, sentence, star_words
from mauvecl.web.uploads import VisitorFile, write_spectrum

if TYPE_CHECKING:
    from mauvecl.answers.detect import DetectAnswer
    from mauvecl.detection.distributions import Form
    from mauvecl.detection.statistics import DetectionForms
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.stars.source import Source

Answers = Mapping[str, Any]  # simulated answers to one question, by name
OTHER = "detection otherwise"  # name of the detection with the other choice of unknowns; the card shows both
#: Labels of the choices of the field "unknown".
TITLES = {REALISTIC: "realistic: with the usual unknowns", IDEAL: "ideal: everything but the noise known"}
#: Sensible relative uncertainty of the nominal throughput (assumed; see the documentation's page on what is nominal).
THROUGHPUT = 0.3
#: Words for a limit by its quantity: before its value, the value, without a limit, and for one that takes a simulation.
LIMITS: dict[str, tuple[str, Callable[[float], str], str, str]] = {
    "amplitude": ("of at least", lambda value: f"{short(100 * value)} %", "of no amplitude", "of an amplitude"),
    "magnitude": ("to {band} =", lambda value: f"{value:.2f}", "at no magnitude", "to a magnitude"),
    "exposure": ("in", lambda value: f"{short(value)} s", "in no exposure", "in an exposure"),
}
#: Names of uploaded spectra by field, in the folder of their study.
SPECTRA = {
    "star": "star.ecsv", "flare_file": "flare.ecsv", "flare_quiescent": "quiescent.ecsv", "change_file": "added.ecsv",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class FieldValues:
    """Valid values of all fields of `fields.FIELDS`, by name, and the contents of files that stand in them."""

    values: Mapping[str, Any]
    uploads: Mapping[str, Any] = field(default_factory=dict)

    def __getattr__(self, name: str) -> Any:
        """Return the value of a field, as in ``question.magnitude``."""
        if name != "values" and name in self.values:
            return self.values[name]
        raise AttributeError(name)

    @property
    def star_in_words(self) -> str:
        """The star, as part of a sentence."""
        return "your own star" if "star" in self.uploads else star_words(self.star)

    def case(self, folder: Path) -> Case:
        """Return the question as a case, whose files are in a folder; an observed flare has its own amplitude."""
        uploaded: Source | None = self.uploads.get("star")
        # An uploaded spectrum is not read from its file at every change.
        loader = Loader(None if uploaded is None else lambda star: star.applied(uploaded))
        case = Case(Study.build(self._data(folder), "page"), loader=loader)
        return case.at_observed_brightness() if case.study.flare.spectrum.as_observed else case

    def _data(self, folder: Path) -> dict[str, Any]:
        """Return the question as the data of a study, whose files are written to a folder."""
        values = self.values
        data: dict[str, Any] = {}
        for name, page_field in FIELDS.items():
            if page_field.path and (value := self._value(name, folder)) is not None:
                set_key(data, [*page_field.path], value, name)
        star = {"library": values["star"]}
        if "star" in self.uploads:
            star = {"file": write_spectrum(self.uploads["star"], folder, SPECTRA["star"])}
        data["star"] = [data["star"] | star]
        if values["sky"] == "none":
            data["sky"] = {"none": True}
        if values["lines"]:
            data["flare"].setdefault("spectrum", {})["lines"] = dict(values["lines"])
        if "change_file" in self.uploads and SPECTRUM not in values["changes"]:
            data["change"]["of"] = (*values["changes"], SPECTRUM)
        points = self.uploads.get("own_unknown", values["own_unknown"])
        spectrum = {"own": {"points": points}} if points else {}
        data["nuisances"] = {"usual": values["unknown"] == REALISTIC, "own": spectrum}
        number, tails = values["realisations"]
        statistics = list(dict.fromkeys(["chi2", "chi2_element", values["statistic"]]))
        data["run"] |= {"realisations": number, "tails": tails, "statistics": statistics}
        return data

    def _value(self, name: str, folder: Path) -> Any:
        """Return the value of a field's key, with its file in a folder, or None if it is empty or has no effect."""
        values, uploads, page_field = self.values, self.uploads, FIELDS[name]
        conditions: dict[str, bool] = {
            # Files are written in nm.
            **dict.fromkeys(itertools.chain(*WITH_FILE.values()), False),
            **dict.fromkeys(("continue_at_k", "flare_quiescent", "as_observed"), "flare_file" in uploads),
            "change_band": "change_file" in uploads,
            **{key: values["sky"] == text for key, (parent, text) in ASKED_UNDER.items() if parent == "sky"},
            "second_area": values["second_temperature_k"] is not None,
            **dict.fromkeys(("pointing_duration", "pointing_depth"), values["pointing_rate"] is not None),
            **dict.fromkeys(("hours", "targets"), bool(values["targets"])),
        }
        value = uploads.get(name) if page_field.kind in ("file", "upload") else values[name]
        if value is None or not conditions.get(name, True):
            return None
        if page_field.kind == "upload":
            return value.written(folder)
        if page_field.kind == "file":
            return write_spectrum(value, folder, SPECTRA[name])
        if page_field.kind == "table":
            return VisitorFile("neighbours.csv", value.encode()).written(folder)
        value = value if page_field.scale == 1.0 else value / page_field.scale
        # A single flare.
        return [value] if page_field.path[-1] == "amplitudes" else value


class InterpolatedForm:
    """Closed form that is exact at some points and interpolated in the probit between them."""

    def __init__(self, form: Form) -> None:
        self.mean, self.std = form.mean, form.std
        at = np.linspace(form.mean - 5 * form.std, form.mean + 6 * form.std, 14)
        beyond = np.array([form.sf(value) for value in at])
        # Probabilities that round to 0 or 1 have no finite probit.
        inside = (beyond > 1e-12) & (beyond < 1 - 1e-12)
        self._probit = PchipInterpolator(at[inside], special.ndtri(beyond[inside]), extrapolate=True)
        self._inverse = PchipInterpolator(-special.ndtri(beyond[inside]), at[inside], extrapolate=True)

    def sf(self, value: Float) -> Float:
        """Return the probability of exceeding each value, shape of `value`."""
        return np.asarray(special.ndtr(self._probit(value)))

    def isf(self, probability: Float) -> Float:
        """Return the value that is exceeded with each probability, shape of `probability`."""
        return np.asarray(self._inverse(-special.ndtri(probability)))


@dataclass(frozen=True, eq=False)
class ClosedForms:
    """Closed-form answer to a question."""

    question: FieldValues
    case: Case
    #: Content of the visitor's files, as arguments of the verb by name.
    inputs: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls, question: FieldValues, folder: Path, *, chance: bool = True, inputs: Mapping[str, Any] | None = None
    ) -> ClosedForms:
        """Answer a question; `folder` holds the visitor's files for the study, and `inputs` their contents.

        Without the `chance` of detection, the star may be too bright for a detection.
        """
        case = question.case(folder)
        # The amplitude is that of a flare as bright as observed, if the visitor's file gives its brightness.
        values = {**question.values, "amplitude_percent": 100 * case.amplitudes[0]}
        closed = cls(replace(question, values=values), case, inputs or {})
        if chance:
            _ = closed.odds
        return closed

    @cached_property
    def odds(self) -> DetectionForms:
        """Closed form of the requested statistic, for Gaussian noise."""
        statistic, setting = STATISTICS[self.question.statistic], self.case.setting(self.quiet, self.flare)
        if not setting.used.any():
            raise entirely_saturated(self.quiet, "magnitude")
        statistic.check(setting)
        return statistic.detection_forms(setting, self.flare, self.question.fap)

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
        changes: dict[str, dict[str, Any]] = {"nuisances": {"usual": unknown == REALISTIC}}
        if question["instrument"] != self.question.instrument:
            changes["observation"] = {"instrument": question["instrument"]}
        sections = {key: getattr(self.study, key).model_copy(update=keys) for key, keys in changes.items()}
        case = self.case.with_sections(**sections)
        return ClosedForms(replace(self.question, values={**self.question.values, **question}), case)

    @cached_property
    def forms(self) -> tuple[InterpolatedForm, InterpolatedForm]:
        """Distributions of the statistic without and with the flare, for pictures."""
        return InterpolatedForm(self.odds.null), InterpolatedForm(self.odds.flaring)

    @cached_property
    def messages(self) -> list[str]:
        """Messages for the visitor, the most severe first."""
        nuisances = self.study.nuisances
        cost = unknown_cost("this flare", self.quiet, self.flare, nuisances, self.study.run.comparison())
        return [*collect_messages([self.quiet, self.flare]), *unknown_lines([cost], nuisances)]

    @property
    def words(self) -> str:
        """Question in words, as part of a sentence."""
        q, x, light = self.question, self.quiet, self.study.flare.light().describe()
        frames = "one frame" if x.n_frames == 1 else f"{x.n_frames} frames"
        star = f"{q.star_in_words} of {q.band} = {q.magnitude:g}"
        return f"a {q.amplitude_percent:g} % flare ({light}) on {star}, in {x.exposure_s:g} s ({frames})"

    def at(self, light: float, rises: Float, *, others: bool = False) -> list[DetectionForms]:
        """Return the closed forms for a brighter or fainter star and for flares of other amplitudes.

        `light` is a factor on the star's light, and if `others` on that of sky and neighbours as well; `rises`, shape
        (n_rise,), are factors on the flare's amplitude. The list is empty if the star saturates every pixel.
        """
        q, base = self.question, self.quiet
        statistic, rise = STATISTICS[q.statistic], self.flare.source_electrons - base.source_electrons
        behind = light if others else 1.0
        sky, neighbours = behind * base.sky_electrons, behind * base.neighbour_electrons
        star = light * base.source_electrons
        quiet = replace(base, source_electrons=star, sky_electrons=sky, neighbour_electrons=neighbours)
        setting = self.case.setting(quiet)
        if not setting.used.any():
            return []
        flares = (replace(quiet, source_electrons=light * (base.source_electrons + more * rise)) for more in rises)
        return [statistic.detection_forms(setting, flare, q.fap) for flare in flares]

    @property
    def slow(self) -> bool:
        """Whether closed forms are slow: sums of squares integrated over random factors."""
        return isinstance(self.odds.null, Mixture) and not isinstance(self.odds.null.parts[0], Gaussian)


def short(value: float) -> str:
    """Format a number with three significant digits and no power of ten."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


class Chance(NamedTuple):
    """Chance of detection under one assumption of what is unknown."""

    unknown: str  # choice of the field
    value: float  # NaN if there is none
    origin: str  # whether it is a closed form or simulated, and its interval; or the reason why there is none


def chances(closed: ClosedForms, answers: Answers) -> list[Chance]:
    """Return the chance for each choice of what is unknown, simulated if it is among the answers."""
    all_chances = []
    for unknown in UNKNOWN:
        try:
            assumed = closed.assuming(unknown)
            chance = _chance(assumed, answers.get("detection" if assumed is closed else OTHER))
        except InputError as error:
            if unknown == closed.question.unknown:
                raise
            chance = Chance(unknown, float("nan"), sentence(error))
        all_chances.append(chance)
    return all_chances


def _chance(assumed: ClosedForms, answer: DetectAnswer | None) -> Chance:
    """Return the chance under one assumption, in closed form unless there is a simulated answer."""
    q = assumed.question
    if answer is not None:
        (row,) = (row for row in answer.table if row["statistic"] == q.statistic)
        interval = chance_range(row["low"], row["high"])
        return Chance(q.unknown, float(row["probability"]), f"{interval}, of {q.realisations[0]:,} simulated")
    chance = Chance(q.unknown, assumed.chance, "in closed form")
    if q.unknown == REALISTIC or assumed.slow or math.isnan(chance.value):
        return chance
    # Other throughputs take no time.
    lights = (1 - THROUGHPUT, 1 + THROUGHPUT)
    ends = [odds.probability for light in lights for odds in assumed.at(light, np.ones(1), others=True)]
    interval = f"{chance_range(min(ends), max(ends))} if the throughput is {100 * THROUGHPUT:g} % lower or higher"
    return chance._replace(origin=f"{chance.origin}; {interval}")


def solved(closed: ClosedForms) -> str:
    """Return a sentence on the limit of the quantity that the question solves for, with and without unknowns."""
    q, limit = closed.question, closed.study.limit
    before, in_words, without_limit, by_simulation = LIMITS[limit.of]
    clauses: dict[str, str] = {}
    near: float | None = None
    # The ideal limit is found quickly, and the realistic one near it.
    for unknown in (IDEAL, REALISTIC):
        try:
            assumed = closed.assuming(unknown)
            near = None if assumed.slow else LimitSearch(assumed.case, assumed.question.statistic).root(near)
            value = "" if near is None else f"{before.format(band=q.band)} {in_words(near)}"
            clauses[unknown] = value or f"{by_simulation} that takes a simulation"
        except InputError:
            clauses[unknown] = without_limit
    flares = "flares" if limit.of == "amplitude" else f"flares of {q.amplitude_percent:g} %"
    at = "" if limit.of == "magnitude" else f" at {q.band} = {q.magnitude:g}"
    realistic = clauses[REALISTIC]
    # An amplitude belongs to the flares, a magnitude or an exposure to their detection.
    detected = f" {realistic}{at} are detected" if limit.of == "amplitude" else f"{at} are detected {realistic}"
    ideal = f"{clauses[IDEAL]} if everything but the noise were known"
    return f"{100 * limit.power:g} % of {flares}{detected}, and {ideal}."


def other_payloads(closed: ClosedForms) -> str:
    """Return a sentence on the chances with other payloads than the question's."""
    clauses = []
    for name in FIELDS["instrument"].choices:
        if name != closed.question.instrument:
            shown = dict.fromkeys(UNKNOWN, "no number")
            for unknown in UNKNOWN:
                with contextlib.suppress(InputError):
                    shown[unknown] = chance_text(closed.assuming(unknown, instrument=name).chance)
            clauses.append(f"Chances with {name}: {' and '.join(shown.values())}.")
    return " ".join(clauses)
