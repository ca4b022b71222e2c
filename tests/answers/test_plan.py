"""Plans: each number of the report is in a table and follows from the others; missing values are reported."""

import re
from pathlib import Path

import numpy as np
import pytest
from answers import of_kind
from astropy.table import QTable, Table
from refusals import refused
from scipy import stats

from mauvecl import EnergyScale, Study, plan
from mauvecl.answers.campaigns.plan import PlanAnswer
from mauvecl.answers.campaigns.plan_lines import target_lines
from mauvecl.answers.campaigns.planned import TargetObservation
from mauvecl.answers.campaigns.planned_injections import injection_case
from mauvecl.answers.files import write_study, write_table
from mauvecl.host.stars.spectral_types import nearest_spectrum, subtype
from mauvecl.lightcurve.flares.energies import quiescent_luminosity
from mauvecl.lightcurve.flares.rates import davenport2019
from mauvecl.lightcurve.search.completeness import Completeness
from mauvecl.lightcurve.stares.orbit_stare import stare_along
from mauvecl.schema.tables import records
from mauvecl.study.cases import Case
from mauvecl.study.orbits import read_targets

#: Injections take ten seconds a target.
QUICK = {"completeness": "closed form"}
TARGETS = """name,ra,dec,V,spectral_type,distance_pc,mass_msun,age_myr
eps Eri,,,,,,0.82,500
my star,10.5,-3.0,8.0,K5V,10,0.7,300
Denebola,,,,,,,
EK Dra,,,,,,1.0,100
"""
TARGET_NAMES = ("eps Eri", "my star", "Denebola", "EK Dra")


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    path = tmp_path_factory.mktemp("plan") / "targets.csv"
    path.write_text(TARGETS)
    return Study().with_changes(
        {"plan": QUICK | {"targets": read_targets(path), "hours": 120.0}, "orbit": {"days": 60.0}}, None
    )


@pytest.fixture(scope="module")
def answer(study: Study) -> PlanAnswer:
    return plan(study)


def test_plan_numbers_are_consistent(answer: PlanAnswer) -> None:
    """Compute flares, their interval and false alarms from the tables of hours, rates and shares alone."""
    table, stars, energies = answer.table, answer.stars, answer.by_energy
    for k, name in enumerate(table["target"][:2]):
        mine = energies[energies["target"] == name]
        energy, share, above = (mine[one].value for one in ("energy", "recovered", "rate_above"))
        middle = np.interp(np.log10(np.sqrt(energy[1:] * energy[:-1])), np.log10(energy), share)
        per_day = np.sum((above[:-1] - above[1:]) * middle) + above[-1] * share[-1]
        assert stars["recovered_per_day"][k] == pytest.approx(per_day, rel=0.01)
        assert table["expected"][k] == pytest.approx(per_day * table["hours"][k].value / 24, rel=0.01)
        assert np.interp(np.log10(table["E50"][k].value), np.log10(energy), share) == pytest.approx(0.5, abs=1e-6)
        assert np.interp(np.log10(table["E90"][k].value), np.log10(energy), share) == pytest.approx(0.9, abs=1e-6)
        assert table["low"][k] < table["expected"][k] < table["high"][k]
    assert table["false_alarms"].tolist() == pytest.approx((table["hours"].value / 24 / (365.25 / 12)).tolist())
    assert (table["hours"] <= table["seen"]).all()
    assert answer.seen.table["hours"].value == pytest.approx(table["seen"].value)


def test_closed_form_reports_that_it_ignores_unknowns(study: Study, answer: PlanAnswer) -> None:
    assert not of_kind(answer.messages, "false alarms")
    drifting = plan(study.with_changes({"stare": {"drifts": {"temperature": 0.3}}}, None))
    assert of_kind(drifting.messages, "false alarms")


def test_plan_uses_the_requested_rates(answer: PlanAnswer) -> None:
    star = next(one.observation.star for one in answer.planned if one.name == "eps Eri")
    source, distance = star.source(), star.distance_pc
    assert distance is not None
    scale = EnergyScale.of_star(source, distance, flare_k=10_000.0)
    law = davenport2019(mass_msun=0.82, age_myr=500).of_light(scale.erg_per_s, quiescent_luminosity(source, distance))
    energies = answer.by_energy
    mine = energies[energies["target"] == "eps Eri"]
    assert mine["rate_above"].value == pytest.approx(law.per_day_above(mine["energy"].value))


