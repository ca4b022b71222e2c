"""Numbers of the public Python interface, compared with those that an earlier version gave.

Each function below asks some classes and functions of `mauvecl` and returns what they answer. Where a change is
intended, `python tests/test_golden_python.py NAME ...` writes the named answers again, and the commit says why they
differ.
"""

import hashlib
import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run
from golden_inputs import DATA, write_inputs
from scenes import BANDS, MG_II, NEAR, Components, instrument, paper, source, star

import mauvecl
from mauvecl import BalmerFlare, EnergyScale, Engine, Event, FlareModel, Nuisances, Sky, Source, expect, fit
from mauvecl.observations import visits

GOLDEN = Path(__file__).parent / "data" / "golden" / "python"
# Of longer arrays evenly spaced values are kept.
MAX_VALUES = 40
# As in `test_golden.py`: relative tolerance of what is computed, and of what an iteration finds.
TOLERANCE, ITERATIVE = 1e-9, 1e-7
# Ends of profile intervals, where an iteration stops.
INTERVALS = 1e-3

Answer = dict[str, Any]
ANSWERS: dict[str, Callable[[Path], Answer]] = {}
# Answers that an iteration finds.
ITERATED = ("fits", "fits_in_time", "answers_in_python")


def golden(function: Callable[[Path], Answer]) -> Callable[[Path], Answer]:
    ANSWERS[function.__name__] = function
    return function


