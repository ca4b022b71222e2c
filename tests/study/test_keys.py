"""Keys of studies: units, ranges, paths, older files; sweeps, and averages over unknown values of the instrument."""

import tomllib
from collections.abc import Callable
from functools import cache
from itertools import permutations, product
from pathlib import Path
from typing import Any, get_args
from unittest.mock import Mock

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table
from marks import long_but
from refusals import refused
from scenes import instrument, star, study_of_g2v
from scipy import special, stats
from study_keys import NUMERIC, ends, fields, metadata, outside

import mauvecl
from mauvecl import Blackbody, Engine, InputError, Instrument, Source, Study, detect, expect, gaussian, limit

FIELDS = dict(fields())
STAR = Source.from_library("G2V")
STUDIES = Path(__file__).parents[1] / "data" / "studies"
VALUES = tomllib.loads((STUDIES / "values.toml").read_text(encoding="utf-8"))["values"]


@pytest.mark.parametrize(("key", "value", "plain"), VALUES)
def test_values_in_range_are_plain_numbers(key: str, value: str, plain: str) -> None:
    given, wanted = (eval(text, {"u": u}) for text in (value, plain))
    section, *_, name = key.split(".")
    data = [{"library": "G2V", name: given}] if section == "star" else {name: given}
    study = Study.build({section: data}, "test")
    found = getattr(study.star[0] if section == "star" else getattr(study, section), name)
    assert type(found) is type(wanted)
    if wanted is not None:
        np.testing.assert_allclose(found, wanted, rtol=1e-9)


#: Python functions that take the quantity; lines cannot be scaled by an argument.
CALLS: dict[str, Callable[[float], Any]] = {
    "magnitude": lambda v: STAR.at_magnitude(v),
    "amplitude": lambda v: STAR.flaring(v),
    "flare_temperature": lambda v: STAR.flaring(0.1, v),
    "balmer_jump": lambda v: mauvecl.BalmerFlare(1e4, v),
    "second_temperature": lambda v: mauvecl.TwoBlackbodies(1e4, v, 0.1),
    "second_area": lambda v: mauvecl.TwoBlackbodies(1e4, 2e4, v),
    "exposure": lambda v: expect(STAR.at_magnitude(7.0), Instrument.load("mauvesim"), exposure=v),
    "detector_temperature": lambda v: Instrument.load("mauvesim").with_(temperature_c=v),
    "sky": mauvecl.Sky.of_brightness,
}


def refuses(call: Callable[[], Any]) -> bool:
    try:
        call()
    except InputError as error:
        # Other errors, such as one of a spectrum that needs another key, do not name a range.
        return any(word in str(error) for word in ("between", "above", "at least", "up to"))
    return False


@pytest.mark.parametrize("name", NUMERIC)
def test_keys_sweeps_maps_and_arguments_have_the_range(name: str) -> None:
    key = ".".join(NUMERIC[name]).replace("star.", "star.0.")
    for value in outside(name):
        text = f"[{value!r}]" if name == "amplitude" else repr(value)
        assert refuses(lambda: Study().with_settings([f"{key}={text}"])), (key, value)  # noqa: B023
        for axis, place in (
            (f"sweep.axes=[{{quantity={name!r},values=[{value!r}]}}]", "sweep.axes.0"),
            (f"map.x={{quantity={name!r},values=[{value!r}]}}", "map.x"),
        ):
            with refused(f"{place}.values", repr(value).removesuffix(".0")):
                Study().with_settings(["map.y={quantity='star',values=['G2V']}", axis])
        if name != "line_scale":
            assert refuses(lambda: Study().at(name, value))  # noqa: B023
            assert refuses(lambda: CALLS[name](value))  # noqa: B023
    for value in ends(name):
        swept = Study().with_settings([f"sweep.axes=[{{quantity={name!r},values=[{value!r}]}}]"])
        assert swept.sweep.axes[0].points() == (value,)
        for start, log in product(np.linspace(*ends(name), 40)[1:-1].tolist(), (False, True)):
            axis = {"quantity": name, "start": start, "stop": value, "steps": 2, "log": log and min(start, value) > 0}
            assert Study.build({"sweep": {"axes": [axis]}}, "test").sweep.axes[0].points()[-1] == value
        assert name == "line_scale" or not refuses(lambda: CALLS[name](value))  # noqa: B023