#: Numbers in a text, but not those in names such as K5V or HD 209458.
NUMBER = re.compile(r"(?<![\w.^])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w])")


def printed(token: str, values: list[float]) -> bool:
    """Return whether one of the values equals a printed number to half of its last digit."""
    mantissa, _, exponent = token.partition("e")
    unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    return bool(np.any(np.abs(np.array(values) - float(token)) <= 0.5001 * unit))


def held(table: Table, column: str, target: str) -> list[float]:
    """Return all numbers in a table's column, for one target if the table lists targets."""
    if "target" in table.colnames:
        table = table[table["target"] == target]
    values: list[float] = []
    for name in [column] if column else [one for one in table.colnames if one != "target"]:
        cells = np.ma.filled(np.ma.asarray(getattr(table[name], "value", table[name])))
        texts = cells.dtype.kind in "OUS"
        values += [float(n) for text in cells for n in NUMBER.findall(str(text))] if texts else cells.tolist()
    return values


def test_report_numbers_are_in_the_named_tables(answer: PlanAnswer, tmp_path: Path) -> None:
    """Each number of the report (pages, summary, messages) equals the value in the column that it names."""
    tables = {name: QTable.read(write_table(table, tmp_path / f"{name}.ecsv")) for name, table in answer.tables.items()}
    count = 0
    for k, one in enumerate(answer.planned):
        for what, value, where in target_lines(answer, k):
            places = [part.strip().partition(":") for part in where.split(";")]
            values = [
                number
                for name, _, columns in places
                for column in columns.split(",")
                for number in held(tables[name], column.strip(), one.name)
            ]
            for token in NUMBER.findall(value):
                assert printed(token, values), (one.name, what, token)
                count += 1
        record = records(answer.table)[k]
        for column in answer.columns[1:]:
            values = [n for name in (column.name, *column.others) for n in held(tables["plan"], name, one.name)]
            for token in NUMBER.findall(column.text(record) if column.heading else ""):
                assert printed(token, values), (one.name, column.name, token)
                count += 1
    whole = [
        n
        for name in ("plan", "stars", "assumptions")
        for row in [*TARGET_NAMES, ""]
        for n in held(tables[name], "", row)
    ]
    for message in answer.messages:
        for token in NUMBER.findall(message):
            assert printed(token, whole), message
            count += 1
    assert count > 100


def test_missing_values_are_reported(answer: PlanAnswer) -> None:
    reported = " ".join(answer.messages)
    assert "Flare rates of Denebola, of the type 'A3V', are unknown except for an exponent of 1.3" in reported
    assert "EK Dra is never seen" in reported
    assert "the hours of different targets may coincide" in reported
    table = answer.table
    assert np.isnan(table["expected"][2])
    assert np.isfinite(table["E50"][2].value)
    assert table["expected"][3] == 0
    assert table["at_least_one"][3] == 0
    assert np.isinf(table["E50"][3].value)


@pytest.mark.long
def test_report_is_written(answer: PlanAnswer, study: Study) -> None:
    """The report has a page per target, a summary, and every assumption."""
    content = answer.documents["plan.pdf"]()
    assert len(re.findall(rb"/Type /Page\b", content)) >= len(answer.planned) + 2
    html = plan(study.with_settings(["plan.report=html"])).documents["plan.html"]().decode()
    for row in answer.assumptions:
        assert str(row["assumption"]) in html
    for planned in answer.planned:
        assert f"<h2>{planned.name}</h2>" in html
    assert html.count("data:image/png") == len(answer.planned)  # the overview; none of the star that is never seen
    # Hundreds of targets are to open quickly.
    assert max(len(picture) for picture in re.findall(r"data:image/png;base64,([^\"']+)", html)) < 45_000
    names = set(answer.assumptions["assumption"])
    assert {"stray light", "duration of flares", "noise of a stare", "throughput", "earth_limb_deg"} <= names


@pytest.mark.long
def test_report_escapes_markup_in_names(study: Study) -> None:
    target = {
        "name": "<script>$x^2$",
        "coordinates": "10.5 -3",
        "spectral_type": "K5V",
        "magnitude": 8,
        "distance_pc": 10,
    }
    odd = study.with_changes({"plan": {"targets": [target], "report": "html"}, "orbit": {"days": 5.0}}, None)
    answer = plan(odd)
    assert "<script>" not in answer.documents["plan.html"]().decode()
    made = plan(odd.with_settings(["plan.report=pdf"])).documents["plan.pdf"]
    assert made().startswith(b"%PDF")
    assert made() == made()
    assert answer.plot() is not None


