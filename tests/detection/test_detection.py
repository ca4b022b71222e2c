"""Detection: calibrated nulls, closed forms with unknowns and where they fail, promised false alarms, many flares."""

import tracemalloc
from itertools import product
from typing import Any

import numpy as np
import pytest
from answers import STATISTICS, small, twice
from scenes import instrument, star
from scipy import stats
from scipy.sparse import csr_array

import mauvecl
from mauvecl import Comparison, Detection, Engine, Linear, Normal, Nuisances, Processes, Uniform, departures, detect
from mauvecl.detection.chi2 import Smoothing

N = 1_000_000
#: The paper's G2V star, with flares around the edge of detection for one statistic or another.
AMPLITUDES = (0.03, 0.081, 0.15, 0.24)


@pytest.fixture(scope="module")
def found(engine: Engine) -> Detection:
    """Return the detection by all statistics, and by own weights."""
    quiet, *flares = star(amplitudes=AMPLITUDES)
    statistics = (*STATISTICS, Linear("slope", np.linspace(-1.0, 2.0, quiet.wavelength_nm.size)))
    return engine.detect(quiet, flares, realisations=N, seed=20, statistics=statistics)


def ks_probability(d: Any, sf: object) -> float:
    """Return the probability of the Kolmogorov-Smirnov test at the edges of filled bins, 32 per standard deviation."""
    filled = np.flatnonzero(d.counts)
    # The last edge, too: all values in one bin are no distribution.
    edges = np.asarray(d.edge(np.unique(np.append(np.arange(filled[0], filled[-1] + 2, 16), filled[-1] + 1))))
    ours = np.array([d.above(x) / d.n for x in edges])
    theirs = np.array([sf(float(x)) for x in edges])
    return float(stats.kstwo.sf(np.abs(ours - theirs).max(), d.n))


@pytest.mark.long
@pytest.mark.parametrize("flare", [None, *range(len(AMPLITUDES))])
@pytest.mark.parametrize("statistic", [*STATISTICS, "slope"])
def test_distribution_follows_its_closed_form(found: Detection, statistic: str, flare: int | None) -> None:
    """Compare 1e6 realisations of a star for which Gaussian limits hold; each case fails once in 1e6 seeds."""
    d, exact = found.distribution(statistic, flare), found.closed_form(statistic, flare)
    # The smoothed sum is a generalised chi-squared, which test_statistics.py looks at.
    if flare is None and statistic not in ("paper", "slope"):
        exact = stats.norm() if statistic in ("matched", "uv_excess") else stats.chi2(found.dof(statistic))
    assert ks_probability(d, exact.sf) > 1e-6
    assert flare is not None or d.n_far == 0


def test_delong_interval_agrees_with_repeated_draws(engine: Engine) -> None:
    """Check that 178 of 200 intervals contain the exact area; fails once in 1e4 new seeds."""
    quiet, flare = star(amplitudes=(0.015,), payload=instrument(output_min_nm=300.0, output_max_nm=310.0))
    held = 0
    for seed in range(200):
        found = engine.detect(quiet, [flare], realisations=400, seed=seed, statistics="matched")
        if seed == 0:
            null, with_flare = (found.closed_form("matched", f) for f in (None, 0))
            gap = (with_flare.mean - null.mean) / np.hypot(null.std, with_flare.std)
            assert 0.3 < gap < 1.5
        area = found.roc("matched", 0).area
        held += area.low <= stats.norm.cdf(gap) <= area.high
    assert held >= 178
    assert stats.binom.cdf(177, 200, 0.95) < 3e-4


def test_saturated_pixels_are_left_out(engine: Engine) -> None:
    """Check that pixels saturated without a flare do not enter, and that the others give a calibrated null."""
    payload = instrument(part=True)
    quiet, flare = star(magnitude=-0.17, amplitudes=(0.05,), exposure=10.0, payload=payload)
    assert 0 < quiet.saturated.sum() < 10
    found = engine.detect(quiet, [flare], realisations=100_000, seed=3)
    dof = int((~quiet.saturated).sum())
    assert found.dof("chi2") == dof
    assert found.scene.frames
    mean = found.distribution("chi2").mean
    assert abs(mean - dof) < 5 * np.sqrt(2 * dof / 100_000)