def test_keywords_of_another_kind_are_refused_or_taken() -> None:
    """No keyword of a study fails with anything but a refusal on one line."""
    names = {flag.parameter for _, field in fields() for flag in metadata(field, "Flag", every=True)}
    for name, value in product(names, (7, 0.5, object(), [object()], [None], {"a": 1}, Path("x"), np.ones(2))):
        try:
            Study.of(**({"star": "G2V"} | {name: value}))
        except InputError as error:
            assert "\n" not in str(error), (name, value)  # noqa: PT017


def test_keys_of_one_kind_share_a_range() -> None:
    """All temperatures of stars and flares have one range, and the detector's its own, wherever it is a key."""
    found: dict[str, set[tuple[float, float]]] = {"K": set(), "deg_C": set()}
    for field in FIELDS.values():
        unit, one = metadata(field, "Unit"), metadata(field, "Range")
        if one is not None and unit is not None and unit.name in found:
            found[unit.name].add((one.low, one.high))
    assert found == {"K": {(1_000, 200_000)}, "deg_C": {(-40, 65)}}


def holds_path(kind: Any) -> bool:
    return kind is Path or any(map(holds_path, get_args(kind)))


#: Every key that holds a path.
FILES = (STUDIES / "paths.toml").read_text(encoding="utf-8")


def test_paths_are_relative_to_the_study_file_and_absolute_in_its_text(tmp_path: Path) -> None:
    keys = {".".join(path) for path, field in FIELDS.items() if holds_path(field.annotation)}
    (tmp_path / "study.toml").write_text(FILES.replace('"F"', '"there/f.txt"'))
    (tmp_path / "there").mkdir()
    light = np.transpose([np.linspace(150.0, 1200.0, 500), np.ones(500)])
    np.savetxt(tmp_path / "there" / "f.txt", light)
    study = Study.read(tmp_path / "study.toml")
    absolute = tomllib.loads(study.toml())
    assert str(absolute).count(str(tmp_path / "there" / "f.txt")) == len(keys) == FILES.count('"F"')
    # Read elsewhere, the text gives the same study.
    assert Study.build(absolute, "elsewhere") == study
    # An answer's table names the files by their content, and is read next to them or in a folder there.
    assert (study.text().count("_sha256"), study.text().count(str(tmp_path))) == (len(keys), 0)
    for table in (tmp_path / "there" / "table.ecsv", tmp_path / "there" / "out" / "table.ecsv"):
        table.parent.mkdir(exist_ok=True)
        Table({"x": [1.0]}, meta={"study": study.text()}).write(table, format="ascii.ecsv")
        assert Study.read(table) == study
    np.savetxt(tmp_path / "there" / "f.txt", 2 * light)
    with pytest.raises(InputError, match=r"its file 'f.txt' with sha256 .* has changed"):
        Study.read(table)


def test_text_of_a_study_gives_the_study_and_one_of_an_older_version_keeps_its_keys() -> None:
    """That of `snr --at 300`, in which no S/N is wanted, keeps the wavelength."""
    axes = [{"quantity": "magnitude", "values": [6.0, 9.0]}, {"quantity": "exposure", "values": ["5 s", 50.0]}]
    swept = {"sweep": {"how": "list", "axes": axes}, "unknowns": {"draws": 4, "known": ["qe_scale"]}}
    for study in (Study.of(at=300.0), Study.of(per="pixel"), Study.of(snr=10.0), Study.build(swept, "test")):
        for text in (study.text(), study.toml()):
            assert Study.build(tomllib.loads(text), "text") == study
    assert "signal" not in tomllib.loads(Study().toml())
    # Of the older version, in which limits, curves and cooling had classes for their text.
    given, now = (tomllib.loads((STUDIES / f"{name}.toml").read_text("utf-8")) for name in ("older", "older-now"))
    study = Study.build(given, "text")
    written = tomllib.loads(study.toml())
    found = written["stare"] | written["orbit"] | {"events": written["events"]}
    assert {name: found[name] for name in now} == now
    assert Study.build(written, "text") == study


def study(axes: list[dict[str, Any]], how: str = "product", **changes: Any) -> Study:
    swept = {"flare": {"amplitudes": [0.1]}, "sweep": {"how": how, "axes": axes}}
    return study_of_g2v(**swept | changes).paper()


