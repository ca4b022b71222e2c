"""Studies answered: the host's expectations and the engine's draws put together into tables."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from mauvecl.campaign import campaign
from mauvecl.components import components
from mauvecl.detection import Detection, check_fap
from mauvecl.paper import PAPER_G2V, WHY, reconstruct
from mauvecl.study import PAPER_STARS, Star, Study

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.engine import Engine
    from mauvecl.host.expectation import Expectation
    from mauvecl.snr import SnrResult


@dataclass(frozen=True, eq=False)
class StarDetection:
    """One star of a detection study."""

    label: str
    found: Detection


@dataclass(eq=False)
class DetectAnswer:
    """What `mauvecl detect` answers.

    Attributes
    ----------
    study : Study
    stars : list of StarDetection
    table : QTable
        One row per star, flare and statistic.
    messages : list of str
        What the reader must be told, worst first.
    paper : list of str
        The comparison with the paper's values, where the study holds its G2V star.
    """

    study: Study
    stars: list[StarDetection]
    table: QTable
    messages: list[str]
    paper: list[str] = field(default_factory=list)


def label(star: Star, x: Expectation) -> str:
    """A star's name with its magnitude, for tables and pictures."""
    name = star.library or x.name
    return name if star.magnitude is None else f"{name} {star.band} = {star.magnitude:g}"


def told(expectations: list[Expectation]) -> list[str]:
    """Their messages, each once, saturation first."""
    messages = list(dict.fromkeys(message for x in expectations for message in x.messages))
    return sorted(messages, key=lambda m: not m.startswith("SATURATED"))


def detect(study: Study, engine: Engine) -> DetectAnswer:
    """Null and flare distributions of every star of a study.

    Raises
    ------
    InputError
        For anything in the study that cannot be.
    """
    from astropy.table import vstack

    # Everything is looked at before anything is drawn: bad input shows at once.
    check_fap(study.run.fap, study.run.realisations, study.run.tails)
    prepared = [study.expectations(star) for star in study.star]
    campaign_told = _campaign(study, prepared[0][0])
    stars, tables = [], []
    for star, (quiet, *flares) in zip(study.star, prepared, strict=True):
        found = engine.detect(quiet, flares, seed=study.run.seed, **study.detecting)
        table = found.table(study.run.fap)
        table.replace_column("name", [label(star, quiet)] * len(table))
        table.rename_column("name", "star")
        amplitudes = study.flare.amplitudes
        table.add_column(
            [amplitudes[i // len(study.run.statistics)] for i in range(len(table))], name="amplitude", index=1
        )
        table["amplitude"].info.description = f"relative rise of the photons in the band {study.flare.band}"
        stars.append(StarDetection(label(star, quiet), found))
        tables.append(table)
    together = vstack(tables, metadata_conflicts="silent")
    together.meta["study"] = study.toml()
    messages = told([x for group in prepared for x in group])
    if together.meta["tails"] != "counted":
        worst = max(table["fap_error"].max() for table in tables)
        messages.append(
            f"Thresholds at a false-alarm probability of {study.run.fap:g} come from importance sampling, right to "
            f"{100 * worst:.1f} % of it: {study.run.realisations} realisations leave fewer than 100 beyond them."
        )
    messages += campaign_told
    return DetectAnswer(study, stars, together, messages, _paper(study, prepared))


def _campaign(study: Study, quiet: Expectation) -> list[str]:
    """What one test's false-alarm probability means for the campaign that the study names."""
    asked = study.campaign
    if asked.frames is None:
        return []
    found = campaign(study.run.fap, asked.frames, quiet.n_frames, step=asked.step, seed=study.run.seed)
    text = (
        f"A campaign of {asked.frames} frames makes {found.tests} tests: at {found.fap:g} per test the chance of any "
        f"false alarm is {found.independent:.3g} if they are independent, and at most {found.at_most:.3g}"
    )
    if found.overlapping is not None:
        o = found.overlapping
        text += f"; with the overlap of its stacks {o.value:.3g} [{o.low:.3g}, {o.high:.3g}] for a linear statistic"
    return [text + "."]


def _paper(study: Study, prepared: list[list[Expectation]]) -> list[str]:
    """The paper's G2V values beside their reconstruction and the calibrated ones."""
    if PAPER_STARS[1] not in study.star or study.observation.exposure_s != 50.0:
        return []
    quiet, *flares = prepared[study.star.index(PAPER_STARS[1])]
    lines = []
    for amplitude, flare in zip(study.flare.amplitudes, flares, strict=True):
        if amplitude not in PAPER_G2V:
            continue
        chi2, reduced = PAPER_G2V[amplitude]
        ours = reconstruct(quiet, flare)
        lines.append(
            f"G2V, {100 * amplitude:g} % flare: the paper has chi2 = {chi2:g}, reduced {reduced:g}; "
            f"reconstructed here {ours.value:.2f} ({ours.low:.2f}-{ours.high:.2f})"
        )
    return [*lines, WHY] if lines else []


@dataclass(eq=False)
class SnrAnswer:
    """What `mauvecl snr` answers: one result per star."""

    study: Study
    stars: list[tuple[str, SnrResult]]
    messages: list[str]


def snr(study: Study, engine: Engine) -> SnrAnswer:
    """S/N distributions of every star of a study, without flares."""
    prepared = [study.expect([star.source()])[0] for star in study.star]
    run = study.run
    stars = [
        (
            label(star, x),
            engine.snr(x, realisations=run.realisations, seed=run.seed, **study.drawing),
        )
        for star, x in zip(study.star, prepared, strict=True)
    ]
    return SnrAnswer(study, stars, told(prepared))


@dataclass(eq=False)
class SimulateAnswer:
    """What `mauvecl simulate` answers: one table of components per star and stage."""

    study: Study
    observations: list[tuple[str, Expectation, QTable]]
    messages: list[str]


def simulate(study: Study, *, realisation: int = 0, flaring: bool = False) -> SimulateAnswer:
    """One observation of every star of a study, taken apart; with its flares too where asked."""
    observations, everything = [], []
    for star in study.star:
        xs = study.expectations(star) if flaring else study.expect([star.source()])
        for i, x in enumerate(xs):
            title = label(star, x) + (f", flare {100 * study.flare.amplitudes[i - 1]:g} %" if i else "")
            table = components(x, realisation=realisation, seed=study.run.seed, **study.drawing)
            table.meta["study"] = study.toml()
            observations.append((title, x, table))
        everything += xs
    return SimulateAnswer(study, observations, told(everything))
