"""Optional processes and pointing drifts: each has its distribution and its own stream, and changes nothing else."""

import json
import os
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from processes import python
from scenes import instrument, prepare, star
from scipy import integrate, stats

from mauvecl import CosmicRays, Engine, Normal, Processes, Study, Uniform, simulate
from mauvecl.device import selftest
from mauvecl.noise import layout, reference, unknowns
from mauvecl.noise import scene as noise_scene

N = 20_000
NONE = Processes()


def total_light(engine: Engine, processes: Processes, *, exposure: float = 5.0, mode: str = "auto") -> np.ndarray:
    """Return each realisation's net DN relative to the expectation, and the expectation."""
    (x,) = star(magnitude=4.0, exposure=exposure)
    raw = engine.realise(x, count=N, seed=12, processes=processes, mode=mode)
    net = raw.sum(axis=1) - np.sum(x.n_frames * (x.bias_dn + x.dark_dn))
    return net / x.recorded_light_dn.sum()


def test_light_follows_distribution_of_prior(engine: Engine) -> None:
    """Compare the light summed over pixels, which measures the factor: KS on 20 000 draws fails once in 1e6."""
    noise = total_light(engine, NONE).std()
    found = total_light(engine, Processes(light_loss=Uniform(0.24, 0.44)))
    low, high = (1 - 0.44) / (1 - 0.34), (1 - 0.24) / (1 - 0.34)
    assert noise < 0.002 < (high - low) / 50
    assert stats.kstest(found, stats.uniform(low, high - low).cdf).pvalue > 1e-6
    found = total_light(engine, Processes(qe_scale=Normal(1.0, 0.3, 0.4, 1.6)))
    assert stats.kstest(found, stats.truncnorm(-2, 2, 1.0, 0.3).cdf).pvalue > 1e-6


def test_jitter_of_frames_is_uncorrelated(engine: Engine) -> None:
    """Check frames, which take finer digits from each other's words: five standard errors fail once in 2e5."""
    (x,) = star(magnitude=2.0, exposure=5.0)
    jitter = Processes(jitter=Normal(0.1, 0.02, 0.0, 0.5))
    lost = []
    for frame in range(4):
        raw = engine.realise(x, count=5000, seed=12, processes=jitter, first_frame=frame)
        lost.append((raw.astype(float) - x.mean_raw_dn).sum(axis=1))
    for values in (np.array(lost), np.array(lost) ** 2):
        found = np.corrcoef(values)[np.triu_indices(4, 1)]
        assert np.abs(found).max() < 5 / np.sqrt(5000)


def test_dark_follows_detector_temperature(engine: Engine) -> None:
    (x,) = star(magnitude=30.0, exposure=5.0)
    raw = engine.realise(x, count=N, seed=3, processes=Processes(detector_temperature=Uniform(13.0, 21.0)))
    dark = (raw.sum(axis=1) - x.bias_dn.sum()) / x.dark_dn.sum()
    temperature = 21.0 + np.log(dark) / 0.0684
    # The dark's own noise scatters the temperature by 0.01 C.
    assert stats.kstest(temperature, stats.uniform(13.0, 8.0).cdf).statistic < 0.005 + 2.6 / np.sqrt(N)
    # Its variance follows: where it is coldest, it is that of the colder dark.
    cold = raw[temperature < 13.4].astype(float)
    share = np.exp(0.0684 * (13.2 - 21.0))
    wanted = x.dark_dn * share + x.read_noise_dn**2 + 1 / 12
    between = np.var(np.exp(0.0684 * (temperature[temperature < 13.4] - 21.0))) * x.dark_dn**2
    ratio = np.mean(cold.var(axis=0) / (wanted + between))
    assert abs(ratio - 1) < 0.01 + 5 * np.sqrt(2 / cold.size)


@pytest.mark.long
def test_jitter_is_drawn_for_every_frame(engine: Engine) -> None:
    """Compare the losses of one frame and of ten, stacked and frame by frame, with the prior: six standard errors."""
    most = Processes(jitter=Uniform(0.0, 0.05))
    one = total_light(engine, most)
    assert stats.kstest(one, stats.uniform(0.95, 0.05).cdf).statistic < 0.02 + 2.6 / np.sqrt(N)
    for mode in ("stacked", "frames"):
        ten, quiet = (total_light(engine, p, exposure=50.0, mode=mode) for p in (most, NONE))
        assert abs(ten.mean() - 0.975) < 6 * ten.std() / np.sqrt(N)
        own = ten.var() - quiet.var()
        assert abs(own / (0.05**2 / 12 / 10) - 1) < 6 * np.sqrt(2 / N) * ten.var() / own