MAGNITUDES = {"quantity": "magnitude", "values": [6.0, 9.0]}
EXPOSURES = {"quantity": "exposure", "values": ["5 s", 50.0]}
TWO = {"second_temperature_k": 20_000.0, "second_area": 0.1}
LINES = {"lines": {"H alpha": 0.1}}
#: Two values of each quantity that a sweep may have.
SWEPT: dict[str, tuple[Any, Any]] = {
    "star": ("G2V", "M3V"),
    "magnitude": (6.0, 7.0),
    "amplitude": (0.1, 0.2),
    "flare_temperature": (8000.0, 12_000.0),
    "balmer_jump": (2.0, 3.0),
    "second_temperature": (5000.0, 6000.0),
    "second_area": (2.0, 3.0),
    "line_scale": (0.5, 2.0),
    "exposure": (5.0, 50.0),
    "detector_temperature": (-10.0, 10.0),
    "sky": (21.0, 22.0),
}
SECTIONS = {"second_temperature": TWO, "second_area": TWO, "line_scale": LINES}
#: The spectrum of the flare at a value.
LIGHT = {name: CALLS[name] for name in ("balmer_jump", "second_temperature", "second_area")} | {
    "flare_temperature": Blackbody,
    "line_scale": lambda v: mauvecl.FlareWithLines(Blackbody(10_000.0), {"H alpha": 0.1 * v}),
}


@pytest.mark.parametrize("quantity", Study.model_json_schema()["$defs"]["Axis"]["properties"]["quantity"]["enum"])
def test_sweep_gives_the_expectations_of_each_value(quantity: str, engine: Engine, monkeypatch: Any) -> None:
    """The file of the instrument is read once: temperatures of a sweep change an instrument that is kept."""
    monkeypatch.setattr(mauvecl.Instrument, "load", load := Mock(wraps=mauvecl.Instrument.load))
    values = SWEPT[quantity]
    swept = study(
        [{"quantity": quantity, "values": values}], flare={"amplitudes": [0.1], "spectrum": SECTIONS.get(quantity, {})}
    )
    found = detect(swept.with_settings(["run={realisations=1000, fap=0.2, statistics=['matched']}"]), engine)
    assert [one.at for one in found.stars] == [{quantity: value} for value in values]
    load.assert_called_once_with("mauvesim")
    for value, one in zip(values, found.stars, strict=True):
        given = {"star": "G2V", "magnitude": 7.4, "amplitude": 0.1, "exposure": 50.0, "sky": 22.1} | {quantity: value}
        light = LIGHT[quantity](value) if quantity in LIGHT else Blackbody(10_000.0)
        quiet = mauvecl.Source.from_library(given["star"]).at_magnitude(given["magnitude"])
        payload = mauvecl.Instrument.load("mauvesim").with_(temperature_c=given.get("detector_temperature", 21.0))
        how = {"exposure": given["exposure"], "sky": mauvecl.Sky.of_brightness(given["sky"])}
        wanted = [mauvecl.expect(x, payload, **how) for x in (quiet, quiet.flaring(given["amplitude"], spectrum=light))]
        for x, y in zip((one.detection.quiet, *one.detection.flares), wanted, strict=True):
            np.testing.assert_allclose(x.source_electrons, y.source_electrons, rtol=1e-12)
            np.testing.assert_allclose(x.recorded_dn, y.recorded_dn, rtol=1e-12)
            np.testing.assert_allclose(x.variance_dn2, y.variance_dn2, rtol=1e-12)
            assert x.n_frames == y.n_frames


def test_each_cell_equals_its_own_detection(engine: Engine) -> None:
    """A cell of a product or list has the same bits as the cell alone; columns give the swept values."""
    found = detect(study([MAGNITUDES, EXPOSURES]), engine).table
    assert list(found["magnitude"].value) == [6, 6, 9, 9]
    assert list(found["exposure"].value) == [5, 50, 5, 50]
    for row in found:
        alone = study([]).at("magnitude", row["magnitude"].value).at("exposure", row["exposure"].value)
        (same,) = detect(alone, engine).table
        assert (same["probability"], same["threshold"]) == (row["probability"], row["threshold"])
    assert found["probability"][0] > found["probability"][2]
    listed = detect(study([MAGNITUDES, EXPOSURES], "list"), engine).table
    assert list(listed["probability"]) == [found["probability"][0], found["probability"][3]]
    amplitudes = detect(study([{"quantity": "amplitude", "values": [0.01, 0.1]}]), engine).table
    assert list(amplitudes["amplitude"]) == [0.01, 0.1]
    # A colder detector and a longer exposure have fainter limits, and the first sentence has the first exposure.
    axes = [{"quantity": "detector_temperature", "values": [13.0, 21.0]}, EXPOSURES]
    answer = mauvecl.limit(study(axes), engine)
    assert " in 5 s with " in answer.headline
    assert list(answer.table["detector_temperature"].value) == [13, 13, 21, 21]
    value = answer.table["magnitude"].value
    assert value[0] > value[2]
    assert value[1] > max(value[0], value[3])