def test_plan_takes_completeness_as_argument(study: Study) -> None:
    def none_below(observed: TargetObservation) -> Completeness:
        assert observed.window_s > 600
        edge = np.array([1e30, 1e33 * (1 - 1e-12), 1e33, 1e40])
        return Completeness(edge, np.array([0.0, 0.0, 1.0, 1.0]), "bolometric", "a step")

    one = study.with_settings(["plan.targets=[{name = 'eps Eri', alpha = 2.0, rate_per_day = 0.5, at_erg = 1e33}]"])
    answer = plan(one, completeness=none_below)
    assert answer.table["expected"][0] == pytest.approx(0.5 * 5, rel=0.02)
    mean = answer.table["expected"][0]
    # The user's own rates have no scatter beyond Poisson noise.
    assert [answer.table["low"][0], answer.table["high"][0]] == stats.poisson.ppf([0.025, 0.975], mean).tolist()


def test_conditions_equal_those_of_stares_along_the_orbit() -> None:
    """Compare temperature and hits while a target is seen with frames of the same orbit; both change the noise."""
    base = [
        "plan.targets=[{name='GJ 205'}]",
        "orbit.days=3",
        "orbit.start=2026-10-01",
        "plan.completeness='closed form'",
    ]
    study = Study().with_settings(base)
    observed = plan(study).planned[0].observation
    assert observed.conditions is not None
    along = stare_along(study.orbit.orbit(), "GJ 205", "2026-10-01", 3 * 86_400.0, frame_s=60.0)
    # The plan begins in balance, the stare with its past.
    assert observed.conditions.temperature_c == pytest.approx(along.stare.temperature_c.mean(), abs=0.2)
    assert observed.hits_per_cm2_s == pytest.approx(along.mean_hits_per_cm2_s, rel=1e-9)
    assert observed.quiet.conditions["temperature_c"] == observed.conditions.temperature_c
    injected = injection_case(observed).study
    stare = Case(injected).stare
    assert 13 < stare.temperature_c.min() < stare.temperature_c.mean() - 0.5 < stare.temperature_c.max() - 1 < 20
    assert injected.processes.cosmic_rays.rate_per_cm2_s == observed.hits_per_cm2_s

    still = plan(study.with_settings(["plan.along_orbit=false", "observation.temperature_c=21"]))
    assert still.stars["temperature"][0].value == 21.0
    assert still.stars["hits"][0].value == 0.0
    hot = study.with_settings(["observation.temperature_c=21"])
    rays = hot.with_settings(["processes.cosmic_rays.electrons=[5000, 10000]"])
    signals = [float(plan(one).stars["signal_per_frame"][0]) for one in (rays, hot)]
    assert signals[0] < 0.9 * signals[1] < 0.9 * still.stars["signal_per_frame"][0] < 0.9 * observed.signal_per_frame


def test_more_light_finds_smaller_flares(study: Study) -> None:
    two = [
        {"name": name, "coordinates": "10.5 -3", "spectral_type": "K5V", "magnitude": v, "distance_pc": 10}
        for name, v in (("near", 6.0), ("far", 9.0))
    ]
    # The fainter star is the less luminous one here: per energy its flares stand out as much more.
    answer = plan(study.with_changes({"plan": {"targets": two}, "orbit": {"days": 10.0}}, None))
    near, far = answer.stars["signal_per_frame"]
    assert near > 5 * far


def test_table_columns_have_types() -> None:
    assert subtype("M3.5Ve") == 63.5
    assert subtype("K") == 55
    assert nearest_spectrum("G2V") == "G2V"
    assert nearest_spectrum("dM4")[0] == "M"
    with refused("spectral_type", value="L5"):
        subtype("L5")


def test_file_of_rates_is_found_next_to_the_table(tmp_path: Path) -> None:
    (tmp_path / "ffd.csv").write_text("energy,rate\n1e31,2.0\n1e34,0.001\n")
    (tmp_path / "targets.csv").write_text("name,rates_file,rates_band\neps Eri,ffd.csv,TESS\n")
    changes = {"plan": QUICK | {"targets": read_targets(tmp_path / "targets.csv")}, "orbit": {"days": 2.0}}
    answer = plan(Study().with_changes(changes, None))
    assert answer.stars["rates"][0] == "ffd.csv"
    write_study(answer.study.toml(), tmp_path)
    assert Study.read(tmp_path / "study.toml").plan.targets[0].rates_file == tmp_path / "ffd.csv"
