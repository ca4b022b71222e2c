"""Invalid studies raise an InputError that names the key of the study by its full path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from refusals import refused

from mauvecl.study.study import Study

LONG = "{{quantity='{}', start=10, stop=20, steps=900}}"
#: A setting, and the key that the error names.
SETTINGS = [
    ("star=[{}]", "star.0.library"),
    ('star=[{library="G2V", wavelength_unit="nm"}]', "star.0.wavelength_unit"),
    ("star.0.bin_nm=true", "star.0.bin_nm"),
    ("star.9.magnitude=3", "setting"),
    ("nothing=1", "nothing"),
    ("run", "setting"),
    ("run.nope=1", "run.nope"),
    ("run.fap.x=1", "setting"),
    ("flare.amplitudes=[true]", "flare.amplitudes"),
    ('flare.spectrum={file="x.txt", balmer_jump=2.0}', "flare.spectrum.file"),
    ('flare.spectrum={quiescent="x.txt"}', "flare.spectrum.quiescent"),
    ("flare.spectrum={second_area=0.1}", "flare.spectrum.second_area"),
    ("flare.spectrum={second_area=0.1, second_temperature_k=2e4, balmer_jump=2}", "flare.spectrum.balmer_jump"),
    ("flare.spectrum={balmer_jump=0.5}", "flare.spectrum.balmer_jump"),
    ("flare.spectrum={electron_temperature_k=1.0, balmer_jump=2.0}", "flare.spectrum.electron_temperature_k"),
    ('flare.spectrum={lines={"Mg II"=-0.1}}', "flare.spectrum.lines.Mg_II"),
    ('flare.spectrum={lines={"X"=0.1}}', "flare.spectrum.lines"),
    ('flare.spectrum={lines={"Mg II"=0.1}, line_fluxes={"Mg II"=1e-12}}', "flare.spectrum.lines"),
    ("sky={target='1 2'}", "sky.time"),
    ("sky={none=true, surface_brightness=22}", "sky.surface_brightness"),
    ("processes.jitter={}", "processes.jitter.uniform"),
    ("nuisances.dark=-1", "nuisances.dark"),
    ("nuisances.own.x={}", "nuisances.own.x.points"),
    ('nuisances.own.x={points=[[200, 1]], file="x.txt"}', "nuisances.own.x.points"),
    ("unknowns.draws=1", "unknowns.draws"),
    ('unknowns.known=["luck"]', "unknowns.known"),
    ("campaign.step=3", "campaign.step"),
    ("bulk.frames=[3, 1]", "bulk.frames"),
    ('map.x={quantity="magnitud"}', "map.x.quantity"),
    ('map.x={quantity="magnitude"}', "map.x.values"),
    ('map.x={quantity="magnitude", values=[]}', "map.x.values"),
    ('map.x={quantity="magnitude", values=[5.0], steps=3}', "map.x.values"),
    ('map.x={quantity="magnitude", values=["G2V"]}', "map.x.values"),
    ('map.x={quantity="star", values=[5.0]}', "map.x.values"),
    ('map.x={quantity="magnitude", start=1, stop=99, steps=3}', "map.x.values"),
    ('map.x={quantity="exposure", start=0, stop=9, steps=3, log=true}', "map.x.start"),
    ('map.x={quantity="amplitude", values=[0.1]}', "map.y"),
    ('sweep.axes=[{quantity="sky", values=[20]}, {quantity="sky", values=[21]}]', "sweep.axes"),
    ('sweep={how="list", axes=[{quantity="sky", values=[20]}, {quantity="exposure", values=[5, 50]}]}', "sweep.axes"),
    (f"sweep.axes=[{LONG.format('sky')}, {LONG.format('exposure')}]", "sweep.axes"),
    ('sweep.axes=[{quantity="colour", values=[1.0]}]', "sweep.axes.0.quantity"),
    ("search.half_widths_s=[20, 10]", "search.half_widths_s"),
    ("search.offset=false", "search.slope"),
    ("search.per=week", "search.per"),
    ("injections.low=-1", "injections.low"),
    ("injections={low=2.0, high=1.0}", "injections.low"),
    ("injections.high=1e50", "injections.high"),
    ("injections.half_width_low_s=1e4", "injections.half_width_low_s"),
    ("stare.duration_s=-3", "stare.duration_s"),
    ("stare.shape=gauss", "stare.shape"),
    ("stare.orbit_gap_s=6000", "stare.orbit_gap_s"),
    ("stare.bands_nm=[[300, 200]]", "stare.bands_nm"),
    ("stare.thermal.period_s=100", "stare.thermal.amplitude"),
    ("stare.thermal={points=[[0, 1], [1, 2]], phase=1}", "stare.thermal.amplitude"),
    ("events=[{peak_s=1, peak=1, amplitude=1}]", "events.0.amplitude"),
    ('events=[{peak_s=1, shape="box"}]', "events.0.shape"),
    ('events=[{peak_s=1, shape="fiducial", shape_file="x.txt"}]', "events.0.shape"),
    ("measure.bands_nm=[[300, 200]]", "measure.bands_nm"),
    ("measure.fits=0", "measure.fits"),
    ("orbit.limits.sun_deg=abc", "orbit.limits.sun_deg"),
    ("orbit.limits.sun_deg=400", "orbit.limits.sun_deg"),
    ('plan.targets=[{name="a", alpha=2}]', "plan.targets.0.alpha"),
    ('plan.targets=[{name="a", rates="K", mass_msun=1, age_myr=5}]', "plan.targets.0.rates"),
    ('plan.targets=[{name="a"}, {name="a"}]', "plan.targets"),
]


@pytest.mark.parametrize(("setting", "key"), SETTINGS)
def test_bad_settings_raise(setting: str, key: str) -> None:
    with refused(key):
        Study().with_settings([setting])


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("[run]\nsead = 3", "run.sead"),
        ("[[star]]\nlibrary = 'G2V'\nmagnitud = 3", "star.0.magnitud"),
        ("[run\nseed = 3", "file"),
        ("[run]\nfap = 2", "run.fap"),
        ("[flare]\namplitudes = []", "flare.amplitudes"),
        ("[[star]]\nmagnitude = 3", "star.0.library"),
        ("[observation]\nexposure_s = 'long'", "observation.exposure_s"),
        ("[processes]\njitter = { unform = [0, 1] }", "processes.jitter.unform"),
        ("[processes]\njitter = { normal = [0, 1] }", "processes.jitter.uniform"),
        ("[processes]\njitter = { uniform = [0.05, 0] }", "processes.jitter.low"),
        ("[processes.cosmic_rays]\nrate_per_cm2_s = -1", "processes.cosmic_rays.rate_per_cm2_s"),
    ],
)
def test_bad_study_files_raise(text: str, key: str, tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(text)
    with refused(key):
        Study.read(tmp_path / "study.toml")


@pytest.mark.parametrize("spread", [0, -1.0, True, "much", float("inf"), float("nan"), [1]])
@pytest.mark.parametrize(("key", "section"), [("dark", {}), ("own.x.sd", {"file": "x.txt"})])
def test_bad_standard_deviations_raise(spread: Any, key: str, section: dict[str, Any]) -> None:
    given = {"own": {"x": section | {"sd": spread}}} if section else {key: spread}
    with refused(f"nuisances.{key}"):
        Study.build({"nuisances": given}, "test")


def test_two_temperatures_of_a_photosphere_raise() -> None:
    with refused("flare.photosphere_temperature_k", value=5200.0):
        Study.build(
            {
                "star": [{"library": "G2V", "effective_temperature_k": 5000.0}],
                "flare": {"geometry": "replaces", "photosphere_temperature_k": 5200.0},
            },
            "test",
        )