SCENES = 80
#: Of the thresholds, and again of the false alarms counted with other draws.
NULLS = 300_000
FAPS = (1e-2, 1e-3, 1e-4)
STARS = ("B2IV", "A0V", "F5V", "G2V", "K3V", "K5V", "M0V")


def scene(number: int) -> tuple:
    """Draw a star, magnitude, exposure, temperature, sky, instrument and 12 nm of spectrum at random."""
    generator = np.random.default_rng([2026, number])
    first = generator.uniform(200.0, 330.0)
    name, celsius = str(generator.choice(["mauvesim", "mauve"])), float(generator.uniform(-10.0, 25.0))
    payload = instrument(name, temperature_c=celsius, output_min_nm=float(first), output_max_nm=float(first + 12.0))
    source = mauvecl.Source.from_library(str(generator.choice(STARS))).at_magnitude(float(generator.uniform(3.0, 10.0)))
    sky = mauvecl.Sky.of_brightness(float(generator.uniform(18.0, 23.0)))
    exposure = 5.0 * int(generator.integers(1, 60))
    return tuple(
        mauvecl.expect(s, payload, exposure=exposure, sky=sky)
        for s in (source, source.flaring(float(generator.uniform(0.01, 1.0))))
    )


@pytest.mark.long
def test_false_alarms_are_as_requested(engine: Engine) -> None:
    """Check eighteen sums and their scatter, which notice errors of 16 % at 1e-4; once in 1e6 runs they fail."""
    # A threshold is an order statistic of null draws, so that the number of fresh ones beyond it is beta-binomial.
    z = {(s, fap): [] for s in STATISTICS for fap in FAPS}
    drawn_frames = 0
    for number in range(SCENES):
        quiet, flare = scene(number)
        # A few frames are drawn one by one, rounded and clipped each.
        mode = "frames" if quiet.n_frames <= 5 else "auto"
        first, fresh = twice(engine, quiet, [flare], NULLS, seed=number, statistics=STATISTICS, mode=mode)
        drawn_frames += first.scene.frames
        for statistic in STATISTICS:
            ours, theirs = first.distribution(statistic), fresh.distribution(statistic)
            for fap in FAPS:
                cut = ours.edge_with_at_most(int(fap * NULLS))
                # Whole bins: the threshold's own count, which is at most fap NULLS.
                k = ours.above(cut)
                expected = NULLS * (k + 0.5) / (NULLS + 1)
                z[(statistic, fap)].append((theirs.above(cut) - expected) / np.sqrt(2 * expected))
    # Both ways of drawing are among the scenes.
    assert 0 < drawn_frames < SCENES
    tests = 2 * len(z)
    for values in z.values():
        total = np.sum(values) / np.sqrt(SCENES)
        assert 2 * stats.norm.sf(abs(total)) > 1e-6 / tests
        scatter = stats.chi2.cdf(np.sum(np.square(values)), SCENES)
        assert 2 * min(scatter, 1 - scatter) > 1e-6 / tests


def departed(engine: Engine, *, magnitude: float = 7.4, exposure: float = 5.0, **options: object) -> dict[str, Any]:
    """Return the departures of a faint flare on a part of the pixels, by statistic."""
    comparison = options.pop("comparison", Comparison())
    statistics = options.pop("statistics", ("chi2", "chi2_element", "uv_excess"))
    payload = instrument(part=True, **options)
    quiet, flare = star(magnitude=magnitude, amplitudes=(0.3,), exposure=exposure, payload=payload)
    kind = {"realisations": 500_000, "seed": 3, "statistics": statistics, "comparison": comparison}
    return {d.statistic: d for d in departures(engine.detect(quiet, [flare], **kind), 1e-3)}


