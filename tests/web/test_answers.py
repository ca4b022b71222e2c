"""Fields and answers of the page, as its script asks for them: what is entered, the two chances, limits, pictures."""

import asyncio
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bokeh.document import Document
from bokeh.models import ColorBar, ColumnDataSource
from commands import run
from marks import long_but
from scipy.interpolate import RegularGridInterpolator
from study_keys import reach

from tests.web.visits import Server, Talk, column, link

NUMBER = r"(-?[\d.]+(?:e[+-]?\d+)?)"
HOSTILE = "![x](http://127.0.0.1:1/x.png) <img src=http://127.0.0.1:1/y.png>"
M_DWARF = {"star": "M3V", "magnitude": "9", "amplitude_percent": "2", "exposure_s": "50"}
DATA = Path(__file__).parents[1] / "data" / "web"
TEXTS, TABS = (tomllib.loads((DATA / f"{name}.toml").read_text(encoding="utf-8")) for name in ("texts", "shown"))
#: Quantities of studies by their fields.
QUANTITIES = {
    "magnitude": "magnitude", "amplitude": "amplitude_percent", "exposure": "exposure_s", "sky": "sky_brightness",
    "flare_temperature": "flare_temperature_k", "detector_temperature": "temperature_c",
}  # fmt: skip
#: Written by the page of version 0.1.0.
OLD_LINK = (
    "?star=M3V&magnitude=9&band=V&amplitude_percent=10&exposure_s=50&flare_temperature_k=10000&temperature_c=21"
    "&instrument=mauve&signal=net&sky=brightness&sky_brightness=22.1&statistic=matched&fap=0.001&unknown=the+usual"
    "&hours=100&realisations=100000&seed=1&tab=limit"
)
UNKNOWN = ("realistic", "ideal")


async def faults_of_all(talk: Talk, words: dict[str, Any], entered: dict[str, str]) -> dict[str, str]:
    """Return the faults of all tabs together, each of which reports those of the fields that it shows."""
    found: dict[str, str] = {}
    for tab in words["tabs"]:
        found |= await talk.faults(link(**entered), tab)
    return found


async def test_invalid_numbers_are_faults_and_ranges_include_their_ends(talk: Talk, words: dict[str, Any]) -> None:
    """Every field with a number says what it accepts, accepts it, and accepts nothing else."""
    found = await faults_of_all(talk, words, dict.fromkeys(words["fields"], "seven"))
    numbers = {
        name: why.partition(": enter ")[2]
        for name, why in found.items()
        if re.match("'seven' is not a (whole )?number", why)
    }
    assert len(numbers) >= 29
    # Ranges are those of studies.
    for name, field in QUANTITIES.items():
        scale, one = 100 if name == "amplitude" else 1, reach(name)
        limits = [float(text) for text in re.findall(NUMBER, numbers[field])[:2]]
        assert limits == [scale * one.low, scale * one.high], name
    for text in ("7,4", "1e999", "nan", "inf", "-inf", "1_0", "0x10", "٣", "1e400000"):
        found = await faults_of_all(talk, words, dict.fromkeys(numbers, text))
        assert {name for name, accepted in numbers.items() if accepted not in found.get(name, "")} == set(), text
    assert found["seed"] == "'1e400000' is not a whole number: enter a whole number from 0 to 18446744073709551615"
    # What may be left out is empty on a new page.
    for text in ("", " "):
        found = await faults_of_all(talk, words, dict.fromkeys(numbers, text))
        for name, accepted in numbers.items():
            needed = words["fields"][name] != ""
            assert (found.get(name) == f"nothing is entered; {accepted} is needed") == needed, name
    for low, closed, opened, sign in (
        (True, rf"(?:from|between) {NUMBER} ", rf"above {NUMBER}", -1),
        (False, rf" (?:to|and|up to) {NUMBER}", rf"below {NUMBER}", 1),
    ):
        for form, beyond, refused in ((closed, 0, False), (closed, sign, True), (opened, 0, True)):
            ends = {name: at[1] for name, accepted in numbers.items() if (at := re.search(form, accepted))}
            assert len(ends) > 1, (low, form)
            if beyond:
                # Whole numbers of any size.
                ends = {n: str(int(x) + sign) if x.isdigit() else f"{float(x) + sign:.17g}" for n, x in ends.items()}
            found = await faults_of_all(talk, words, ends)
            wrong = {name for name in ends if ("out of range" in found.get(name, "")) != refused}
            assert wrong == set(), (form, beyond)


