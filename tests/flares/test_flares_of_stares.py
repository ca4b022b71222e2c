"""Frames, gaps, unknowns and flares of a study's stare: light and stated energies are those of the flares' spectra."""

import io
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from astropy.time import Time
from marks import long_but
from refusals import refused
from scenes import paper, through
from scipy.integrate import quad

import mauvecl
from mauvecl import SHAPES, Cooling, EnergyScale, Instrument, Sinusoid, Sky, Source, Stare, Study, expect, stare

MAUVE = Instrument.load("mauvesim")
STARS = ("A0V", "A7V", "F5V", "G2V", "K1V", "K5V", "M0V", "M3V", "M5V", "Sun")
BANDS = ("Kepler", "TESS", "V", "B", "Gaia G", "Gaia BP", "GALEX NUV")
#: Ranges of wavelength of the columns of a light curve.
COLUMNS = {"mean_200_300": (200, 300), "mean_300_400": (300, 400), "mean_550_700": (550, 700)}


def drawn(events: list[dict[str, Any]], star: dict[str, Any] | None = None, **sections: Any) -> Any:
    frames = {"duration_s": 2000.0, "search": False} | sections.pop("stare", {})
    star = star or {"library": "M3V", "magnitude": 8.0, "distance_pc": 5.0}
    return stare(Study.build({"star": [star], "events": events, "stare": frames, **sections}, "test"))


def light_of(amplitude: float = 0.0, kelvin: float = 10_000.0) -> dict[str, float]:
    star = Source.from_library("M3V").at_magnitude(8.0)
    x = expect(star.flaring(amplitude, kelvin), MAUVE, exposure=5.0, sky=Sky.of_brightness(22.1))
    nm = x.wavelength_nm
    return {name: float(x.light_dn[(low <= nm) & (nm < high)].sum()) / 5.0 for name, (low, high) in COLUMNS.items()}


def excess(table: QTable, name: str) -> np.ndarray:
    return np.asarray(table[name].value - light_of()[name])


def course(table: QTable, event: dict[str, Any]) -> np.ndarray:
    edges = np.asarray(table["time"].value)[:, None] + [-2.5, 2.5]
    return SHAPES[event.get("shape", "davenport2014")].mean_over(edges, event["peak_s"], event["half_width_s"])


def test_light_of_the_frames_is_that_of_the_flares_and_gaps_have_none() -> None:
    """One flare has the same temperature from first to last; the last, which cools, is mixed from few temperatures."""
    events: list[dict[str, Any]] = [
        {"peak_s": 300.0, "half_width_s": 20.0, "amplitude": 0.2},
        {"peak_s": 420.0, "half_width_s": 60.0, "peak": 0.1, "temperature_k": 15_000.0, "shape": "tovarmendoza2022"},
        {"peak_s": 500.0, "half_width_s": 10.0, "amplitude": 0.3, "temperature_k": 10_000.0,
         "cooling": {"end_k": 10_000.0, "fold_s": 100.0}},
        {"peak_s": 1500.0, "half_width_s": 60.0, "amplitude": 0.5, "temperature_k": 14_000.0,
         "cooling": {"end_k": 6000.0, "fold_s": 120.0}},
    ]  # fmt: skip
    answer = drawn(events, stare={"gaps": [[450.0, 650.0]]})
    assert "flares of 10000 K or as events state, added" in answer.assumed
    table = answer.light_curve()
    assert len(table) == 400 - 40
    assert not ((table["time"].value > 450) & (table["time"].value < 650)).any()
    sizes = np.array([0.2, 0.1 / SHAPES["tovarmendoza2022"].peak, 0.3, 0.5])
    np.testing.assert_allclose(answer.events["amplitude"], sizes, rtol=1e-12)
    one, two, three, cooling = sizes[:, None] * [course(table, event) for event in events]
    early, since_s = table["time"].value < 1400, table["time"].value - 1500.0
    kelvin = Cooling(14_000.0, 6000.0, 120.0).at(since_s)
    for name in COLUMNS:
        cool, hot = (light_of(1.0, k)[name] - light_of()[name] for k in (10_000.0, 15_000.0))
        steady = (one + three) * cool + two * hot
        np.testing.assert_allclose(excess(table, name)[early], steady[early], rtol=1e-6, atol=1e-6 * cool)
        for k in np.flatnonzero(np.isin(since_s, [-22.5, 7.5, 52.5, 152.5])):
            light = light_of(float(cooling[k]), float(kelvin[k]))[name] - light_of()[name]
            # The mixture is up to 2 % too bright, and 6 % in the far ultraviolet.
            within = 0.06 if name == "mean_200_300" else 0.02
            assert excess(table, name)[k] - steady[k] == pytest.approx(light, rel=within)


