"""Values as people write them: with units, in per cent, without a star, and with few realisations."""

from pathlib import Path

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


def test_flags_take_units(tmp_path: Path) -> None:
    words = ("-s", "M3V", "-m", "9 mag", "-t", "10min", "-a", "24%,2 %", "--flare-temperature", "9000 K")
    run("simulate", *words, "--sky", "22 mag/arcsec2", "--no-pictures", folder=tmp_path)
    study = Study.read(tmp_path / "mauvecl-simulate" / "study.toml")
    assert (study.star[0].magnitude, study.observation.exposure_s, study.flare.temperature_k) == (9.0, 600.0, 9000.0)
    assert (study.flare.amplitudes, study.sky.surface_brightness) == (pytest.approx((0.24, 0.02)), 22.0)


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