async def test_texts_are_refused_at_their_field_or_accepted(talk: Talk) -> None:
    for row in TEXTS["refused"]:
        reported = await talk.answer(link(**row["entered"]), row["tab"])
        assert "answer" not in reported, row
        # An empty time or target is a fault of its own.
        assert reported["faults"].keys() <= {row["field"], "target", "time"}, row
        assert row["says"] in reported["faults"][row["field"]], row
    for row in TEXTS["accepted"]:
        reported = await talk.answer(link(**row["entered"]), row["tab"])
        assert reported["faults"] == {}, row
        answer = reported["answer"]
        assert row["says"] in f"{answer['words']}\n{answer.get('headline')}\n{reported['known']}", row


async def test_links_are_read_with_care(talk: Talk, words: dict[str, Any]) -> None:
    reported = await talk.answer("?magnitud=8&tab=x")
    assert "magnitud" in reported["stray"]
    assert "The link's tab" in reported["stray"]
    assert "V = 8.5" in reported["answer"]["words"], "what it does not hold stands as at first"
    reported = await talk.answer("?star=" + "G" * 10_000)
    assert "more than 8192" in reported["stray"]
    assert "answer" in reported
    reported = await talk.answer(OLD_LINK)
    assert "version 1" in reported["stray"]
    assert reported["faults"] == {}
    assert "a 10 % flare (10000 K) on an M3V star" in reported["answer"]["words"]
    assert "with the payload mauvesim" in reported["answer"]["words"]
    command = (await talk.exported(OLD_LINK))["detection"]["command"]
    assert "--ideal" not in command
    for text in (HOSTILE, "1 & 2=3", "\ud83d\ude00".encode("utf-16", "surrogatepass").decode("utf-16")):
        assert f"'{text[:8]}" in (await talk.faults(link(star=text)))["star"]
    assert "magnitude" in (await talk.faults("?magnitude=")), "an emptied field is not filled"
    chances = [(await talk.chances(link(**given)))[0] for given in words["presets"].values()]
    assert 0.4 < chances[0] < 0.7, "at the edge of detection"


async def test_each_number_is_the_answer_to_its_own_question(talk: Talk) -> None:
    """Whichever is chosen; with other payloads, too, whose chances are told in a sentence."""
    for more in ({}, {"statistic": "chi2_element"}, {"own_unknown": "200 1, 450 3"}):
        shown = []
        for unknown in UNKNOWN:
            reported = (await talk.answer(link(**M_DWARF, **more, unknown=unknown)))["answer"]
            shown.append([one["value"] for one in reported["numbers"]])
            chosen = reported["numbers"][UNKNOWN.index(unknown)]
            assert (reported["chosen"], reported["shown"]) == (unknown, chosen["shown"])
            assert "payload mauve" in reported["words"]
            if not more:
                assert [one["shown"] for one in reported["numbers"]] == ["4.9 %", "97.5 %"]
                assert {kind for _, kind in reported["notes"]} == {"info"}
        assert shown[0] == shown[1]
    notes = (await talk.answer(link(magnitude="-1")))["answer"]["notes"]
    assert {text.partition(":")[0] for text, kind in notes if kind == "danger"} == {"SATURATED"}
    other = (await talk.answer(link(**M_DWARF, instrument="mauvesim")))["answer"]["numbers"]
    payloads, _ = await talk.solved(link(**M_DWARF))
    assert f"Chances with mauvesim: {' and '.join(one['shown'] for one in other)}." in payloads
    usual, known = (await talk.answer(link(**M_DWARF, statistic="paper", unknown="ideal")))["answer"]["numbers"]
    assert known["value"] is not None
    assert usual["value"] is None
    assert "cannot be marginalised" in usual["interval"]
    # The throughput's uncertainty is that of the light of star, flare, neighbours and sky together.
    fainter = -2.5 * np.log10(0.7)
    for near in ("", "name,separation,magnitude,spectral_type\nB,8,{:.9f},G2V"):
        dark = M_DWARF | {"sky": "none", "neighbours": near.format(8)}
        dimmer = {"magnitude": f"{9 + fainter:.9f}", "neighbours": near.format(8 + fainter)}
        dim = await talk.chances(link(**dark | dimmer))
        spread = (await talk.answer(link(**dark)))["answer"]["numbers"][1]["interval"]
        assert f"; {100 * dim[1]:.1f} % to " in spread