@pytest.mark.long
def test_formula_holds_for_the_payload_and_fails_at_saturation(engine: Engine) -> None:
    """The formula holds for the nominal payload and fails with a bias near zero, which clips counts."""
    asked = study([MAGNITUDES, EXPOSURES])
    answer = gaussian(asked, engine)
    cells, elements = answer.cells, answer.elements
    assert len(cells) == 4
    assert np.all(np.abs(cells["fap_ratio"] - 1) < 1e-9)
    assert np.all((cells["coverage_low"] > 0.66) & (cells["coverage_high"] < 0.71))
    # Coverage from histograms equals that of the same realisations.
    quiet = mauvecl.snr(asked, engine).stars[0].result.expectation
    raw = engine.realise(quiet, count=20_000, seed=5)
    net = raw - quiet.n_frames * (quiet.bias_dn + quiet.dark_dn)
    known = quiet.n_frames * (quiet.read_noise_dn**2 + quiet.dark_variance_dn2)
    sigma = np.sqrt(quiet.gain_dn_per_electron * np.maximum(net, 0) + known)
    direct = np.mean(np.abs(net - quiet.recorded_light_dn) <= sigma, axis=0)
    first = (elements["magnitude"].value == 6) & (elements["exposure"].value == 5)
    count = quiet.per_element(np.ones(quiet.wavelength_nm.size))
    np.testing.assert_allclose(elements[first]["coverage"].value, quiet.per_element(direct) / count, atol=0.003)
    low = gaussian(asked.with_instrument({"bias_dn": 5.0, "dark_scale_dn_per_s": 0.01}), engine)
    # Counts are cut off at zero, not at saturation.
    assert not any("saturation" in text for text in low.signal.messages)
    clipped = low.cells
    (faint,) = clipped[(clipped["magnitude"].value == 9) & (clipped["exposure"].value == 5)]
    assert abs(faint["snr_off_by"]) > 0.1
    assert faint["why"] == "clipping"
    assert faint["fap_ratio"] != 1.0
    # Nothing is said of false alarms that are not counted.
    rare = gaussian(study([]).with_settings(["run.fap=1e-6", "run.tails=sampled"]), engine)
    assert np.isnan(rare.cells["fap_ratio"][0])
    assert "as many" not in rare.headline


@pytest.mark.parametrize("name", ["mauvesim", "mauve"])
@pytest.mark.parametrize("temperature", [21.0, -30.0])
def test_pixels_beyond_five_sigma_are_counted(name: str, temperature: float, engine: Engine) -> None:
    """The saddle-point tail agrees with the exact sum over dark counts to 0.3 %; the distribution is skewed upward."""
    part = {"output_min_nm": 340.0, "output_max_nm": 350.0, "temperature_c": temperature}
    asked = study([{"quantity": "exposure", "values": [5.0]}], observation={"changes": part})
    answer = gaussian(asked.with_settings([f"observation.instrument={name}"]), engine)
    (cell,) = answer.cells
    # A part of the spectrum without any of the usual wavelengths shows its middle.
    assert answer.signal.shown_nm == [pytest.approx(345.0, abs=0.2)]
    assert len(answer.signal.views[0].table) == 1
    (quiet,) = star(exposure=5.0, payload=instrument(name, **part))
    poisson = quiet.photon_noise == "poisson"
    found = []
    for p in range(quiet.wavelength_nm.size):
        step = float(quiet.dark_step_dn[p])
        # Both photons and dark current are then Poisson in electrons.
        mean = quiet.dark_dn[p] / step + (quiet.source_electrons + quiet.sky_electrons)[p] * poisson
        goal = 5 * np.sqrt(quiet.variance_dn2[p] - 1 / 12)
        photon = quiet.gain_dn_per_electron[p] * quiet.recorded_light_dn[p]
        sd = np.sqrt(quiet.read_noise_dn[p] ** 2 + photon * (not poisson))
        counts = np.arange(int(mean + 14 * np.sqrt(mean) + 30))
        beyond = [stats.norm.sf((goal - side * (counts - mean) * step) / sd) for side in (1, -1)]
        found.append(beyond @ stats.poisson.pmf(counts, mean) / stats.norm.sf(5.0))
    above, below = np.transpose(found)
    assert cell["five_sigma_above"] == pytest.approx(above.max(), rel=3e-3)
    assert cell["five_sigma_below"] == pytest.approx(below.min(), rel=3e-3)
    assert cell["five_sigma_above"] > 1 > cell["five_sigma_below"]