def test_snr_of_a_flare_is_that_of_the_known_conditions() -> None:
    event = {"peak_s": 1000.0, "half_width_s": 60.0, "amplitude": 0.2}
    answer = drawn([event], stare={name: {"points": [[0, level], [2000, level]]} for name, level in
                                   (("throughput", -0.75), ("thermal", 5.0))})  # fmt: skip
    staring, rise = answer.stares[0].staring, 0.2 * course(answer.light_curve(), event)
    x = staring.quiet
    dark = x.dark_dn * np.exp(5.0 * x.conditions["dark_slope_per_c"])
    light = x.gain_dn_per_electron * 0.25 * (x.source_electrons + x.sky_electrons)
    variance = x.gain_dn_per_electron * light + x.dark_step_dn * dark + x.read_noise_dn**2 + 1 / 12
    flare = 0.25 * x.gain_dn_per_electron * staring.flare_electrons[0]
    assert answer.events["snr"][0] == pytest.approx(np.sqrt(np.sum(rise**2) * np.sum(flare**2 / variance)), rel=1e-9)


def random_event(rng: np.random.Generator) -> dict[str, Any]:
    """Return a flare of a given energy within a stare of a day, which cools in four cases of ten."""

    def spread(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    event: dict[str, Any] = {
        "peak_s": float(rng.uniform(5000, 20_000)), "half_width_s": spread(2, 600), "energy_erg": spread(1e28, 1e31),
        "energy": str(rng.choice(["bolometric", "band"])), "temperature_k": spread(7000, 30_000),
        "shape": str(rng.choice(["davenport2014", "tovarmendoza2022"])),
    }  # fmt: skip
    if rng.random() < 0.4:
        event["cooling"] = {"end_k": float(rng.uniform(5500, event["temperature_k"])), "fold_s": spread(2, 1000)}
    return event


@pytest.mark.parametrize("seed", long_but(range(12), 0))
def test_stated_energies_are_those_of_the_light(seed: int) -> None:
    """Integrate random flares over time and wavelength; few temperatures of one that cools change its energy by 3 %."""
    rng = np.random.default_rng(seed)
    events = [random_event(rng) for _ in range(rng.integers(1, 4))]
    band, library = str(rng.choice(BANDS)), str(rng.choice(STARS))
    star = {"library": library, "magnitude": float(rng.uniform(4, 10)), "distance_pc": float(rng.uniform(2, 100))}
    frames = {"duration_s": 30_000.0}
    answer = drawn(events, star, stare=frames, flare={"band": band}, sky={"none": True})
    source = Source.from_library(library).at_magnitude(star["magnitude"])
    nm, sphere = source.wavelength_nm, 4 * np.pi * (star["distance_pc"] * u.pc).to_value(u.cm) ** 2
    for given, row in zip(events, answer.events, strict=True):
        stated = {kind: row[f"energy_{kind}"].to_value("erg") for kind in ("band", "bolometric")}
        assert stated[given["energy"]] == pytest.approx(given["energy_erg"], rel=1e-9)
        # Steps of a fiftieth of a half-width, over which the temperature hardly changes.
        law, hot = given.get("cooling"), given["temperature_k"]
        since = given["half_width_s"] * (np.linspace(-2, 60, 3101) if law else np.array([-2.0, 60.0, 1e4]))
        light_s = SHAPES[given["shape"]].mean_over(since, 0.0, given["half_width_s"]) * np.diff(since)
        cooling = Cooling(hot, **law) if law else Cooling(hot, hot, 1.0)
        kelvin = cooling.at((since[1:] + since[:-1]) / 2)
        bins = np.linspace(kelvin.min(), kelvin.max(), 25) if law else kelvin[:1]
        drawn_erg, near = {"band": 0.0, "bolometric": 0.0}, int(np.searchsorted(nm, 500.0))
        for number, one in enumerate(bins.tolist()):
            seconds = row["amplitude"] * light_s[np.abs(kelvin[:, None] - bins).argmin(axis=1) == number].sum()
            light = source.flaring(1.0, one, band=band).flux_flam - source.flux_flam
            drawn_erg["band"] += seconds * sphere * through(band, nm, light)
            # The light beyond the spectrum is that of the blackbody, by the law of Stefan and Boltzmann.
            share = float(light[near] / mauvecl.Blackbody(one).flux(nm[[near]])[0])
            drawn_erg["bolometric"] += seconds * sphere * share * 5.670374419e-5 * one**4
        assert stated == pytest.approx(drawn_erg, rel=0.03 if law else 5e-4)


@pytest.mark.parametrize("seed", range(10))
def test_replacing_flare_carries_the_energy_it_adds(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    name, star_k, flare_k = str(rng.choice(BANDS)), float(rng.uniform(3000, 9000)), float(rng.uniform(9500, 30_000))
    nm, small = np.geomspace(20, 300_000, 60_001), 1e-4
    source = Source.from_arrays(nm, 1e-19 * mauvecl.Blackbody(star_k).flux(nm))
    how: Any = {"band": name, "geometry": "replaces"}
    flaring = source.flaring(small, flare_k, photosphere_temperature=star_k, **how)
    light = (flaring.flux_flam - source.flux_flam) / small
    sphere = 4 * np.pi * (10 * u.pc).to_value(u.cm) ** 2
    for kind, given in (("band", through(name, nm, light)), ("bolometric", 10 * np.trapezoid(light, nm))):
        scale = EnergyScale.of_star(source, 10.0, flare_k=flare_k, photosphere_k=star_k, kind=kind, **how)
        assert scale.erg_per_s == pytest.approx(sphere * given, rel=5e-4)


@pytest.mark.parametrize("shape", SHAPES)
def test_flares_outside_of_the_frames_are_refused_or_reported(shape: str) -> None:
    """Flares before the frames, in a gap, and within the frames; one of which no light is left is refused."""
    frames = {"duration_s": 1500.0, "gaps": [[600.0, 1000.0]]}
    peak_light = light_of(0.5)["mean_300_400"] - light_of()["mean_300_400"]
    event = {"half_width_s": 40.0, "amplitude": 0.5, "shape": shape}
    for peak, outside in ((-60.0, True), (10.0, False), (590.0, False), (700.0, True), (1010.0, False)):
        answer = drawn([event | {"peak_s": peak}], stare=frames)
        assert any(f"peaks at {peak:g} s, outside the frames" in line for line in answer.messages) == outside
        table = answer.light_curve()
        light = excess(table, "mean_300_400") / peak_light
        np.testing.assert_allclose(light, course(table, event | {"peak_s": peak}), rtol=1e-6, atol=1e-9)
    for peak in (-19_000.0, 1600.0):
        with refused("peak_s", f"{peak:g} s"):
            drawn([event | {"peak_s": peak}], stare=frames)


def points(*values):
    return Study.build({"stare": {"variability": {"points": values}}}, "test").stare.variability


def test_frames_skip_gaps():
    stare = Stare.of(5998, gaps=[(1000, 2000), (3001, 3004.9)])
    assert stare.n_frames == 1200 - 200 - 1
    assert stare.duration_s == 6000.0
    assert stare.observed_s == 5 * stare.n_frames
    np.testing.assert_array_equal(stare.gtis, [[0, 1000], [2000, 3000], [3005, 6000]])
    np.testing.assert_array_equal(stare.numbers * 5.0, stare.start_s)
    assert not stare.start_s.flags.writeable


@pytest.mark.parametrize("curve", [Sinusoid(0.3, 400.0, 1.0), points((20, 1.0), (33, -2.0), (36, 5.0), (90, 0.5))])
def test_curves_are_averaged_over_frames(curve):
    def at(t):
        if isinstance(curve, Sinusoid):
            return curve.amplitude * np.sin(2 * np.pi * t / curve.period_s + curve.phase)
        return np.interp(t, *zip(*curve.points, strict=True))

    start = np.arange(0.0, 120.0, 5.0)
    exact = [quad(at, t, t + 5.0, points=[20.0, 33.0, 36.0, 90.0])[0] / 5.0 for t in start]
    np.testing.assert_allclose(curve.mean_over(start, 5.0), exact, atol=1e-12)


def test_orbits_and_priors_of_exposures_are_those_of_frames():
    """A normal prior is an offset of its relative standard deviation about its mean, in quadrature with the stare's."""
    asked = paper("stare.search=false", "stare.duration_s=250", "stare.orbit_s=100", "stare.orbit_gap_s=30",
                  "stare.gaps=[[0, 10]]", "stare.offsets.temperature=0.4",
                  "processes.light_loss={normal=[0.4, 0.03], between=[0.1, 0.7]}",
                  "processes.detector_temperature={normal=[20, 0.3], between=[15, 25]}")  # fmt: skip
    found = stare(asked).stares[0].staring.stare
    np.testing.assert_allclose(found.gtis, [[10, 70], [100, 170], [200, 250]])
    np.testing.assert_allclose(found.light, 0.6 / (1 - MAUVE.light_loss))
    np.testing.assert_allclose(found.temperature_c, 20.0)
    sds = {unknown.name: unknown.sd for unknown in found.unknowns}
    assert sds == pytest.approx({"light offset": 0.05, "temperature offset": 0.5})


def test_known_conditions_and_unknowns_are_separate():
    stare = Stare.of(
        Study().stare.orbit_s, thermal=0.5, temperature_c=13.0, variability=points((0.0, 0.0), (6000.0, 0.06)),
        jitters={"light": 0.02, "sky": 0.03, "temperature": 0.01}, offsets={"sky": 0.1}, drifts={"light": 0.01},
        cycles={"temperature": 0.3},
    )  # fmt: skip
    assert np.ptp(stare.temperature_c) == pytest.approx(1.0, abs=1e-4)
    assert stare.temperature_c.mean() == pytest.approx(13.0, abs=1e-3)
    np.testing.assert_allclose(stare.star, 1 + 1e-5 * stare.middle_s)
    np.testing.assert_array_equal(stare.sky, 1.0)
    assert stare.jitters == {"light": 0.02, "sky": 0.03, "temperature": 0.01}
    named = {unknown.name: unknown for unknown in stare.unknowns}
    assert list(named) == ["sky offset", "light drift", "temperature sine", "temperature cosine"]
    drift = named["light drift"].curve
    assert drift.sum() == pytest.approx(0.0, abs=1e-9)
    assert np.ptp(drift) == pytest.approx((stare.n_frames - 1) * 5 / 3600)
    sine, cosine = named["temperature sine"].curve, named["temperature cosine"].curve
    np.testing.assert_allclose(sine**2 + cosine**2, 1.0, atol=1e-5)


START, HOURS = "2026-09-20T03:00:00", 8.0


def asked(start: str, hours: float, *settings: str) -> Any:
    orbit = ["orbit.targets=['eps Eri']", f"orbit.start='{start}'", f"orbit.days={hours / 24}", "orbit.step_s=5"]
    frames = ["stare.along_orbit=true", f"stare.duration_s={hours * 3600}", "stare.search=false"]
    return paper(*orbit, *frames, *settings)


@pytest.mark.long
def test_frames_along_an_orbit_are_those_of_its_windows() -> None:
    """Check ends, shadow as in the table of windows up to the penumbra of 8 s, and independence of the start time."""
    study = asked(START, HOURS, "stare.drifts.light=0.01", "stare.offsets.sky=0.1")
    answer, windows = stare(study), mauvecl.visible(study).tables["windows"]
    night = answer.stares[0].staring.stare
    ends = [(Time(list(windows[name])).mjd - Time(START).mjd) * 86_400 for name in ("start", "stop")]
    np.testing.assert_allclose(night.gtis, np.column_stack(ends), atol=1.0)
    assert 0 < night.n_frames < HOURS * 720
    assert sorted(one.name for one in night.unknowns) == ["light drift", "sky offset"]
    # Most of a drift about the middle of the stare is still there: the curve is the whole stare's.
    drift = next(one for one in night.unknowns if one.of == "light")
    np.testing.assert_allclose(drift.curve, (night.middle_s - HOURS * 1800) / 3600)
    assert ((night.temperature_c > 13) & (night.temperature_c < 21)).all()
    for (start, stop), minutes in zip(night.gtis, windows["in_shadow"].value, strict=True):
        inside = (night.start_s >= start) & (night.start_s < stop)
        falls = np.diff(night.temperature_c[inside]) < 0
        assert 0 < falls.sum() < falls.size
        assert falls.sum() * 5.0 == pytest.approx(60 * minutes, abs=20.0)
    later = stare(asked("2026-09-20T07:00:00", 4.0)).stares[0].staring.stare
    same = night.temperature_c[night.start_s >= 4 * 3600]
    assert later.temperature_c == pytest.approx(same, abs=0.02)  # of 8 deg C, after 8 time constants
    # The source of the orbit is stated.
    assert any("assumptions" in line for line in answer.messages)
    assert "detector temperature of the stare along the orbit" in answer.assumed
    with fits.open(io.BytesIO(answer.documents["light-curve-1.fits"]())) as hdus:
        assert hdus[1].header["MJDREFI"] + hdus[1].header["MJDREFF"] == Time(START).mjd
        place = [hdus[0].header[name] for name in ("RA_OBJ", "DEC_OBJ")]
        assert place == pytest.approx([53.2327, -9.4583], abs=1e-3)
    messages = [stare(one).messages for one in (asked("2027-01-10", HOURS), paper("stare.search=false"))]
    assert [sum("orbit" in line and "mean Sun-synchronous" in line for line in one) for one in messages] == [1, 0]
    assert not any("orbit" in line for line in messages[1])