@pytest.mark.parametrize("of", ["amplitude", "magnitude", "exposure"])
async def test_limits_are_detected_with_the_wanted_probability(talk: Talk, of: str) -> None:
    """The limits of the sentence are inverted: their chances are 0.8 within the rounding of the sentence."""
    field = QUANTITIES[of]
    _, told = await talk.solved(link(**M_DWARF, of=of, power="0.8"))
    assert told.startswith("80 % of flares")
    limits = re.findall(r"(?:of at least|to V =|in) ([\d.,]+)", told)
    assert len(limits) == 2, told
    for number, limit in enumerate(limits):
        chances = await talk.chances(link(**M_DWARF | {field: limit.replace(",", "")}))
        if of == "exposure":
            # Whole frames have at least the power, and one frame fewer has less.
            fewer = f"{float(limit.replace(',', '')) - 5:g}"
            assert (await talk.chances(link(**M_DWARF | {field: fewer})))[number] < 0.8 <= chances[number]
        else:
            assert chances[number] == pytest.approx(0.8, abs=0.02)
    if of == "magnitude":
        _, told = await talk.solved(link(**M_DWARF | {"amplitude_percent": "0.0001"}, of=of))
        assert "at no magnitude" in told
    if of == "amplitude":
        _, told = await talk.solved(link(**M_DWARF, statistic="chi2_element"))
        assert told.startswith("90 % of flares of an amplitude that takes a simulation")


@pytest.mark.long
async def test_pictures_state_what_the_answer_is(talk: Talk) -> None:
    drawn = await talk.answer(link(unknown="ideal"))
    # Squares of the excess per pixel add up to the square of the matched S/N.
    found = np.sqrt(np.sum(column(drawn, "excess", "pixel", "y").astype(float) ** 2))
    assert found == pytest.approx(float(dict(drawn["answer"]["facts"])["Expected with flare"]), rel=1e-3)
    (half,) = re.findall(r"half of them at (\S+)\.$", drawn["pictures"]["roc"]["text"])
    at_half = await talk.chances(link(fap=half, realisations="1000000 sampled"))
    assert at_half[1] == pytest.approx(0.5, abs=0.02)
    drawn = await talk.answer(link(magnitude="7.4", unknown="ideal"))
    assert "half of them still below 1e-06" in drawn["pictures"]["roc"]["text"]
    # Regions of two temperatures are those of normal errors of the logarithms.
    asked = {"second_temperature_k": "30000", "flare_temperature_k": "9000", "magnitude": "6"}
    drawn = await talk.answer(link(**asked, amplitude_percent="10"), "measure")
    own = [column(drawn, "region", "own", name)[0] for name in "xy"]
    assert own == [9000.0, pytest.approx(10.0)]
    for name in ("known", "free"):
        kelvin, low, high = (column(drawn, "region", name, axis) for axis in ("x", "low", "high"))
        # In the middle of the curve the flare is the question's own; its fitted value is near the true one.
        reach = np.sqrt(5.99) * column(drawn, "errors", name, "y")[4] / 100
        np.testing.assert_allclose(np.log(kelvin[[0, -1]] / 9000), [-reach, reach], rtol=0.02)
        assert low.min() * high.max() == pytest.approx(100.0, rel=3e-3)
        assert low[80] < 10 < high[80]
    drawn = await talk.answer(link(**asked, amplitude_percent="1"), "measure")
    assert np.size(column(drawn, "region", "known", "x")) > 0
    assert np.size(column(drawn, "region", "free", "x")) == 0, "no region has errors of 100 %"


STATISTICS = ("matched", "chi2", "chi2_element", "chi2_pair", "uv_excess", "paper")


