"""Closed forms of detections with unknowns of the instrument, and what each unknown costs.

The instrument will be calibrated before observers choose reference and threshold, but is unknown when a proposal is
written. Each draw of the unknown values therefore has its own reference and threshold, and detection probabilities are
averaged over draws.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import special

from mauvecl.answers.answer import Answer, TableOf
from mauvecl.detection import MIN_IN_TAIL
from mauvecl.detection.distributions import CONFIDENCE_SD
from mauvecl.detection.nuisances import join_names
from mauvecl.detection.statistics import Matched, Setting, Statistic
from mauvecl.host.arrays import Float
from mauvecl.noise.unknowns import DOCUMENTED_NUISANCES, NUISANCES, PROCESSES, Comparison, unknown_values_of
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import Column, chance_text, first_items, number, percent
from mauvecl.schema.errors import InputError, Message
from mauvecl.study.cases import Case, amplitude_column, cases, collect_messages, star_column
from mauvecl.study.observation import KNOWN, NuisanceChoice
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation


@dataclass(frozen=True)
class Cost:
    """S/N of a flare by the matched statistic, with and without unknowns."""

    of: str  # star and flare
    known: float  # with everything known
    plain: float  # with unknowns that scatter the statistic, which ignores them
    marginal: float  # with a statistic that is marginalised over them


def unknown_cost(
    of: str, quiet: Expectation, flare: Expectation, nuisances: NuisanceChoice, comparison: Comparison
) -> Cost:
    """Return the S/N of a flare, named by `of`, with and without unknowns, or the documented ones if none are given."""
    chosen, used, matched = NuisanceChoice() if nuisances.none else nuisances, ~quiet.saturated, Matched()
    unknown = chosen.marginalised(quiet)
    delta = np.where(used, flare.recorded_light_dn - quiet.recorded_light_dn, 0.0)
    if unknown is None or not delta.any():
        return Cost(of, 0.0, 0.0, 0.0)
    weights = matched.plain_weights(Setting(quiet, used, comparison), flare)
    known_snr = float(weights @ delta)
    # Amplitudes have the standard deviations that are drawn by default, or else those of the prior.
    drawn = {row.name: row.scatter for row in DOCUMENTED_NUISANCES if chosen.usual}
    priors = zip(unknown.names, unknown.sd, strict=True)
    sd = np.array([drawn.get(name, sd) if np.isinf(sd) else sd for name, sd in priors])
    scatter = sd * (unknown.spectra @ weights)
    try:
        marginal = matched.weights_per_dn(Setting(quiet, used, comparison, nuisances=unknown), flare)
    except InputError:
        # The spectrum of the flare is that of an unknown.
        marginal = np.zeros_like(weights)
    return Cost(of, known_snr, float(known_snr / np.sqrt(1.0 + np.sum(scatter**2))), float(marginal @ delta))


def unknown_lines(costs: Sequence[Cost], nuisances: NuisanceChoice) -> list[str]:
    """Return sentences on what is marginalised over, if anything, and on the faintest flare, if any has a signal."""
    lines, unknowns = list[str](), f"the usual unknowns ({spoken(NuisanceChoice())})"
    if not nuisances.none:
        unknowns = spoken(nuisances)
        texts = "; ".join(PROCESSES[row.process].drawn for row in DOCUMENTED_NUISANCES)
        lines.append(f"Statistics are marginalised over {unknowns}{f'; drawn: {texts}' if nuisances.usual else ''}.")
    shown = [cost for cost in costs if cost.known > 0]
    if shown:
        faintest = min(shown, key=lambda cost: cost.known)
        faintest_of = f", the faintest of {len(shown)}," if len(shown) > 1 else ""
        lines.append(Message(
            f"What unknowns cost: {faintest.of}{faintest_of} has a matched S/N of {faintest.known:.3g} with everything "
            f"known; with {unknowns} it is {faintest.plain:.2g} by the plain statistic and {faintest.marginal:.3g} "
            "marginalised (closed forms).", "cost of unknowns",
        ))  # fmt: skip
    return lines


def spoken(choice: NuisanceChoice) -> str:
    """Return the unknowns as text, such as "the dark level (+-0.5 deg C) and the light level (free)"."""
    documented = DOCUMENTED_NUISANCES if choice.usual else ()
    sd: dict[str, float | str] = {row.name: row.sd for row in documented if row.sd is not None}
    sd |= choice.spreads()
    sizes = [f"{NUISANCES[name].label} ({_size(value, NUISANCES[name].unit)})" for name, value in sd.items()]
    return join_names(sizes + [f"{name!r} ({_size(spectrum.sd, '')})" for name, spectrum in choice.own.items()])


def _size(sd: float | str, unit: str) -> str:
    """Format the standard deviation of an unknown."""
    if sd in ("free", float("inf")):
        return "free"
    return f"+-{100 * float(sd) if unit == '%' else float(sd):g} {unit}".rstrip()


#: Unknowns of `unknown_table` by their text.
TABULATED: dict[str, NuisanceChoice] = {
    spoken(choice): choice
    for choice in (
        NuisanceChoice(usual=False, dark=0.1),
        NuisanceChoice(usual=False, light=0.01),
        NuisanceChoice(usual=False, dark="free", light="free"),
        NuisanceChoice(usual=False, sky=0.1),
        NuisanceChoice(usual=False, tilt=0.01),
    )
}

UNKNOWN_COLUMNS = (
    star_column(),
    amplitude_column(),
    Column("unknown", description="what is unknown", heading="unknown"),
    Column("known", "", "", "S/N of the matched statistic with everything known", "S/N, all known", ".3g"),
    Column("plain", description="the same where it is unknown and the statistic does not know of it",
           heading="S/N, not looked for", format=".3g"),
    Column("marginalised", "marginal", "", "the same, marginalised", "S/N, marginalised", ".3g"),
    Column("detected", description="detection probability of the marginalised statistic at the header's false alarms",
           heading="then detected", format=percent(".3g")),
    Column("smallest", description="flare amplitude that is detected, marginalised, at the header's power and false "
           "alarms", heading="smallest flare", format=percent(".3g")),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class UnknownAnswer(Answer):
    """Answer of `unknown_table`: S/N of each flare under each unknown."""

    USES = ("instrument", "sky", "flare", "nuisances", "seed")

    study: Study
    rows: list[dict[str, Any]]  # S/N of each flare under each unknown, by the names of columns
    messages: list[str]
    inputs: list[Expectation]  # the stars without a flare

    #: One row per star, flare and unknown.
    table = TableOf(
        "unknowns", UNKNOWN_COLUMNS, "rows",
        title="What unknowns cost: S/N of the matched statistic, by closed forms",
        meta=("study.run.fap", "study.limit.power", "study"),
    )  # fmt: skip


@validated
def unknown_table(study: Study) -> UnknownAnswer:
    """Compute the S/N of a study's flares under each of the unknowns of `TABULATED`.

    S/N grows with the amplitude; the photon noise of the smallest flare is left out.
    """
    prepared, run, rows = cases(study, swept=False), study.run, list[dict[str, Any]]()
    needed = special.ndtri(study.limit.power) - special.ndtri(run.fap)
    for case in prepared:
        flares = zip(case.amplitudes, case.flares, strict=True)
        for (amplitude, flare), (unknown, choice) in itertools.product(flares, TABULATED.items()):
            cost = unknown_cost(case.label, case.quiet, flare, choice, run.comparison())
            rows.append(vars(cost) | {
                "star": case.label, "amplitude": amplitude, "unknown": unknown,
                "detected": float(power(cost.marginal, run.fap)),
                "smallest": float(amplitude * needed / cost.marginal) if cost.marginal > 0 else float("inf"),
            })  # fmt: skip
    quiet = [case.quiet for case in prepared]
    return UnknownAnswer(study, rows, collect_messages(quiet), quiet)


def power(snr: float | Float, fap: float) -> Float:
    """Return the detection probability of a normal statistic with some S/N, shape of the S/N."""
    return np.asarray(special.ndtr(snr + special.ndtri(fap)))


#: Column of the answer with everything but the noise known, the bound of the realistic answer next to it.
IDEAL = Column("ideal", "", "", "detection probability if everything but the noise were known, for Gaussian noise",
               "ideal", number(".4f"), when=lambda answer: not answer.study.nuisances.none)  # fmt: skip


def ideal_chances(case: Case, flares: Sequence[Expectation], statistics: Sequence[Statistic]) -> Float | None:
    """Return the closed-form chances of flares if everything but the noise is known, or None if it is.

    Their shape is (n_flare, n_statistic), and they are NaN where the star or the flare saturates every pixel.
    """
    if case.study.nuisances.none:
        return None
    setting, fap = case.with_sections(nuisances=KNOWN).setting(case.quiet, *flares), case.study.run.fap
    return np.array([[_chance(setting, statistic, flare, fap) for statistic in statistics] for flare in flares])


#: Kind of the message of `chance_with_unknowns`.
BOTH_CHANCES = "chance with unknowns"
#: Largest number of flares among which the least certain one is sought.
MAX_FLARES = 100


def chance_with_unknowns(prepared: Sequence[Case]) -> list[str]:
    """Return a sentence on the chance with and without the usual unknowns, or none if the study has unknowns."""
    study = prepared[0].study
    if not study.nuisances.none or study.run.comparison().estimated:
        return []
    flares = [(case, flare) for case in prepared for flare in range(len(case.amplitudes))][:MAX_FLARES]
    chances = {item: chance for item in flares if not math.isnan(chance := _matched_chance(*item))}
    if not chances:
        return []
    # Flares whose chance is far from one half are detected, or missed, either way.
    case, flare = min(chances, key=lambda item: abs(chances[item] - 0.5))
    of = f"{case.label}, flare of {100 * case.amplitudes[flare]:g} %"
    try:
        unknown = _matched_chance(case.with_sections(nuisances=NuisanceChoice()), flare)
    except InputError as error:
        # Too few pixels are left.
        return [Message(f"The usual unknowns cannot be taken into account for {of}: {error}.", BOTH_CHANCES)]
    return [] if math.isnan(unknown) else [Message(
        f"Everything but the noise is taken as known: {of} is then detected by the matched statistic with a chance of "
        f"{chance_text(chances[case, flare])}, with the usual unknowns of {chance_text(unknown)} (closed forms; "
        f"`nuisances.usual` draws them). These are {spoken(NuisanceChoice())}.", BOTH_CHANCES,
    )]  # fmt: skip


def _matched_chance(case: Case, flare: int) -> float:
    """Return the closed-form chance of a flare of a case by the matched statistic."""
    peak = case.flares[flare]
    return _chance(case.setting(case.quiet, peak), Matched(), peak, case.study.run.fap)


def _chance(setting: Setting, statistic: Statistic, flare: Expectation, fap: float) -> float:
    """Return the closed-form chance of a flare; NaN if every pixel saturates."""
    if not setting.used.any() or flare.saturated[setting.used].all():
        return float("nan")
    return statistic.detection_forms(setting, flare, fap).probability


#: Name of the variance that no unknown explains linearly.
REST = "the rest"


@dataclass(frozen=True, eq=False)
class DrawnStudies:
    """Draws of unknown instrument values, with the study of each."""

    names: tuple[str, ...]
    labels: tuple[str, ...]
    values: Float  # shape (n_draw, n_name)
    studies: tuple[Study, ...]  # the study with each draw's instrument, without unknowns, and its share of realisations


def draw_studies(study: Study) -> DrawnStudies:
    """Draw instrument values from a study's priors, as a Latin hypercube with the study's seed.

    Raises InputError if a prior includes values that the instrument cannot have, or nothing is unknown.
    """
    from scipy.stats import qmc

    question, o = study.unknowns, study.observation
    nominal = o.load_instrument()
    # Values that the study sets are known.
    known_names = {*o.changes, *(() if o.temperature_c is None else ("temperature_c",))}
    rows, priors = unknown_values_of(nominal), question.priors(nominal)
    priors = {name: prior for name, prior in priors.items() if name not in known_names}
    if question.draws and not priors:
        raise InputError("no instrument value is unknown; give a prior, or unknowns.draws = 0", key="unknowns.draws")
    even = qmc.LatinHypercube(len(priors), rng=np.random.default_rng(study.run.seed)).random(question.draws)
    values = np.column_stack([prior.quantile(even[:, k]) for k, prior in enumerate(priors.values())])
    # An equal share of the realisations, but enough to count the threshold of each draw.
    fewest = int(np.ceil(MIN_IN_TAIL / study.run.fap)) if study.run.tails == "counted" else 1000
    run = study.run.model_copy(update={"realisations": max(study.run.realisations // question.draws, fewest)})
    certain = study.model_copy(update={"unknowns": type(question)(), "run": run})
    studies = []
    for row in values:
        changes, at = dict[str, Any](), nominal
        for name, value in zip(priors, row, strict=True):
            change = rows[name].changes(at, float(value))
            changes |= change
            # The next mode is added to those before it.
            at = at if rows[name].mode is None else at.model_copy(update=change)
        try:
            nominal.with_(**changes)
        except InputError as error:
            raise error.within("the priors of unknown values include impossible ones") from error
        studies.append(certain.with_instrument(changes))
    return DrawnStudies(tuple(priors), tuple(rows[name].label for name in priors), values, tuple(studies))


def throughput_cases(case: Case) -> list[Case]:
    """Return the case with each mode of its calibration at one standard deviation; empty if it has none.

    The sign of a mode is arbitrary; it is chosen so that the same pixels lie in the output range. Raises InputError if
    the wavelengths are not known well enough for that.
    """
    moved, pixels = [], case.instrument.read_pixels
    for mode in (row for row in unknown_values_of(case.instrument).values() if row.mode is not None):
        signs = (replace(case, study=case.study.with_instrument(mode.changes(case.instrument, x))) for x in (1, -1))
        same = next((sign for sign in signs if sign.instrument.read_pixels == pixels), None)
        if same is None:
            why = "an error of the calibrated wavelengths changes the pixels of the output range"
            raise InputError(f"{why}, which must end further from a pixel", key="observation.instrument")
        moved.append(same)
    return moved


def average(values: Float, low: Float, high: Float) -> tuple[Float, Float, Float]:
    """Return the mean of probabilities over draws, with a 95 % interval for their own errors and the number of draws.

    The arguments have the shape (n_draw, ...). The interval assumes independent draws and is therefore conservative for
    a Latin hypercube.
    """
    n, mean = len(values), values.mean(axis=0)
    spread = values.std(axis=0, ddof=1) / np.sqrt(n) if n > 1 else 0.0
    half = np.hypot(CONFIDENCE_SD * spread, np.sqrt(np.sum(((high - low) / 2) ** 2, axis=0)) / n)
    return mean, np.maximum(mean - half, 0.0), np.minimum(mean + half, 1.0)


def shares(draws: DrawnStudies, outcome: Float) -> dict[str, float]:
    """Return the share of an outcome's variance that each unknown explains, largest first, and the unexplained rest.

    A share is the mean increase of the explained variance when the unknown is added to a linear fit, over all orders of
    adding them (Lindeman, Merenda & Gold 1980; Groemping 2007, doi 10.1198/000313007X188252). Shares from single slopes
    would count variance twice, since a few draws are correlated by chance. The outcome has the shape (n_draw,).
    """
    names, finite = draws.names, np.isfinite(outcome)
    x, y = draws.values[finite], outcome[finite]
    if len(y) <= x.shape[1] + 1 or y.std() == 0.0:
        return dict.fromkeys((*names, REST), float("nan"))
    # A prior of zero width explains nothing.
    varied = np.ptp(x, axis=0) > 0
    scaled = np.where(varied, x - x.mean(axis=0), 0.0) / np.where(varied, x.std(axis=0), 1.0)

    def explained_by(some: tuple[int, ...]) -> float:
        straight = np.column_stack([scaled[:, some], np.ones(len(y))])
        residual = y - straight @ np.linalg.lstsq(straight, y, rcond=None)[0]
        return float(1.0 - residual.var() / y.var())

    indices = range(len(names))
    subsets = itertools.chain.from_iterable(itertools.combinations(indices, size) for size in (*indices, len(names)))
    explained = {some: explained_by(some) if some else 0.0 for some in subsets}
    share = np.zeros(len(names))
    for some, value in explained.items():
        for k in {*indices}.difference(some):
            # Fraction of orders in which exactly these precede unknown k.
            weight = 1.0 / (len(names) * math.comb(len(names) - 1, len(some)))
            share[k] += weight * (explained[tuple(sorted((*some, k)))] - value)
    return {names[k]: max(float(share[k]), 0.0) for k in np.argsort(-share)} | {REST: 1.0 - explained[tuple(indices)]}


#: Largest number of unknowns whose shares of a scatter are named.
MAX_NAMED = 3


def describe_shares(shares: Mapping[str, float]) -> str:
    """Return the largest shares of a scatter in words, and how many there are."""
    if any(math.isnan(share) for share in shares.values()):
        return "sources that only more draws tell apart"
    first, note = first_items(shares.items(), MAX_NAMED, "unknowns")
    return ", ".join(f"{name} {100 * share:.0f} %" for name, share in first) + (f" ({note})" if note else "")