def test_cosmic_rays_follow_compound_distribution(engine: Engine) -> None:
    rays = CosmicRays(rate_per_cm2_s=40.0)
    (x,) = star(exposure=5.0)
    clean, hit = (engine.realise(x, count=2000, seed=9, processes=p) for p in (NONE, Processes(cosmic_rays=rays)))
    extra = hit.astype(int) - clean.astype(int)
    rate = 40.0 * 0.057 / 2048 * 5.0
    hits = np.count_nonzero(extra)
    expected = extra.size * -np.expm1(-rate)
    assert abs(hits - expected) < 5 * np.sqrt(expected)
    electrons = extra[extra > 0] / x.gain_dn_per_electron[0]
    assert extra.min() == 0
    # Single hits, 500 to 1000; the second of a pair lies beyond. Rounding to DN is one electron.
    single = electrons[electrons < 1003]
    assert stats.kstest(single, stats.uniform(499, 1002).cdf).statistic > 0.1
    assert stats.kstest(single, stats.uniform(499.5, 501).cdf).pvalue > 1e-6
    assert abs(electrons.size - single.size - expected * rate / 2) < 6 * np.sqrt(expected * rate / 2)


def test_charge_has_moments_of_compound_poisson_sum() -> None:
    rays = CosmicRays(rate_per_cm2_s=3000.0)
    for seconds in (5.0, 50.0, 600.0):
        p = rays.charge(seconds)
        e = np.arange(p.size)
        rate = 3000.0 * 0.057 / 2048 * seconds
        one = np.arange(500, 1001)
        assert abs(p.sum() - 1) < 1e-11
        np.testing.assert_allclose(p @ e, rate * one.mean(), rtol=1e-9)
        variance = rate * np.mean(one**2)
        np.testing.assert_allclose(p @ e**2 - (p @ e) ** 2, variance, rtol=1e-8)
        assert p.size == rays.most_electrons(seconds) + 1
        quiet = replace(selftest.toy(), frame_s=seconds)
        np.testing.assert_allclose(rays.variance_dn2(quiet), variance * quiet.gain_dn_per_electron**2, rtol=1e-8)
        # The Fourier transform's own rounding.
        np.testing.assert_allclose(p[0], np.exp(-rate), rtol=1e-9, atol=1e-15)
    weighted = CosmicRays(electrons=(2, 4), weights=(1.0, 0.0, 3.0), rate_per_cm2_s=100.0).charge(5.0)
    assert weighted[3] < 1e-15 < weighted[2] < weighted[4]


@pytest.mark.long
@pytest.mark.parametrize("recipe", ["joint", "apart"])
@pytest.mark.parametrize("name", ["mauvesim", "mauve"])
def test_components_have_correct_sum_and_moments(engine: Engine, name: str, recipe: str) -> None:
    rays = recipe == "joint"
    sections = {"observation": {"instrument": name, "recipe": recipe}, "run": {"seed": 5}}
    sections |= {"processes": {"cosmic_rays": {}}} if rays else {}
    near = {"neighbours": str(Path(__file__).parents[1] / "data" / "studies" / "near.csv"), "neighbour_share": 0.5}
    study = Study.build({"star": [{"library": "G2V", "magnitude": 7.4} | near]} | sections, "test")
    ((_, x, table),) = simulate(study, realisation=7).observations
    raw = engine.realise(x, start=7, count=1, seed=5, recipe=recipe, processes=study.processes)[0]
    assert ("cosmic_rays" in table.colnames) == rays
    assert not rays or "cosmic rays" in table["cosmic_rays"].info.description
    np.testing.assert_array_equal(table["raw"].value, raw)
    names = [c for c in table.colnames if c not in ("wavelength", "raw", "net")]
    np.testing.assert_allclose(sum(table[c].value for c in names), raw, rtol=0, atol=1e-6)
    # Rounding of a stack changes at most half a DN, beyond the float32 arithmetic of the draw.
    assert np.abs(table["digitisation"].value).max() < 0.502
    n, size = x.n_frames, x.wavelength_nm.size
    variances = {
        "photon_noise": x.gain_dn_per_electron * x.recorded_light_dn,
        "dark": n * x.dark_variance_dn2,
        "read_noise": n * x.read_noise_dn**2 + (n - 1) / 12,
    }
    mean = {"dark": n * x.dark_dn}
    z = np.array([(table[part].value - mean.get(part, 0.0)) / np.sqrt(own) for part, own in variances.items()])
    assert np.abs(z.mean(axis=1)).max() < 5 / np.sqrt(size)
    assert np.abs(z.var(axis=1) - 1).max() < 5 * np.sqrt(2 / size)
    # Independent of each other, as they were before they were added.
    assert np.abs(np.corrcoef(z)[np.triu_indices(3, 1)]).max() < 5 / np.sqrt(size)
    steps = table["dark"].value / x.dark_step_dn
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)