@pytest.mark.long
def test_nominal_payload_is_gaussian(engine: Engine) -> None:
    """Check that nothing differs at 50 s; six values exceed 4 standard errors once in 2500 seeds."""
    for d in departed(engine, exposure=50.0, statistics=tuple(STATISTICS)).values():
        assert not d.differs
        assert d.why == ""
        assert max(abs(d.skew), abs(d.rounding), abs(d.clipping)) < 0.01


def test_skew_is_predicted(engine: Engine) -> None:
    """Predict Poisson's tail for few dark counts and little read noise, to a fifth of its effect."""
    kind = {"read_noise_dn": 1.0, "dark_scale_dn_per_s": 0.2, "magnitude": 14.0}
    # The difference of two exposures is symmetric.
    symmetric = departed(engine, **kind, comparison=Comparison(1))
    assert symmetric["chi2"].ratio - 1 == pytest.approx(symmetric["chi2"].skew, abs=4 * symmetric["chi2"].error)
    assert abs(symmetric["uv_excess"].skew) < 0.01
    d = departed(engine, **kind)["chi2"]
    assert d.why == "skew of the noise"
    assert d.ratio - 1 == pytest.approx(d.skew, rel=0.2, abs=4 * d.error)
    assert d.skew > 0.3


def test_clipping_and_rounding_are_predicted(engine: Engine) -> None:
    """Predict the effect of clipping at zero, for a bias of 5 DN and a read noise of 12 DN; two exposures share it."""
    for exposures in (1, 0):
        compared = Comparison(exposures)
        rows = departed(engine, bias_dn=5.0, dark_scale_dn_per_s=0.0, magnitude=12.0, comparison=compared)
        assert {d.why for d in rows.values()} == {"clipping"}
        assert rows["uv_excess"].ratio - 1 == pytest.approx(rows["uv_excess"].clipping, rel=0.05)
    assert rows["chi2"].ratio < 0.1
    assert rows["chi2"].clipping < -0.9
    # Rounding, for noise below the ADC's step.
    range_nm = {"output_min_nm": 200.0, "output_max_nm": 260.0}
    d = departed(engine, read_noise_dn=0.35, dark_scale_dn_per_s=0.0, magnitude=20.0, **range_nm)["chi2"]
    assert d.why == "rounding"
    assert d.ratio < 0.2
    assert d.rounding < -0.5


def test_estimated_variances_are_predicted(engine: Engine) -> None:
    """Predict chi-squared's null for estimated variances, where low counts have low variances."""
    kind = {"read_noise_dn": 3.0, "dark_scale_dn_per_s": 0.0, "magnitude": 6.0}
    assert departed(engine, **kind, comparison=Comparison(0, True))["chi2"].why == "variances estimated from the counts"
    assert not departed(engine, **kind)["chi2"].differs
    # From the raw counts of a few realisations, with means that are no whole DN and hardly any noise.
    payload = instrument(part=True, read_noise_dn=0.6, dark_scale_dn_per_s=0.0)
    quiet, flare = star(amplitudes=(0.3,), exposure=5.0, payload=payload)
    x = engine.realise(quiet, count=40, seed=3) - quiet.recorded_dn
    known = quiet.read_noise_dn**2 + quiet.dark_variance_dn2 + 1 / 12
    variance = known + quiet.gain_dn_per_electron * np.maximum(x + quiet.recorded_light_dn, 0.0)
    found = engine.statistic_values(quiet, [flare], count=40, seed=3, comparison=Comparison(0, True))
    np.testing.assert_allclose(found[0], np.sum(x**2 / variance, axis=1), rtol=1e-5)
    sums, noise = (np.array([quiet.per_element(row) for row in rows]) for rows in (x, variance))
    np.testing.assert_allclose(found[1], np.sum(sums**2 / noise, axis=1), rtol=1e-5)