ALL = ("temperature_c", "light_loss", "pointing_loss", "qe_scale", "conversion_uv_per_electron", "read_noise_dn")


def unsure(unknowns: dict[str, Any], **changes: Any) -> Study:
    return study_of_g2v(run={"realisations": 40_000}, unknowns={"draws": 8} | unknowns, **changes)


def assert_shares_are_those_of_a_linear_model(unknown: Any) -> None:
    """Add the unknowns to a linear fit in each of 720 orders, and average what each adds to the explained variance."""
    x, y = stats.zscore(unknown.draws.values), unknown.limits

    @cache
    def explained(some: frozenset[int]) -> float:
        fitted = np.column_stack([x[:, sorted(some)], np.ones(len(y))])
        left = y - fitted @ np.linalg.lstsq(fitted, y, rcond=None)[0]
        return 1.0 - left.var() / y.var()

    orders = list(permutations(range(len(ALL))))
    wanted = np.zeros(len(ALL))
    for order in orders:
        for place, k in enumerate(order):
            before = frozenset(order[:place])
            wanted[k] += (explained(before | {k}) - explained(before)) / len(orders)
    found = dict(unknown.shares)
    assert found.pop("the rest") == pytest.approx(1.0 - wanted.sum())
    assert list(found.values()) == sorted(found.values(), reverse=True)
    np.testing.assert_allclose([found[name] for name in ALL], wanted, rtol=1e-9)


@pytest.mark.long
def test_limit_over_unknowns_has_the_power_on_average(engine: Engine) -> None:
    """The mean of the closed form is the power; worse instruments have brighter limits; one unknown explains most."""
    averaged = limit(unsure({"draws": 24}), engine)
    (found,) = averaged.limits
    unknown, draws = found.unknown, found.unknown.draws
    assert draws.names == ALL
    values = dict(zip(draws.names, draws.values.T, strict=True))
    # The sample is a Latin hypercube: every 24th of each prior once.
    even = {"temperature_c": stats.uniform(13, 8), "pointing_loss": stats.uniform(0, 0.05),
            "light_loss": stats.truncnorm(-3, 3, loc=0.34, scale=0.1)}  # fmt: skip
    for name, prior in even.items():
        np.testing.assert_array_equal(np.sort(np.floor(24 * prior.cdf(values[name]))), np.arange(24))
    one, nominal = draws.studies[7].observation.load_instrument(), Instrument.load("mauvesim")
    for name in ("temperature_c", "light_loss", "pointing_loss", "conversion_uv_per_electron", "read_noise_dn"):
        assert getattr(one, name) == values[name][7]
    assert one.collecting_area_cm2 == pytest.approx(values["qe_scale"][7] * nominal.collecting_area_cm2)
    few = {"realisations": 10_000, "fap": 1e-2, "statistics": ["matched"]}
    at_limit = [one.at("magnitude", found.closed_form).with_changes({"run": few}, None) for one in draws.studies]
    each = [float(detect(one, engine).table["closed_form_probability"][0]) for one in at_limit]
    assert np.mean(each) == pytest.approx(0.9, abs=2e-3)
    assert found.verdict in ("confirms it", "")
    low, high = unknown.range
    assert low < found.value.value < high
    # The limit must hold for most instruments and is therefore brighter than the median.
    assert found.closed_form < np.median(unknown.limits)
    assert np.corrcoef(values["qe_scale"], unknown.limits)[0, 1] > 0.6
    assert averaged.table["matters_most"][0] == next(iter(unknown.shares)) == "qe_scale"
    limits = [averaged.table[name] for name in ("unknown_low", "unknown_high", "magnitude")]
    assert limits[0][0] < limits[1][0]
    assert {column.unit for column in (*limits, averaged.draws["magnitude"])} == {u.mag}
    np.testing.assert_array_equal(averaged.draws["qe_scale"], values["qe_scale"])
    assert_shares_are_those_of_a_linear_model(unknown)


