"""Studies answered: the host's expectations and the engine's draws put together into tables."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from mauvecl.campaign import campaign
from mauvecl.components import components
from mauvecl.detection import Detection, check_fap, countable
from mauvecl.paper import PAPER_G2V, WHY, reconstruct
from mauvecl.statistics import SHAPED, Linear, matched_weights
from mauvecl.study import PAPER_STARS, Star, Study

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.departures import Departure
    from mauvecl.engine import Engine
    from mauvecl.host.expectation import Expectation
    from mauvecl.snr import SnrResult


@dataclass(frozen=True, eq=False)
class StarDetection:
    """One star of a detection study."""

    label: str
    found: Detection
    amplitudes: tuple[float, ...] = ()

    def curves(self) -> dict[str, QTable]:
        """For files: every ROC, and the exact tails of every null and flare, with their realisations."""
        from astropy.table import vstack

        rocs, tails = [], []
        for statistic in self.found.statistics:
            for flare, amplitude in enumerate(self.amplitudes):
                curve = self.found.roc(statistic, flare).table()
                area = {name: curve.meta.pop(name) for name in ("area", "area_low", "area_high")}
                for name, value in area.items():
                    curve[name] = value
                rocs.append(_named(curve, statistic, amplitude))
                tails.append(_named(self.found.tail_samples(statistic, flare), statistic, amplitude))
                if statistic in SHAPED or flare == 0:
                    null = self.found.tail_samples(statistic, template=flare)
                    tails.append(_named(null, statistic, 0.0))
        found = {"roc": vstack(rocs), "tails": vstack(tails)}
        found["roc"]["area"].info.description = "under the curve; 95 % interval by DeLong's method"
        found["tails"].meta["seed"] = self.found.seed
        return found


@dataclass(eq=False)
class DetectAnswer:
    """What `mauvecl detect` answers.

    Attributes
    ----------
    study : Study
    stars : list of StarDetection
    table : QTable
        One row per star, flare and statistic.
    departures : QTable
        One row per star and statistic, and flare where its shape matters: where the simulated null differs from the
        closed form, and why.
    messages : list of str
        What the reader must be told, worst first.
    paper : list of str
        The comparison with the paper's values, where the study holds its G2V star.
    """

    study: Study
    stars: list[StarDetection]
    table: QTable
    departures: QTable
    messages: list[str]
    paper: list[str] = field(default_factory=list)


def _named(table: QTable, statistic: str, amplitude: float) -> QTable:
    table.add_column([statistic] * len(table), name="statistic", index=0)
    table.add_column([amplitude] * len(table), name="amplitude", index=1)
    return table


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

    from mauvecl.departures import departures

    # Everything is looked at before anything is drawn: bad input shows at once.
    check_fap(study.run.fap, study.run.realisations, study.run.tails)
    prepared = [study.expectations(star) for star in study.star]
    campaign_told = _campaign(study, prepared[0][0])
    stars, tables, differing = [], [], []
    for star, (quiet, *flares) in zip(study.star, prepared, strict=True):
        how = study.detecting
        how["statistics"] = (*study.run.statistics, *_other_templates(study, star, quiet))
        found = engine.detect(quiet, flares, seed=study.run.seed, **how)
        table = found.table(study.run.fap)
        table.replace_column("name", [label(star, quiet)] * len(table))
        table.rename_column("name", "star")
        amplitudes = study.flare.amplitudes
        table.add_column([amplitudes[i // len(found.statistics)] for i in range(len(table))], name="amplitude", index=1)
        table["amplitude"].info.description = f"relative rise of the photons in the band {study.flare.band}"
        stars.append(StarDetection(label(star, quiet), found, amplitudes))
        tables.append(table)
        if countable(study.run.fap, study.run.realisations):
            differing += [(label(star, quiet), amplitudes, d) for d in departures(found, study.run.fap)]
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
    messages += [text for star in stars for text in _template_costs(study, star)]
    return DetectAnswer(study, stars, together, _departures(differing), messages, _paper(study, prepared))


def _other_templates(study: Study, star: Star, quiet: Expectation) -> list[Linear]:
    """Matched statistics that look for flares of other temperatures than the study's."""
    found = []
    for temperature in study.run.template_temperatures_k:
        source = star.source()
        other = study.at("flare_temperature", temperature)
        (shape,) = other.expect([other.flaring(source, study.flare.amplitudes[0])])
        weights = matched_weights(quiet, shape, ~quiet.saturated, study.run.comparison())
        found.append(Linear(f"matched {temperature:g} K", weights))
    return found


def _template_costs(study: Study, star: StarDetection) -> list[str]:
    """What looking for the wrong temperature costs, for Gaussian noise."""
    found, lines = star.found, []
    for temperature in study.run.template_temperatures_k:
        right = float(np.sqrt(_strength(found, 0)))
        kept = found.closed_form(f"matched {temperature:g} K", 0).mean / right if right else 0.0
        lines.append(
            f"{star.label}: looking for a flare of {temperature:g} K in one of {study.flare.temperature_k:g} K keeps "
            f"{100 * kept:.1f} % of the matched statistic's S/N."
        )
    return lines


def _strength(found: Detection, flare: int) -> float:
    """The largest S/N that any linear statistic can have, squared."""
    delta = np.where(found.scene.used, found.flares[flare].signal_dn - found.quiet.signal_dn, 0.0)
    return float(np.sum(delta**2 / found.quiet.variance_dn2)) / (1.0 + found.scene.comparison.share)


def _departures(rows: list[tuple[str, tuple[float, ...], Departure]]) -> QTable:
    """The departures of all stars as a table."""
    from astropy.table import QTable

    table = QTable()
    table["star"] = np.array([star for star, _, _ in rows], str)
    table["statistic"] = np.array([d.statistic for _, _, d in rows], str)
    table["amplitude"] = [a[d.template] if d.statistic in SHAPED else np.nan for _, a, d in rows]
    for name, values, text in (
        ("gaussian_threshold", [d.threshold for _, _, d in rows], "threshold for Gaussian noise"),
        ("fap", [d.simulated.value for _, _, d in rows], "simulated false-alarm probability there"),
        ("fap_low", [d.simulated.low for _, _, d in rows], "its 95 % interval, lower end"),
        ("fap_high", [d.simulated.high for _, _, d in rows], "its 95 % interval, upper end"),
        ("ratio", [d.ratio for _, _, d in rows], "simulated over wanted false-alarm probability"),
        ("ratio_error", [d.error for _, _, d in rows], "standard error of the ratio"),
        ("skew", [d.skew for _, _, d in rows], "predicted change of the ratio by the noise's skew and kurtosis"),
        ("rounding", [d.rounding for _, _, d in rows], "predicted change of the ratio by the ADC's steps"),
        ("clipping", [d.clipping for _, _, d in rows], "predicted change of the ratio by the ADC's ends"),
        ("differs", [d.differs for _, _, d in rows], "whether chance does not explain the ratio (4 standard errors)"),
    ):
        table[name] = values
        table[name].info.description = text
    table["why"] = np.array([d.why for _, _, d in rows], str)
    return table


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