def test_undrawn_unknowns_are_reported(engine: Engine) -> None:
    quiet, flare = star(amplitudes=(0.24,))
    departed = engine.detect(quiet, [flare], realisations=100_000, seed=1, nuisances={"dark": 0.1})
    rows = {d.statistic: d for d in departures(departed, 0.01)}
    # One of 48 squares is missing: 0.7 of the false alarms, and 4 standard errors of 100 000 are 0.13.
    assert 0.55 < rows["chi2_element"].ratio < 0.85
    assert rows["chi2_element"].why == "unknowns that are marginalised over and not drawn"


FREE = float("inf")


def _prior(centre: float, sd: float) -> Normal:
    return Normal(centre, sd, centre - 5 * sd, centre + 5 * sd)


#: Star, flares, marginalised and drawn unknowns, with Gaussian and other priors.
DRAWN = {
    "half a degree": (("G2V", 7.4, (0.1, 0.02)), {"dark": 0.5}, Processes(detector_temperature=_prior(21.0, 0.5))),
    "half a degree, projected out": (
        ("G2V", 7.4, (0.1, 0.02)), {"dark": FREE}, Processes(detector_temperature=_prior(21.0, 0.5))
    ),
    "light of a bright star": (
        ("K3V", 3.7, (0.003, 0.0003)),
        {"light": 0.02},
        # Together 2 %.
        Processes(qe_scale=_prior(1.0, 0.0173), light_loss=Uniform(0.3286, 0.3514)),
    ),
    "all that is usual": (
        ("G2V", 7.4, (0.1, 0.02)),
        {"dark": FREE, "light": FREE, "sky": 0.1, "tilt": FREE},
        Processes(jitter=Uniform(0.0, 0.05), detector_temperature=_prior(21.0, 0.5), sky_level=_prior(1.0, 0.1)),
    ),
    "uniform light": (("K3V", 5.0, (0.01, 0.001)), {"light": 0.09}, Processes(light_loss=Uniform(0.24, 0.44))),
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("case", DRAWN)
def test_closed_forms_integrate_over_drawn_unknowns(engine: Engine, case: str) -> None:
    """Compare false alarms and detections at the closed forms' thresholds: by chance one run in 1000 fails."""
    (name, magnitude, amplitudes), nuisances, processes = DRAWN[case]
    quiet, *flares = star(name, magnitude, amplitudes=amplitudes)
    n = 100_000
    n_pixel = quiet.wavelength_nm.size
    names = ("chi2", "chi2_element", "matched", "uv_excess", "own")
    statistics = (*names[:-1], Linear("own", 1.0 + np.arange(n_pixel) / n_pixel))
    how = {"nuisances": nuisances, "processes": processes, "statistics": statistics}
    found = engine.detect(quiet, flares, realisations=n, seed=3, **how)
    powers = []
    for statistic in names:
        for flare in range(len(flares)):
            cut = found.closed_form(statistic, template=flare).isf(0.01)
            alarms = found.false_alarm_probability(cut, statistic, template=flare).value
            assert abs(alarms - 0.01) < 4.5 * np.sqrt(0.01 * 0.99 / n)
            power = found.closed_form(statistic, flare).sf(cut)
            seen = found.distribution(statistic, flare).above(cut) / n
            assert abs(seen - power) < 4.5 * np.sqrt(power * (1 - power) / n) + 1e-5
            powers.append(power)
    # Some of the closed forms are defined.
    assert sum(0.05 < power < 0.99 for power in powers) >= 2


def test_light_of_unknowns_is_separated_from_a_flare() -> None:
    """Of data without noise all amplitudes with flat priors are found; with noise, none is biased by the flare."""
    rng = np.random.default_rng(8)
    spectra, flare, variance = rng.uniform(1, 2, (2, 50)), rng.uniform(0, 5, 50), rng.uniform(4, 9, 50)
    unknown = Nuisances(("dark", "light"), spectra, np.array([np.inf, np.inf]))
    variance[:5] = np.inf
    light = np.array([30.0, -7.0]) @ spectra
    np.testing.assert_allclose(unknown.fitted_dn(light + 3.0 * flare, variance, flare), light, rtol=1e-9)
    # A prior that excludes the level keeps it away.
    known = Nuisances(("dark", "light"), spectra, np.array([1e-9, 1e-9]))
    np.testing.assert_allclose(known.fitted_dn(light + 3.0 * flare, variance, flare), 0.0, atol=1e-9)


@pytest.mark.long
def test_memory_per_flare_is_bounded(engine: Engine) -> None:
    """Include bright flares, which fill many bins, and faint ones; a full histogram would take 2 MB."""
    sizes, payload = [], instrument(part=True, output_min_nm=300.0, output_max_nm=340.0)
    names = ("chi2", "chi2_element", "matched", "paper")
    # The first fills the caches.
    for number in (1, 6, 22):
        quiet, *flares = star(amplitudes=tuple(np.geomspace(0.001, 3.0, number)), payload=payload)
        tracemalloc.start()
        found = engine.detect(quiet, flares, realisations=20_000, seed=4, statistics=names)
        found.table(0.01)
        for statistic, flare in product(names, range(number)):
            found.roc(statistic, flare)
        sizes.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    # The distributions of a flare have a few thousand filled bins each, of 32768.
    assert (sizes[2] - sizes[1]) / 16 < 700_000


@pytest.mark.long
def test_many_flares_share_table_rows(engine: Engine) -> None:
    """Sixty flares have fewer rows each, so that the tables have no more than 100 000."""
    amplitudes = np.linspace(0.01, 0.03, 60)
    study = small(
        star=[{"library": "G2V", "magnitude": 7.4}],
        flare={"amplitudes": amplitudes.tolist()},
        run={"realisations": 10_000, "fap": 0.01, "statistics": ["chi2", "matched"]},
    )
    answer = detect(study, engine)
    # chi2 has a null and sixty flares, matched a null for each of its sixty; rows are shared among 2 x (60 + 60).
    assert len(answer.tails) == 100_000 // 240 * (61 + 120)
    nulls = answer.tails[(answer.tails["statistic"] == "matched") & (answer.tails["amplitude"] == 0.0)]
    for k in (0, 59):
        kept = nulls["value"][nulls["template"] == amplitudes[k]]
        own = answer.stars[0].detection.tail_samples("matched", template=k)
        np.testing.assert_array_equal(kept, own["value"][: len(kept)])
    assert len(answer.roc) <= 100_000
    assert set(answer.roc["amplitude"]) == set(amplitudes)
    for rows in answer.roc.group_by(["statistic", "amplitude"]).groups:
        assert (rows["fap"].min(), rows["fap"].max()) == (0.0, 1.0)
    assert answer.plot() is not None


def test_smoothing_in_chunks_equals_its_rows_across_a_gap_wider_than_it_reaches() -> None:
    rng, centres, pixels = np.random.default_rng(1), np.arange(0, 400, 8), np.arange(400)
    distance = centres[:, None] - pixels
    rows = np.exp(-((distance / 8) ** 2)) * (abs(distance) < 24) * ((pixels < 100) | (pixels >= 300))
    bands, finished = Smoothing(centres, np.eye(1), 8.0, csr_array(rows)).bands(416, 32)
    values, unfinished, sums = rng.standard_normal(416), np.zeros(bands.shape[1]), list[float]()
    for weights, part, n in zip(bands, values.reshape(-1, 32), finished, strict=True):
        unfinished += weights @ part
        sums += unfinished[:n].tolist()
        unfinished = np.append(unfinished[n:], np.zeros(n))
    np.testing.assert_allclose(sums, rows @ values[:400], rtol=1e-5, atol=1e-5)
    # Those within reach of 32 pixels, in fours; centres in the gap do not wait for its end.
    assert bands.shape[1] == 12