def test_draws_have_different_counters(monkeypatch: pytest.MonkeyPatch) -> None:
    """List all counters of a run with all processes: none occurs twice in any realisation, frame or exposure."""
    seen: list[np.ndarray] = []
    philox = reference.philox

    def recording(counter, seed: int):
        c = np.broadcast_arrays(*(np.asarray(word, np.uint64) for word in counter))
        seen.append(np.stack(c, axis=-1).reshape(-1, 4))
        return philox(counter, seed)

    monkeypatch.setattr(reference, "philox", recording)
    priors = dict.fromkeys(unknowns.PROCESSES, Uniform(0.3, 0.4)) | {"detector_temperature": Uniform(13.0, 21.0)}
    everything = Processes(cosmic_rays=CosmicRays(), **priors)
    payload = instrument(part=True, output_max_nm=310.0)
    index = np.array([0, 1, 2**32 - 1, 2**32, 2**40], np.uint64)
    cases = [
        ({"exposure": 20.0, "payload": payload}, {"mode": "frames", "processes": everything}),
        ({"exposure": 20.0, "payload": payload}, {"recipe": "apart"}),
        ({"exposure": 10.0, "payload": instrument("mauve", output_max_nm=205.0)}, {"recipe": "apart"}),
    ]
    for observation, how in cases:
        scene = prepare(star(**observation), **how)
        seen.clear()
        for frame in range(scene.n_draws):
            for exposure in (0, layout.REFERENCE):
                reference.draws(scene, index, frame, 1, exposure=exposure)
        for name, _ in scene.modulations:
            if name != "jitter":
                reference.words_at(index, 0, name, 0, 1)
        if "processes" in how:
            for exposure in (0, layout.REFERENCE):
                for block in range(scene.n_frames // 4):
                    reference.words_at(index, block, "jitter", 0, 1, exposure)
        counters = np.concatenate(seen)
        assert len(np.unique(counters, axis=0)) == len(counters)
    # Streams of both exposures are distinct bytes.
    streams = [s + e for s in layout.STREAMS.values() for e in (0, layout.REFERENCE)]
    assert len(set(streams)) == len(streams)
    assert max(streams) < 256
    # Every default prior has a source or documentation.
    assert all(row.source for row in unknowns.PROCESSES.values() if row.prior is not None)
    assert all(row.marginalised and row.scatter > 0 for row in unknowns.DOCUMENTED_NUISANCES)


@pytest.mark.parametrize("level", [Uniform(0.5, 1.5), Uniform(0.2, 9.0)])
def test_sky_follows_its_level(engine: Engine, level: Uniform) -> None:
    """Check that only the sky changes, and that jitter dims it like the star: five standard errors fail once in 1e5."""
    (star_alone,) = star(payload=instrument(part=True))
    # As bright as the star, of another shape.
    slope = np.linspace(0.5, 1.5, star_alone.wavelength_nm.size)
    x = replace(star_alone, sky_electrons=100.0 * slope, source_electrons=100.0 / slope)
    light = np.array([x.source_electrons, x.sky_electrons]) * x.n_frames * x.gain_dn_per_electron

    def amplitudes(processes: Processes) -> np.ndarray:
        raw = engine.realise(x, count=N // 4, seed=4, processes=processes)
        found, *_ = np.linalg.lstsq(light.T, (raw - x.n_frames * (x.bias_dn + x.dark_dn)).T, rcond=None)
        return np.asarray(found)

    noise = amplitudes(NONE).var(axis=1)
    for jitter, kept in ((None, 1.0), (Uniform(0.02, 0.02), 0.98)):
        of_star, of_sky = amplitudes(Processes(jitter=jitter, sky_level=level))
        error = np.sqrt(1.0 / of_sky.size)
        mean, sd = kept * (level.low + level.high) / 2, kept * (level.high - level.low) / np.sqrt(12)
        assert abs(of_star.mean() - kept) < 5 * error * of_star.std()
        assert abs(of_sky.mean() - mean) < 5 * error * of_sky.std()
        # A uniform value's variance scatters by less than a normal's; the noise's grows with the light at most.
        wanted = sd**2 + noise[1]
        assert abs(of_sky.var() / wanted - 1) < 5 * error + abs(mean - 1) * noise[1] / wanted


@pytest.mark.parametrize("magnitude", [-2.0, -1.2, -1.0, 2.0])
def test_changes_are_slopes_of_recorded_moments(magnitude: float) -> None:
    """Compare with a star whose light, or dark, is larger by 1e-5, where no, some and most pixels saturate."""
    quiet, *_ = star("K3V", magnitude, payload=instrument(part=True))
    means, variances = noise_scene.changes_of(quiet)
    step = 1e-5
    light = ("source_electrons", "sky_electrons", "neighbour_electrons")
    for row, names in ((0, light), (1, light[1:2]), (2, ("dark_dn",))):
        moved = replace(quiet, **{name: getattr(quiet, name) * (1 + step) for name in names})
        slope = (moved.recorded_dn - quiet.recorded_dn) / step
        unclipped = (moved.mean_raw_dn - quiet.mean_raw_dn) / step
        # The width of the distribution changes too, by much less than its mean.
        assert slope / quiet.n_frames == pytest.approx(means[row] / quiet.n_frames, abs=5e-3 * unclipped.max())
    # Dark and light together are all of what factors change: without them the variance is not negative.
    assert (quiet.variance_dn2 - variances[0] - variances[2] >= 0).all()
    assert (means >= 0).all()
    assert (quiet.cut_share.max() > 0.1) == (magnitude < 0)


#: A toy process that is registered before anything else is imported, as a new row of the registry is.
TOY = """
import json
import tomllib
from typing import ClassVar
import numpy as np
from scipy import stats
import mauvecl.noise.disturbances as additive

class Bursts(additive.AdditiveProcess):
    "Bursts of the dark current: a Poisson number of bursts of 300 electrons."
    stream: ClassVar[int] = 40
    label: ClassVar[str] = "bursts"
    per_s: float = 0.02
    def charge(self, seconds):
        charge = np.zeros(self.most_electrons(seconds) + 1)
        charge[::300] = stats.poisson.pmf(np.arange(41), self.per_s * seconds)
        return charge
    def most_electrons(self, seconds):
        return 12_000

additive.ADDITIVE["bursts"] = Bursts
from mauvecl import Engine, Processes, Study, simulate
from mauvecl.device import selftest
from reference import known_answers

N = 4000
sections = {"bursts": {"per_s": 0.02}, "cosmic_rays": {"rate_per_cm2_s": 300.0}}
study = Study.build({"star": [{"library": "G2V", "magnitude": 7.4}], "processes": sections}, "t")
bursts, engine, quiet = Processes(bursts=study.processes.bursts), Engine(), selftest.toy(64, 3)
selftest.METHODS["pixels"] = study.processes
for name, processes in (("bursts", bursts), ("both", study.processes)):
    selftest.CASES[name] = ({"frames": 3}, {"processes": processes})
ours, twins = (
    [array for name in ("bursts", "both", *selftest.STARE_CASES) for array in results(name).values()]
    for results in (lambda name: selftest.results(engine, name, 8), lambda name: known_answers.results(name, 8))
)
clean, hit = (engine.realise(quiet, count=N, seed=2, processes=p) for p in (Processes(), bursts))
charge = bursts.bursts.charge(15.0)
electrons = np.arange(charge.size)
mean = float(charge @ electrons)
print(json.dumps({
    "keys": list(Processes.model_fields)[:2],
    "kept": Study.build(tomllib.loads(study.toml()), "t") == study,
    "same": [bool((a == b).all()) for a, b in zip(ours, twins, strict=True)],
    "added": float(np.mean((hit - clean) / quiet.gain_dn_per_electron)), "mean": mean,
    "sd": float(np.sqrt((charge @ electrons**2 - mean**2) / (N * 64))),
    "particles": [p.label for p in bursts.with_particles(5.0).particle_processes],
    "column": "bursts" in simulate(study).observations[0][2].colnames,
}))
"""


@pytest.mark.long
def test_another_process_needs_its_class_and_row_only() -> None:
    """Section, kernels, reference, stares and decomposition follow a row; the added charge is that of the class."""
    done = python(TOY, PYTHONPATH=os.pathsep.join(sys.path))
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["keys"][-1:] == ["bursts"]
    assert found["kept"]
    assert all(found["same"])
    assert found["column"]
    assert found["particles"] == ["cosmic rays"]
    # Rounding adds 0.03 electrons at most; five standard errors fail once in 2e6.
    assert abs(found["added"] - found["mean"]) < 5 * found["sd"] + 0.03
    assert "bursts" not in layout.STREAMS


SEED = 11
DRIFTS = Study().with_settings(["stare.pointing={rate_per_h=6.0, duration_s=200.0, depth=0.8}"]).stare.pointing
drifts, losses = (partial(function, DRIFTS) for function in (reference.pointing_drifts, reference.pointing_losses))
NUMBERS = np.arange(4000, dtype=np.uint64)


def test_waits_durations_and_depths_have_their_distributions() -> None:
    """Use KS tests at 1e-5 and ranks at 4.5 sigma: one run in 7000 fails by chance; the seed was fixed beforehand."""
    start, lasts, depth = drifts(NUMBERS, 20_000.0, SEED)
    assert (start[:, -1] >= 20_000.0).all()
    waits = start - np.column_stack([np.zeros(NUMBERS.size), (start + lasts)[:, :-1]])
    assert (waits > 0).all()
    # Drawn up to a fixed number of drifts, and so without the bias of a fixed time.
    laws = (stats.expon(scale=600.0), stats.expon(scale=200.0), stats.uniform(0.0, 0.8))
    for values, law in zip((waits, lasts, depth), laws, strict=True):
        assert stats.kstest(values[:, :8].ravel(), law.cdf).pvalue > 1e-5
    # Nothing is related to anything else, such as drifts of the second group that are drawn together to the first.
    table = np.column_stack([waits[:, [0, reference.DRIFTS_AT_ONCE]], lasts[:, :2], depth[:, :2]])
    rank = stats.spearmanr(table).statistic[np.triu_indices(6, 1)]
    assert np.abs(rank).max() * np.sqrt(NUMBERS.size) < 4.5


def test_frames_hold_the_mean_of_the_drift() -> None:
    """The loss of a frame is the integral of the saw-tooth over it, whatever begins or ends in the frame."""
    start, lasts, depth = (one[0] for one in drifts(NUMBERS[:1], 3000.0, SEED))

    def lost(time_s: float) -> float:
        inside = (time_s >= start) & (time_s < start + lasts)
        return float(np.sum(inside * depth * (time_s - start) / lasts))

    edges = np.arange(0.0, 3000.0, 5.0)
    found = losses(NUMBERS[:1], edges, 5.0, SEED)[0]
    breaks = np.concatenate([start, start + lasts])
    for k in [*np.flatnonzero(found)[::7], *((breaks[breaks < 3000.0] // 5.0).astype(int))]:
        inner = [b for b in breaks if edges[k] < b < edges[k] + 5.0]
        value = integrate.quad(lost, edges[k], edges[k] + 5.0, points=inner or None, limit=200)[0] / 5.0
        assert found[k] == pytest.approx(value, abs=1e-9)
    # A stare depends on its number and the seed alone.
    some = losses(NUMBERS[7:9], np.arange(0.0, 6000.0, 5.0), 5.0, SEED)
    every = losses(NUMBERS[:20], np.arange(0.0, 6000.0, 5.0), 5.0, SEED)
    np.testing.assert_array_equal(some, every[7:9])
    longer = losses(NUMBERS[7:9], np.arange(0.0, 60_000.0, 5.0), 5.0, SEED)
    np.testing.assert_allclose(some, longer[:, :1200], atol=1e-12)
    assert not np.array_equal(some, losses(NUMBERS[7:9], np.arange(0.0, 6000.0, 5.0), 5.0, SEED + 1))