@pytest.mark.parametrize("statistic", long_but(STATISTICS, "matched"))
async def test_curve_and_map_show_the_closed_form(talk: Talk, statistic: str) -> None:
    """Also between computed points: the curve within 1 %, the map within 0.06 mag; labels stand on contours."""

    # Sums of squares with unknowns take a simulation.
    unknown = UNKNOWN[statistic != "matched"]
    number = UNKNOWN.index(unknown)

    def asked(magnitude: float, percent: float) -> str:
        return link(
            unknown=unknown, statistic=statistic, amplitude_percent=f"{percent:.9g}", magnitude=f"{magnitude:.9g}"
        )

    drawn = await talk.answer(asked(8.5, 5.0), "limit")
    x, y = (column(drawn, "limit", "closed form", axis) for axis in "xy")
    steep = np.nonzero((y > 0.02) & (y < 0.98))[0]
    steep = steep[:: max(1, steep.size // 5)]
    assert steep.size >= 3
    for magnitude, chance in zip(x[steep], y[steep], strict=True):
        assert chance == pytest.approx((await talk.chances(asked(float(magnitude), 5.0)))[number], abs=0.01)
    image, percent = (column(drawn, "map", "map", name)[0] for name in ("image", "percent"))
    across, compared = np.linspace(2.0, 14.0, image.shape[1]), 0
    assert percent[:, 0] == pytest.approx(np.geomspace(0.1, 100.0, image.shape[0]))
    for row in range(10, image.shape[0], 15):
        # Where the chance is about a half.
        at = int(np.argmin(np.abs(image[row] - 0.5)))
        if 0.2 < image[row, at] < 0.8:
            near = (asked(across[at] + shift, float(percent[row, 0])) for shift in (0.06, -0.06))
            low, high = [(await talk.chances(one))[number] for one in near]
            assert low - 0.01 < image[row, at] < high + 0.01
            compared += 1
    assert compared >= 2
    labels = {name: column(drawn, "map", "labels", name) for name in ("text", "x", "y")}
    assert list(labels["text"]) == ["10 %", "50 %", "90 %"]
    grid = RegularGridInterpolator((np.linspace(-1, 2, image.shape[0]), across), image)
    assert grid(np.column_stack([labels["y"], labels["x"]])) == pytest.approx([0.1, 0.5, 0.9], abs=0.03)
    for name, wanted in (("half", (0.5,)), ("contours", (0.1, 0.9))):
        for xs, ys in zip(*(column(drawn, "map", name, axis) for axis in ("xs", "ys")), strict=True):
            level = grid(np.column_stack([ys, xs]))
            assert min(np.abs(level - one).max() for one in wanted) < 0.03


@pytest.mark.long
@pytest.mark.parametrize("of", ["amplitude", "magnitude"])
async def test_picture_of_the_limit_has_simulated_points_of_its_own_axis_only(talk: Talk, of: str) -> None:
    asked = link(**M_DWARF, realisations="10000", fap="0.05", of=of)
    assert re.fullmatch(r"Done: 300 of 300 steps, \d+ s\.", await talk.simulate("limit", asked))
    drawn = await talk.answer(asked, "limit")
    magnitudes = column(drawn, "limit", "simulated", "x")
    assert bool(len(magnitudes)) == (of == "magnitude")
    assert all(5 < magnitude < 14 for magnitude in magnitudes)
    unit = r"of at least [\d.]+ % \[[\d.]+ % to [\d.]+ %\]" if of == "amplitude" else r"to V = [\d.]+ \["
    told = drawn["pictures"]["limit"]["text"]
    assert re.search(f"Simulated: 90 % are detected .*{unit}", told), told


@pytest.mark.parametrize("tab", long_but(TABS, "detection", "limit"))
async def test_every_picture_has_its_data(talk: Talk, server: Server, words: dict[str, Any], tab: str) -> None:
    """A figure's sources and the data that come have the same names and columns, in both themes and on all axes."""
    seen, drawn = words["tabs"][tab], (await talk.answer("", tab))["pictures"]
    assert [one["name"] for one in seen["pictures"]] == list(drawn)
    for one in seen["pictures"]:
        data = drawn[one["name"]]
        assert data["text"].endswith(".")
        logs = "".join(one["logs"]).lower()
        for theme, log in (("light", ""), ("dark", logs), ("light", logs)):
            status, text = await server.got(f"figures/{theme}/{one['name']}.json?log={log}")
            assert status == 200
            figure = json.loads(text)
            models = list(Document.from_json(figure["item"]["doc"]).models)
            found = {model.name: model.data.keys() for model in models if isinstance(model, ColumnDataSource)}
            for source, columns in data["sources"].items():
                assert found[source] == columns.keys(), (one["name"], source)
            assert data["props"].keys() <= {model.name for model in models}
            # A map explains itself by its colour bar.
            assert figure["legend"] or any(isinstance(model, ColorBar) for model in models)


async def test_last_of_several_questions_is_answered(talk: Talk) -> None:
    for i in range(100):
        last = await talk.say("answer", link=link(magnitude=f"{7 + i / 100}"), tab="detection")
    answered, reported = 0, {"n": 0}
    while reported["n"] != last or "pictures" not in reported:
        reported = await asyncio.wait_for(talk.next(), 60)
        answered += "answer" in reported
    assert answered < 50, "others have become pointless"


DETECTIONS = tomllib.loads((DATA / "detections.toml").read_text(encoding="utf-8"))["detection"]
TARGETS = ("eps Eri", "GJ 205", "YZ CMi", "AD Leo")


def on_the_command_line(folder: Path, *words: str) -> dict[str, Any]:
    return dict(json.loads(run(*words, "--no-pictures", "--json", folder=folder).stdout))


async def test_chances_are_those_of_the_command_line(talk: Talk, tmp_path: Path) -> None:
    """Both chances of ten flares, by the closed form; the page says them in the words of the command line."""
    for row in DETECTIONS:
        star, magnitude, percent, exposure = row["flare"]
        entered = {"star": star, "magnitude": magnitude, "amplitude_percent": percent, "exposure_s": exposure}
        said = (await talk.answer(link(**entered, fap="0.1", **row.get("fields", {}))))["answer"]
        words = ["detect", "--star", star, "-m", magnitude, "-a", f"{percent}%", "-t", exposure, "-n", "2000"]
        answer = on_the_command_line(tmp_path, *words, "--fap", "0.1", *row.get("flags", ()))
        same = re.sub(r"(?<=a chance of ).* % \(.*; ", f"{said['shown']} (", answer["headline"])
        assert said["headline"] == f"{same[:-1]}, by the estimate before a simulation."
        (theirs,) = answer["rows"]
        chances = [theirs["closed_form_probability"], theirs["ideal"]]
        assert chances == pytest.approx([one["value"] for one in said["numbers"]], rel=1e-9), star


@pytest.mark.long
async def test_plans_are_those_of_the_command_line(talk: Talk, tmp_path: Path) -> None:
    """Headline, flares, their ideal number and the energy that half of them have, of four targets: twelve numbers."""
    asked = link(targets="\n".join(TARGETS), hours="100", start="2027-01-01", days="30")
    assert (await talk.simulate("plan", asked)).startswith("Done")
    drawn = await talk.answer(asked, "plan")
    command = (await talk.exported(f"{asked}&temperature_c=21", "plan"))["plan"]["command"]
    assert "--temperature 21" in command, "what is entered is no default"
    page = await talk.table(asked, "plan", "plan")
    (tmp_path / "targets.csv").write_text("\n".join(["name", *TARGETS]) + "\n")
    words = ("plan", "targets.csv", "--hours", "100", "--start", "2027-01-01", "--days", "30")
    answer = on_the_command_line(tmp_path, *words)
    assert answer["headline"] == drawn["answer"]["headline"], "in the same words"
    assert "detector temperature along the orbit" in answer["assumed"]
    for name in ("expected", "ideal", "E50"):
        assert [row[name] for row in answer["rows"]] == pytest.approx(page[name].tolist(), rel=1e-9), name
    # The picture's flares above the smallest energy are all that are expected, by a sum over fewer energies.
    found = [column(drawn, "expected", f"found {k}", "y")[0] for k in range(len(TARGETS))]
    assert found == pytest.approx([row["expected"] for row in answer["rows"]], rel=5e-3)
    # Another lies outside the declinations that are observed, and its plan has no energies to draw.
    await talk.simulate("plan", hidden := link(targets="Proxima Cen"))
    assert "Proxima Cen is never seen" in (await talk.answer(hidden, "plan"))["pictures"]["expected"]["text"]
    refused = await talk.ask("simulate", "ended", kind="plan", link=link(targets="12 34", hours="50"))
    assert (refused["ended"], "spectral" in refused["refused"]) == ("", True), "a plan needs what is known of a target"