def test_prior_of_zero_width_changes_nothing(engine: Engine) -> None:
    """A prior of zero width gives the limit of the nominal instrument, and no draw if all values are known."""
    sure = {"light_loss": {"uniform": [0.34, 0.34]}, "known": [name for name in ALL if name != "light_loss"]}
    first, second = (limit(unsure(given), engine) for given in (sure | {"draws": 2}, {"draws": 0}))
    (one,), (two,) = first.limits, second.limits
    assert [one.views[0].title.rpartition(" test, ")[2] for one in (first, second)] == [
        "20,000 realisations of each draw",
        "40,000 realisations",
    ]
    assert first.table["matters_most"].tolist() == [""], "nothing moves the limit"
    assert one.closed_form == pytest.approx(two.closed_form, abs=1e-4)
    assert one.unknown.range == pytest.approx((two.closed_form, two.closed_form), abs=1e-4)
    assert abs(one.value.value - two.value.value) < 0.03


@pytest.mark.long
def test_map_is_the_mean_of_draws_of_what_the_study_does_not_state(engine: Engine) -> None:
    """The interval holds the error of each draw and of few draws, cut at 0 and 1; a constant has no share."""
    axes = {
        "x": {"quantity": "magnitude", "values": [7.0, 10.5]},
        "y": {"quantity": "amplitude", "values": [0.1, 0.24]},
    }
    asked = unsure({"draws": 4, "known": ALL[2:], "light_loss": {"uniform": [0.25, 0.25]}}, map=axes)
    found = mauvecl.map(asked, engine)
    each = [mauvecl.map(one, engine) for one in limit(asked, engine).limits[0].unknown.draws.studies]
    values = np.array([one.probability for one in each])
    np.testing.assert_allclose(found.probability, values.mean(axis=0))
    own = np.array([one.high - one.low for one in each]) / 2
    reach = special.ndtri(0.975) * values.std(axis=0, ddof=1) / 2
    half = np.hypot(reach, np.sqrt(np.sum(own**2, axis=0)) / 4)
    np.testing.assert_allclose(found.low, np.maximum(found.probability - half, 0.0))
    np.testing.assert_allclose(found.high, np.minimum(found.probability + half, 1.0))
    # A prior of zero width explains nothing.
    assert set(found.shares["matched"]) == {*ALL[:2], "the rest"}
    assert 0.0 <= found.shares["matched"]["light_loss"] < 1e-12
    # Values of the study are not drawn.
    stated = unsure({"draws": 2}, observation={"temperature_c": 15.0, "changes": {"light_loss": 0.3}})
    unknown = limit(stated, engine).limits[0].unknown
    assert unknown.draws.names == ALL[2:]
    for one in unknown.draws.studies:
        instrument = one.observation.load_instrument()
        assert (instrument.temperature_c, instrument.light_loss) == (15.0, 0.3)


@pytest.mark.parametrize("of", ["magnitude", "amplitude", "exposure"])
@pytest.mark.parametrize("geometry", long_but(["added", "replaces"], "added"))
def test_closed_form_of_a_detection_at_the_limit_is_the_power(of: str, geometry: str, engine: Engine) -> None:
    """The search scales expectations, the detection makes them anew; an exposure is the first frame that suffices."""
    asked = unsure({"draws": 0}, limit={"of": of}).with_settings(
        [f"flare.geometry={geometry}", "flare.photosphere_temperature_k=5800", "star.0.magnitude=12"]
    )
    (found,) = limit(asked, engine).limits

    def probability(value: float) -> float:
        one = asked.at(of, value).with_settings(["run.realisations=10000"])
        return float(detect(one, engine).table["closed_form_probability"][0])

    if of == "exposure":
        assert probability(found.closed_form) >= 0.9 > probability(found.closed_form - 5.0)
    else:
        assert probability(found.closed_form) == pytest.approx(0.9, abs=2e-4)
