"""Values as people write them: with units, in per cent, without a star, and with few realisations."""

import shlex
from functools import reduce
from pathlib import Path
from typing import Any

import pytest
from astropy.table import Table
from commands import ended, run
from refusals import refused

from mauvecl import Study


def test_lists_of_a_study_have_units() -> None:
    assert Study.of(amplitude=["24 %", "3%", 0.5]).flare.amplitudes == pytest.approx((0.24, 0.03, 0.5))
    energies = ["1e33 erg", "1e26J", "1e33", "+1.0E+33erg"]
    assert Study.of(energy=energies).stare.energies_erg == pytest.approx((1e33,) * 4)
    axis = {"quantity": "exposure", "values": ["1 min", 5, "2h"]}
    assert Study.of(sweep=[axis]).sweep.axes[0].points() == (60.0, 5.0, 7200.0)


#: Flags of a simulation, and the values that they set.
FLAGS: dict[str, dict[str, Any]] = {
    "-s M3V -m '9 mag' -t 10min --flare-temperature '9000 K' --sky '22 mag/arcsec2'":
        {"star.0.magnitude": 9.0, "observation.exposure_s": 600.0, "flare.temperature_k": 9000.0,
         "sky.surface_brightness": 22.0},
    "-s M3V -m 9 -a '24%,2 %'": {"flare.amplitudes": pytest.approx((0.24, 0.02))},
    "-s M3V -m 9 --balmer-jump 2.5 --line 'Mg II=0.03' --line '280.5 = 0.01' --line-flux 'H beta=1e-13'":
        {"flare.spectrum.balmer_jump": 2.5, "flare.spectrum.lines": {"Mg II": 0.03, "280.5": 0.01},
         "flare.spectrum.line_fluxes": {"H beta": 1e-13}},
    "-s G2V,M3V -m 7,8 --seed=2.5e3": {"run.seed": 2500, "star.1.library": "M3V", "star.1.magnitude": 8.0},
    "-s G2V -m 7 '--seed= 7000 '": {"run.seed": 7000},
    "-s G2V -m 7 --seed=9007199254740993": {"run.seed": 2**53 + 1},
}  # fmt: skip


@pytest.mark.parametrize("words", FLAGS)
def test_flags_set_keys(words: str, tmp_path: Path) -> None:
    run("simulate", *shlex.split(words), "--no-pictures", folder=tmp_path)
    study: Any = Study.read(tmp_path / "mauvecl-simulate" / "study.toml").model_dump()
    for key, value in FLAGS[words].items():
        assert reduce(lambda part, name: part[int(name) if name.isdigit() else name], key.split("."), study) == value


def test_amplitudes_like_percentages_have_a_note(tmp_path: Path) -> None:
    words = ("simulate", "-s", "M3V", "-m", "9", "--no-pictures", "-a")
    noted = run(*words, "24", folder=tmp_path).stderr
    assert "--amplitude 24 is a rise of 2400 %" in noted
    assert "--amplitude 24% is one of 24 %\n" in noted
    assert Study.read(tmp_path / "mauvecl-simulate" / "study.toml").flare.amplitudes == (24.0,)
    for text in ("0.24", "2400%"):
        assert "is a rise" not in run(*words, text, folder=tmp_path).stderr


@pytest.mark.long
def test_few_realisations_sample_the_tails(tmp_path: Path) -> None:
    words = ("detect", "-s", "M3V", "-m", "9", "-a", "3%", "-n", "1000", "--statistic", "matched", "--no-pictures")
    shown = run(*words, folder=tmp_path).stdout
    assert shown.startswith("Mauve would see")
    assert shown.count("importance sampling") == 1
    assert Study.read(tmp_path / "mauvecl-detect" / "study.toml").run.tails == "sampled"
    # The threshold is that of many realisations: 3.09 standard deviations of a normal.
    table = Table.read(tmp_path / "mauvecl-detect" / "detection.ecsv")
    assert table["threshold"][0] == pytest.approx(3.09, abs=0.03)


def test_several_wrong_values_are_reported_together(tmp_path: Path) -> None:
    code, _, reported = ended("detect", "-s", "M3V", "-m", "x", "-t", "10 m", "-a", "4z", folder=tmp_path)
    assert (code, reported.count("\n")) == (2, 1)
    assert [part.split()[0] for part in reported.removeprefix("mauvecl: ").split("; ")] == [
        "--magnitude", "--amplitude", "--exposure"
    ]  # fmt: skip
    code, _, reported = ended("detect", "-s", "M3V", "-m", "99", "-t", "30 h", "--fap", "2", folder=tmp_path)
    assert (code, reported.count("\n")) == (2, 1)
    parts = reported.removeprefix("mauvecl: ").split("; ")
    flags = [(part.split()[0], part.split()[-1]) for part in parts]
    assert flags == [("--magnitude", "99"), ("--exposure", "h'"), ("--fap", "2")]


def test_errors_of_a_study_name_each_key_once() -> None:
    stars = [{"library": "M3V", "magnitude": 99}, {"library": "G2V", "magnitude": "x"}]
    with refused("star.0.magnitude", "star.1.magnitude must be ", "not 'x'", "bulk.frames must be") as caught:
        Study.build({"star": stars, "bulk": {"frames": "some"}}, "test")
    assert len(caught.value.parts) == 3
    assert str(caught.value).count("test: ") == 1
    with refused("flare.amplitudes.0", "and 3 more values are wrong"):
        Study.build({"flare": {"amplitudes": [-1.0] * 8}}, "test")