def plain(value: Any) -> Any:
    """Return a value as JSON holds it; whole arrays of integers from the device by their digest."""
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, tuple | list) and not all(np.isscalar(one) for one in value):
        return [plain(one) for one in value]
    if isinstance(value, str | bool | int | None):
        return value
    array = np.ma.filled(np.ma.asarray(getattr(value, "value", value)), np.nan)
    if array.dtype.kind in "OSU":
        return [str(one) for one in array.ravel()[:MAX_VALUES]]
    if array.dtype.kind in "iub" and array.size > MAX_VALUES:
        return hashlib.sha256(np.ascontiguousarray(array, "<i8").tobytes()).hexdigest()
    values = array.ravel()[:: max(1, array.size // MAX_VALUES)].tolist()
    return values[0] if array.ndim == 0 else values


def table(of: Any) -> Answer:
    return {name: of[name] for name in of.colnames}


def parts(of: Any, *names: str) -> Answer:
    return {name: getattr(of, name) for name in names}


def assert_same(ours: Any, theirs: Any, tolerance: float, where: str = "") -> None:
    """Compare numbers to a relative tolerance, all else exactly."""
    if isinstance(theirs, list) and not all(isinstance(one, int | float) for one in theirs):
        ours, theirs = dict(enumerate(ours)), dict(enumerate(theirs))
    if isinstance(theirs, dict):
        assert list(ours) == list(theirs), where
        for key, one in theirs.items():
            assert_same(ours[key], one, tolerance, f"{where}/{key}")
    elif np.asarray(theirs).dtype.kind == "f":
        end = tolerance > TOLERANCE and where.rpartition("/")[2].startswith(("low", "high"))
        np.testing.assert_allclose(ours, theirs, rtol=INTERVALS if end else tolerance, atol=1e-300, err_msg=where)
    else:
        assert ours == theirs, where


NM, SEEN_NM = np.linspace(150.0, 1100.0, 39), np.linspace(200.0, 700.0, 26)
#: A small telescope that sees 198 pixels, and a star with a flare.
QUICK = instrument(part=True)


@golden
def sources(folder: Path) -> Answer:
    star, sun = source(), Source.from_library("Sun")
    vb8 = Source.read(DATA / "spectra" / "vb8_stiswfcnic_004.fits")
    mine = Source.from_arrays(NM, 1e-13 * (NM / 500) ** -2, name="slope")
    both = {"added": star.flaring(0.5, 9000.0), "replaces": star.flaring(0.01, 9000.0, geometry="replaces")}
    found: Answer = {name: one.flux_flam for name, one in both.items()}
    found |= {"binned": star.binned(20.0).flux_flam, "reddened": star.reddened(0.3).flux_flam}
    found["dusty"] = star.reddened(0.3, rv=5.0).flux_flam
    halves = mauvecl.TwoBlackbodies(9000.0, 9000.0, 1.0)
    for name, light in {"halves": halves, "lines": mauvecl.FlareWithLines(halves)}.items():
        found[name] = star.flaring(0.01, spectrum=light, geometry="replaces", photosphere_temperature=3400).flux_flam
    cut = slice(*np.searchsorted(sun.wavelength_nm, [250.0, 650.0]))
    short = Source.from_arrays(sun.wavelength_nm[cut], 1e-3 * sun.flux_flam[cut], name="cut", extend="G2V")
    found["extended"] = short.flux_flam
    found["every band"] = {band: sun.magnitude(band) for band in sorted(BANDS)}
    bands = ("B", "V", "Kepler", "TESS", "Gaia G", "GALEX NUV")
    for name, one in {"M3V": star, "Sun": sun, "VB8": vb8, "slope": mine}.items():
        found[name] = {band: one.magnitude(band) for band in (bands if name != "VB8" else bands[:-1])}
    found["ab"] = [star.magnitude("V", system) for system in ("catalogue", "vega", "ab")]
    return found


@golden
def library(folder: Path) -> Answer:
    """Return mean fluxes of every star of the library and of formulas, temperatures and what is said of them."""
    names = [one["name"] for one in json.loads(run("library", "--json", folder=folder).stdout)]
    stars = {name: Source.from_library(name) for name in (*names, "Blackbody 5772 k", "power-law -4.0")}
    about = {name: [one.temperature_k, bool(one.unscaled), *one.messages] for name, one in stars.items()}
    return {name: one.binned(50.0).flux_flam for name, one in stars.items()} | {"about": about}


@golden
def flare_spectra(folder: Path) -> Answer:
    models = {
        "blackbody": mauvecl.Blackbody(10_000.0), "balmer": BalmerFlare(9000.0, 2.5),
        "cool": BalmerFlare(9500.0, 2.5, 8000.0),
        "two": mauvecl.TwoBlackbodies(9000.0, 25_000.0, 0.1),
        "lines": mauvecl.FlareWithLines(BalmerFlare(9000.0, 2.0), {"Mg II": 0.05, "H alpha": 0.02}),
        "coarse": mauvecl.ObservedFlare.from_arrays([150.0, 300.0, 500.0], [1.0, 2.0, 3.0], continue_at_k=8000.0),
        "observed": mauvecl.ObservedFlare.read(
            DATA / "flares" / "ADLeo_1497s.dat", DATA / "flares" / "adleo_quiescent2.dat", wavelength_unit="Angstrom",
            continue_at_k=9500.0,
        ),
    }  # fmt: skip
    found: Answer = {}
    for name, one in models.items():
        lit = {band: source().flaring(0.3, spectrum=one, band=band).flux_flam for band in ("Kepler", "GALEX NUV")}
        scales = (EnergyScale.of_star(source(), 5.0, flare=one, kind=kind) for kind in ("band", "bolometric"))
        found[name] = {"flux": one.flux(NM), "total": one.bolometric_flux(), "grid": one.grid(NM), "lit": lit,
                       "erg_per_s": [scale.erg_per_s for scale in scales]}  # fmt: skip
    fixed = mauvecl.FlareWithLines(mauvecl.Blackbody(9000.0), {"Mg II": 0.05}, {"H beta": 2e-13})
    found["fixed"] = {"flux": fixed.flux_at_telescope(fixed.grid(NM)), "fixed": fixed.fixed_lines}
    found["coarse"] |= {"measured": models["coarse"].measured_nm, "said": models["coarse"].messages}
    # Grids have points around each line.
    names = ("H alpha", "H beta", "H gamma", "H delta", "H epsilon", "H8", "Ca II", "Mg II")
    return found | {name: mauvecl.FlareWithLines(models["blackbody"], {name: 0.1}).grid(NM) for name in names}


@golden
def flares_in_time(folder: Path) -> Answer:
    edges = np.column_stack([np.arange(-100.0, 400.0, 20.0), np.arange(-80.0, 420.0, 20.0)])
    own = mauvecl.TableShape((-1.0, 0.0, 1.0, 4.0), (0.0, 1.0, 0.4, 0.0), "own")
    found: Answer = {name: one.mean_over(edges, 50.0, 30.0) for name, one in {**mauvecl.SHAPES, "own": own}.items()}
    scales = {
        "star": EnergyScale.of_star(source(), 5.0), "disc": EnergyScale.of_blackbody(0.4, 3300.0, band="TESS"),
        "shibayama": EnergyScale.shibayama2013(1.0, 5778.0),
    }  # fmt: skip
    for name, scale in scales.items():
        found[name] = {"erg": scale.energy(100.0), "s": scale.equivalent_duration(1e33)}
    event = Event.of_energy(1e33, scales["star"], peak_s=600.0, half_width_s=60.0)
    found["event"] = [event.amplitude, event.equivalent_duration_s, event.peak, event.energy(scales["star"])]
    found["of duration"] = Event.of_equivalent_duration(50.0, peak_s=600.0, half_width_s=60.0).amplitude
    found["of peak"] = Event.of_peak(0.7, peak_s=600.0, half_width_s=60.0, shape="tovarmendoza2022").amplitude
    found["cooling"] = mauvecl.Cooling(15_000.0, 7000.0, 80.0).at(np.linspace(-50, 500, 12))
    found["sinusoid"] = mauvecl.Sinusoid(0.5, 3000.0, 1.0).mean_over(np.arange(0.0, 6000.0, 500.0), 5.0)
    return found


@golden
def instruments(folder: Path) -> Answer:
    found: Answer = {}
    for name in ("mauvesim", "mauve"):
        one = mauvecl.Instrument.load(name)
        found[name] = {
            "throughput": one.throughput(SEEN_NM), "efficiency": one.efficiency(SEEN_NM),
            "area": one.effective_area_cm2(SEEN_NM), "per joule": one.electrons_per_joule_cm2(SEEN_NM),
            "quantum": one.quantum_efficiency(SEEN_NM),
            "numbers": [one.dark_dn_per_s, one.gain_dn_per_electron, one.saturation_dn, one.field_of_view_arcsec2],
            "warm": one.with_(temperature_c=10.0).dark_dn_per_s,
            "aimed": one.with_(pointing_loss=0.05).efficiency(300.0),
        }  # fmt: skip
    drawn = mauvecl.PixelMap.made_up(1643, seed=5, hot_share=0.01)
    drawn.write(folder / "map.ecsv")
    read = mauvecl.PixelMap.read(folder / "map.ecsv").response
    found["map"] = {"response": drawn.response, "dark": drawn.dark, "read": read, "mean": drawn.dark.mean()}
    return found


@golden
def skies(folder: Path) -> Answer:
    at = Sky.at("eps Eri", "2027-01-05T00:00:00")
    found: Answer = {"none": Sky.none().spectrum(6000.0)}
    for name, one in {"bright": Sky.of_brightness(21.0), "at": at}.items():
        flux = one.spectrum(6000.0).binned(20.0).flux_flam
        found[name] = {"brightness": one.surface_brightness, "flux": flux, "V": one.total_magnitude(6000.0)}
    return found


@golden
def expectations(folder: Path) -> Answer:
    """Return means, variances and S/N in both orders, with neighbours, in electrons, and near saturation."""
    n = np.arange(2048)
    uneven = mauvecl.PixelMap(
        response=n % 64 / 64, dark=1 + n / 1024, gain=1 - n / 8192, bias_dn=500.0 + n, read_noise_dn=10 + n / 500
    )
    cases = {
        "paper": star(), "physical": [expect(source(), instrument(), exposure=300.0, order="physical")],
        "electrons": star("K5V", 8.0, amplitudes=(0.1,), payload=instrument("mauve")),
        "neighbours": star(neighbours=NEAR), "bright": star("A0V", 1.0, exposure=5.0),
        "uneven": star(payload=instrument(pixel_map=uneven)),
    }  # fmt: skip
    found: Answer = {}
    for name, all_of in cases.items():
        one = all_of[-1]
        found[name] = {
            "signal": one.signal_dn, "variance": one.variance_dn2, "snr": one.snr(), "element": one.snr_per_element(),
            "numbers": [one.exposure_s, one.highest_dn, one.longest_safe_frame_s, one.target_share, one.ceiling_dn],
            "budget": table(one.noise_budget()), "raw": one.mean_raw_dn,
        }  # fmt: skip
    return found


@golden
def draws(folder: Path) -> Answer:
    """Return digests of drawn exposures, and statistics realisation by realisation, of which all bits are promised.

    `test_engine.py` has those of the self-test.
    """
    engine = Engine()
    quiet, flare = star(amplitudes=(0.1,), payload=QUICK)
    rays = mauvecl.Processes(cosmic_rays=mauvecl.CosmicRays(rate_per_cm2_s=300.0), jitter=mauvecl.Uniform(0.0, 0.05))
    raw, clipped = engine.realise_and_count(quiet, count=20, seed=3, start=2**32 - 10)
    names = ("chi2", "chi2_pair", "matched", "paper")
    values = engine.statistic_values(
        quiet, [flare], count=20, seed=4, statistics=names, comparison=mauvecl.Comparison(3)
    )
    one, lit = (replace(x, n_frames=1) for x in (quiet, flare))
    parts = Components.of(one, [lit], np.ones((1, one.wavelength_nm.size)))
    frames = mauvecl.Stares().frames(parts, mauvecl.Stare.of(30.0), count=2, seed=9)
    return {
        "raw": raw, "clipped": clipped, "rays": engine.realise(flare, count=20, seed=5, processes=rays),
        "pool": mauvecl.Pool().realise(quiet, count=20, seed=3, start=2**32 - 10),
        "snr": table(engine.snr(quiet, realisations=1000, seed=6).element), "values": values.view(np.uint32),
        "stare": frames.astype(np.int64),
    }  # fmt: skip


@golden
def detections(folder: Path) -> Answer:
    quiet, *flares = star(amplitudes=(0.02, 0.1), payload=QUICK)
    line = mauvecl.Linear("line", np.exp(-0.5 * ((quiet.wavelength_nm - 320.0) / 5.0) ** 2))
    unknown = Nuisances.of(quiet, {"dark": 0.1, "light": 0.02})
    found: Answer = {}
    for name, how in {"known": {}, "unknown": {"nuisances": unknown}}.items():
        one = Engine().detect(
            quiet, flares, statistics=("matched", "chi2_element", "uv_excess", line), realisations=4000, seed=1, **how
        )
        form = one.closed_form("matched", 0)
        found[name] = {
            "table": table(one.table(0.05)), "weights": one.weights("line"),
            "quantile": asdict(one.quantile(0.3, "matched", 1)), "area": asdict(one.roc("chi2_element", 1).area),
            "departures": [[row.threshold, row.simulated.value] for row in mauvecl.departures(one, 0.05)],
            "false alarms": asdict(one.false_alarm_probability(3.0, "matched")),
            "histogram": one.histogram("matched", 0, bins=12),
            "closed": [form.mean, form.std, form.sf(form.mean + form.std)],
            "dof": one.dof("chi2_element"),
        }  # fmt: skip
    return found


@golden
def priors(folder: Path) -> Answer:
    share = np.linspace(0.01, 0.99, 9)
    quiet = star(payload=QUICK)[0]
    unknown = Nuisances.of(quiet, {"dark": 0.1, "sky": np.inf, "tilt": 0.01})
    rays = mauvecl.CosmicRays(rate_per_cm2_s=5.0)
    return {
        "normal": mauvecl.Normal(0.1, 0.05, 0.0, 0.3).quantile(share),
        "uniform": mauvecl.Uniform(0.1, 0.4).quantile(share),
        "spectra": unknown.spectra, "sd": unknown.sd, "rows": unknown.rows(quiet.variance_dn2, unknown.spectra),
        "rays": [rays.most_electrons(50.0), *np.ravel(rays.variance_dn2(quiet))[:1]],
    }  # fmt: skip


@golden
def fits(folder: Path) -> Answer:
    """Return fits of a flare of 9800 K and an amplitude of 0.5, and their errors in advance."""
    dwarf, mauve = source(), instrument()
    quiet, flare = (expect(s, mauve, exposure=50.0) for s in (dwarf, dwarf.flaring(0.5, 9800.0)))
    unknown = Nuisances.of(quiet, {"dark": np.inf, "light": np.inf})
    model = FlareModel.of(dwarf, mauve, quiet, distance_pc=5.0, radius_rsun=0.4)
    frames = Engine().realise(flare, count=3, seed=1)
    ahead = mauvecl.forecast(quiet, model, 9800.0, [0.5], unknown)
    found: Answer = {"names": list(ahead.names), "errors": ahead.errors}
    fitted = {
        "known": fit(frames, quiet, model), "unknown": fit(frames, quiet, model, unknown),
        "jump": fit(frames, quiet, FlareModel.of(dwarf, mauve, quiet, jump=True), skipped_nm=[(322, 368)]),
        "two": mauvecl.fit_two_temperatures(frames[:1], quiet, FlareModel.of(dwarf, mauve, quiet, distance_pc=5.0)),
    }  # fmt: skip
    for name, one in fitted.items():
        found[name] = parts(one, "estimates", "errors", "low", "high", "chi2", "p_value")
    return found


@golden
def fits_in_time(folder: Path) -> Answer:
    """Return fits along twelve frames, of which four hold a flare."""
    dwarf, mauve = source(), instrument()
    quiet, flare = (expect(s, mauve, exposure=5.0) for s in (dwarf, dwarf.flaring(2.0, 9800.0)))
    frames = np.vstack([Engine().realise(x, count=4, seed=2) for x in (quiet, flare, quiet)])
    model = FlareModel.of(dwarf, mauve, quiet, distance_pc=5.0)
    along = mauvecl.measure_along(frames, quiet, model, snr_per_bin=40.0).table()
    whole = mauvecl.fit_cooling(frames, quiet, model, peak_s=25.0, half_width_s=10.0, levels=()).table()
    return {"along": table(along), "whole": table(whole)}


@golden
def frames_of_files(folder: Path) -> Answer:
    write_inputs(folder, "flares.csv curve.toml counts.csv ct.toml")
    named = {
        "plain": ("light_curves/lightkurve_plain.ecsv.xz", None),
        "gj65": ("flares/gj65_galex_nuv_5s.csv", "flares/gj65.toml"),
        "rotating": ("cases/rotating-star/slow-30min.fits", None),
    }  # fmt: skip
    read = {name: mauvecl.read_frames(DATA / file, about and DATA / about) for name, (file, about) in named.items()}
    read["drawn"] = mauvecl.read_frames(folder / "flares.csv", folder / "curve.toml")
    return {
        name: {"time": one.time_s, "flux": one.flux, "error": one.error, "cadence": one.cadence_s,
               "faults": one.faults, "mjd": one.reference_mjd,
               "shifted": one.shifted(np.full(one.n_frames, 10.0)).time_s[:3]}
        for name, one in read.items()
    }  # fmt: skip


@golden
def answers_in_python(folder: Path) -> Answer:
    """Return answers that are not verbs of the command line."""
    asked = paper('star=[{library="M3V", magnitude=9}]', "flare.amplitudes=[0.01]", "run.realisations=10000",
                  "run.fap=0.01", 'run.statistics=["matched"]')  # fmt: skip
    engine = Engine()
    return {
        "exposure": table(mauvecl.shortest_exposure(asked, engine).table),
        "amplitude": table(mauvecl.smallest_amplitude(asked, engine).table),
        "exposure for": table(mauvecl.exposure_for(asked, 5.0, 450.0).table),
        "matters": table(mauvecl.what_matters(asked)),
    }  # fmt: skip


@golden
def lines_and_periods(folder: Path) -> Answer:
    found: Answer = {}
    for path in sorted((DATA / "flares" / "aumic_iue").glob("lp*.txt"))[:4]:
        angstrom, flux, error = np.loadtxt(path, skiprows=19, usecols=(0, 1, 2)).T
        one = visits.line_index(angstrom / 10, 10 * flux, 10 * error, **MG_II)
        found[path.stem] = [one.flux, one.error]
    time_d = np.sort(np.random.Generator(np.random.PCG64(1)).uniform(0, 60, 30))
    periods = visits.recover_periods(time_d, np.array([2.0, 10.0]), np.array([1.0, 3.0]), fap=0.05)
    recovered = [[cell.value for cell in row] for row in periods.recovered]
    return found | {"periods": {"threshold": periods.threshold, "recovered": recovered}}


@pytest.mark.parametrize("name", ANSWERS)
def test_python_answers_are_unchanged(name: str, tmp_path: Path) -> None:
    theirs = json.loads((GOLDEN / f"{name}.json").read_text(encoding="utf-8"))
    ours = json.loads(json.dumps(plain(ANSWERS[name](tmp_path))))
    assert_same(ours, theirs, ITERATIVE if name in ITERATED else TOLERANCE)


if __name__ == "__main__":
    GOLDEN.mkdir(exist_ok=True)
    for asked_name in sys.argv[1:] or ANSWERS:
        with tempfile.TemporaryDirectory() as temporary:
            given = plain(ANSWERS[asked_name](Path(temporary)))
        # A line for each key.
        lines = ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in given.items())
        (GOLDEN / f"{asked_name}.json").write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")
