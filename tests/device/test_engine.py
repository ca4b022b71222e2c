"""Comparison of the engine with the NumPy reference, with its own splits, and with closed-form moments."""

from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import Mock, call

import numpy as np
import pytest
from answers import same
from commands import started
from marks import long_but
from reference import statistics as numpy_kernels
from scenes import instrument, star

from mauvecl import Comparison, CosmicRays, Engine, Linear, Normal, PixelMap, Processes, Uniform
from mauvecl.detection import counts, requests
from mauvecl.device import selftest
from mauvecl.device.launches import scene_launches
from mauvecl.noise import layout, reference
from mauvecl.noise.scene import prepare

RAYS = CosmicRays(rate_per_cm2_s=200.0)
PRIORS = Processes(
    jitter=Uniform(0.0, 0.05),
    detector_temperature=Uniform(13.0, 21.0),
    light_loss=Normal(0.34, 0.1, 0.1, 0.6),
    pointing_loss=Uniform(0.0, 0.05),
    qe_scale=Normal(1.0, 0.3, 0.4, 1.6),
)
#: Options of the noise model beyond those of the self-test, which runs every branch on equal pixels: a payload at each
#: end of its temperatures, a rail, quiet readouts, priors of every kind, uneven pixels.
CASES = {
    "stack": {},
    "cold": {"temperature_c": -30.0, "exposure": 5.0},
    "cold electrons": {"name": "mauve", "temperature_c": -20.0, "exposure": 10.0},
    "frames": {"exposure": 15.0, "mode": "frames"},
    "at the rail": {"exposure": 10.0, "magnitude": -0.7},
    "apart, quiet readout": {"read_noise_dn": 0.5, "name": "mauve", "exposure": 5.0, "magnitude": 14.0},
    "apart, electrons, frames": {"recipe": "apart", "name": "mauve", "exposure": 10.0, "mode": "frames"},
    "noiseless": {"read_noise_dn": 0.0, "dark_scale_dn_per_s": 0.0, "magnitude": 30.0, "exposure": 5.0},
    "uneven": {"pixel_map": PixelMap.made_up(2048, seed=5, hot_share=0.05)},
    "uneven, apart": {"pixel_map": PixelMap.made_up(2048, seed=5), "recipe": "apart", "temperature_c": -9.0,
                      "exposure": 5.0},
    "uneven, pairs of two ways": {"pixel_map": PixelMap.made_up(2048, seed=1), "read_noise_dn": 1.0,
                                  "temperature_c": 9.0, "exposure": 5.0},
    "cosmic rays, frames": {"processes": Processes(cosmic_rays=RAYS), "mode": "frames", "exposure": 10.0},
    "priors": {"processes": PRIORS},
    "priors, electrons, frames": {"processes": PRIORS, "name": "mauve", "mode": "frames", "exposure": 25.0},
    "jitter, one frame, rays": {"processes": Processes(cosmic_rays=RAYS, jitter=Uniform(0.0, 0.05)), "exposure": 5.0},
}  # fmt: skip
#: Cases and further options of the statistics: comparisons with noisy exposures and estimated variances, and
#: marginalised unknowns, of which the last is in `make test`.
COMPARED: list[tuple[str, dict[str, Any]]] = [
    ("uneven", {}),
    ("priors, electrons, frames", {}),
    ("stack", {"comparison": Comparison(1)}),
    ("stack", {"comparison": Comparison(0, True)}),
    ("at the rail", {"comparison": Comparison(2, True)}),
    ("apart, electrons, frames", {"comparison": Comparison(2, True)}),
    ("cold", {"nuisances": {"dark": 0.1, "light": 0.02, "tilt": float("inf")}}),
    ("stack", {"nuisances": {"dark": 0.1, "light": 0.02, "tilt": float("inf")}}),
]


def case(name: str) -> tuple[list, dict]:
    options = dict(CASES[name])
    how = {key: options.pop(key) for key in ("mode", "recipe", "processes") if key in options}
    exposure, magnitude = options.pop("exposure", 50.0), options.pop("magnitude", 7.4)
    payload = instrument(options.pop("name", "mauvesim"), part=True, **options)
    return star(magnitude=magnitude, amplitudes=(0.081, 0.24), exposure=exposure, payload=payload), how


@pytest.fixture(scope="module", params=["vectors", pytest.param("scalar", marks=pytest.mark.long)])
def any_width(request: pytest.FixtureRequest, engine: Engine, one_by_one: Engine) -> Engine:
    """Return the engine as CPUs run it, and as GPUs do, with one realisation per work-item."""
    return engine if request.param == "vectors" else one_by_one


#: Realisations that cross the boundary of the counter's first word.
START = 2**32 - 24
INDEX = np.arange(START, START + 40, dtype=np.uint64)
SEED = 2**63 + 12345


@cache
def _reference_raw(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Compute raw counts and each realisation's number of clipped samples with the reference, once for both widths."""
    (quiet, *_), how = case(name)
    scene = prepare([quiet], **how)
    return reference.realise(scene, INDEX, SEED), numpy_kernels.clipped(scene, INDEX, SEED).sum(axis=(1, 2))


@pytest.mark.parametrize("name", long_but(CASES, "stack", "apart, electrons, frames"))
def test_raw_spectra_equal_reference(any_width: Engine, name: str) -> None:
    """`make test` has a joint draw, and separate draws frame by frame."""
    (quiet, *_), how = case(name)
    raw, clipped = any_width.realise_and_count(quiet, start=START, count=INDEX.size, seed=SEED, **how)
    for ours, expected in zip((raw, clipped), _reference_raw(name), strict=True):
        np.testing.assert_array_equal(ours, expected)
    assert (raw.dtype == np.uint16) == (quiet.n_frames == 1)


@pytest.mark.long
def test_raw_sums_above_float32_integers_are_exact(engine: Engine) -> None:
    """Sum 400 frames that lose up to 48 000 DN each."""
    how = {"mode": "frames", "processes": Processes(light_loss=Uniform(0.0, 0.9))}
    quiet = selftest.toy(20, 400, light=90_000.0)
    raw, scene = engine.realise(quiet, count=40, seed=SEED, **how), prepare([quiet], **how)
    assert np.abs(raw - 400 * scene.base_dn[0]).max() > 2**24
    np.testing.assert_array_equal(raw, reference.realise(scene, np.arange(40, dtype=np.uint64), SEED))


@pytest.mark.parametrize(("name", "more"), long_but(COMPARED, COMPARED[-1]))
def test_statistics_equal_reference(any_width: Engine, name: str, more: dict[str, Any]) -> None:
    """Compare all statistics of two flares; the self-test compares their histograms and tallies as well."""
    (quiet, *flares), how = case(name)
    names: tuple[Any, ...] = tuple(requests.STATISTICS)
    if "nuisances" in more:
        # Of those that can be marginalised, `uv_excess` would be degenerate with a flat dark and the star's light.
        own = Linear("own", np.linspace(0.0, 1.0, quiet.wavelength_nm.size))
        names = (*(one for one in names if not requests.STATISTICS[one].paired and one != "uv_excess"), own)
    kind = {"statistics": names, "start": START, "seed": SEED, **how, **more}
    asked = requests.DetectRequest.of(quiet, tuple(flares), INDEX.size, **kind).hypotheses
    plan = requests.plan_channels(asked, range(len(flares)))
    sums = numpy_kernels.statistics(asked, plan, INDEX, SEED)
    values = any_width.statistic_values(quiet, flares, count=INDEX.size, **kind)
    np.testing.assert_array_equal(values, numpy_kernels.marginalise(sums, plan.subtractions))
    if "nuisances" in more:
        assert (values[0] < sums[0]).all(), "the subtraction changes the statistics"
    if more == {"comparison": Comparison(1)}:
        # Against one exposure, chi2 and chi2_pair differ only in the order of summation.
        np.testing.assert_allclose(values[0], values[2], rtol=1e-5)


def test_tally_counts_values_at_the_ends_of_its_bins(any_width: Engine) -> None:
    """Give the kernel values on each side of each end of the fine bins, which draws of chi2 seldom meet."""
    # Each stands once in a block of the kernel's loop and once after it; the host counts steps of the last bin.
    half, fine = layout.BINS // 2, 2**layout.FINE_BITS
    inner, end = (half - 1) * fine, half * fine
    # Halves are rounded to even steps.
    steps = [inner - 1, inner - 0.5, inner, -inner, -inner - 0.5, -inner - 1, end - 1, end, -end, -end - 1, 0]
    far = [np.nan, np.inf, -np.inf]
    values = np.array([*steps, *far, 0, 0, *steps, *far], np.float32)
    tally = counts.Tally(counts.grids_of([0], [0.0], [layout.STEPS_PER_SIGMA]))
    tile = any_width._tiles.at(0, values.size, 4096)
    with scene_launches(any_width.open_device, prepare([selftest.toy()]), 1) as launches:
        launches._named["values"] = launches.upload(np.resize(values, tile.size))
        launches.tally(tile, tally)
        launches.flush(tally)
    found, step = tally.distribution(0), np.rint(values)
    inside = step[(step >= -inner) & (step < inner)].astype(np.int64)
    np.testing.assert_array_equal(found.counts, np.bincount(inside // fine + half, minlength=layout.BINS))
    assert found.sums[:2] == (inside.sum(), (inside**2).sum())
    assert (found.n_far, found.undefined) == (values.size - inside.size - 6, 6)
    histogram, sums, outside = numpy_kernels.tally(values[None], tally.grids)
    np.testing.assert_array_equal(histogram[0, 1:-1], found.counts[1:-1])
    assert (*sums[0], outside[0]) == (*found.sums[:2], values.size - inside.size)


@pytest.mark.parametrize("tile", [16, 64, 1024, 4096])
def test_tile_size_does_not_affect_results(engine: Engine, tile: int) -> None:
    """Progress is reported before the first tile and after each, and may stop the work, after which others work."""
    (quiet, *flares), _ = case("stack")
    how = {"realisations": 3001, "start": 77, "seed": 6, "statistics": tuple(requests.STATISTICS)}
    tiled = Engine(tile=tile, progress=(seen := Mock()))
    same(tiled.detect(quiet, flares, **how), engine.detect(quiet, flares, **how))
    assert (seen.call_args_list[0], seen.call_args) == (call(0, 3001), call(3001, 3001))
    # Tiles end at multiples of their size, which is at least 64.
    assert seen.call_count == 2 + 3077 // max(tile, 64) - 77 // max(tile, 64)
    seen.side_effect = [KeyboardInterrupt, None, None]
    with pytest.raises(KeyboardInterrupt):
        tiled.realise(quiet, count=5000, seed=1)
    assert tiled.realise(quiet, count=3, seed=1).shape[0] == 3


@pytest.mark.long
def test_number_of_threads_does_not_affect_results(tmp_path: Path) -> None:
    for threads in ("1", "2"):
        words = f"detect -s G2V -m 7.4 -a 0.081,0.24 -n 20000 --fap 0.01 --no-pictures --output {threads}".split()
        started(*words, folder=tmp_path, POCL_MAX_PTHREAD_COUNT=threads)
    one, two = ((tmp_path / threads / "detection.ecsv").read_bytes() for threads in ("1", "2"))
    assert one == two


def test_flares_in_batches_equal_single_flares(engine: Engine) -> None:
    quiet, *flares = star(amplitudes=tuple(np.linspace(0.01, 0.3, 18)), payload=instrument(part=True))
    together = engine.detect(quiet, flares, realisations=2000, seed=8)
    for k in (0, 14, 15, 17):
        alone = engine.detect(quiet, [flares[k]], realisations=2000, seed=8)
        for statistic in ("chi2", "chi2_element", "matched"):
            for flare in (None, 0):
                wanted = alone.distribution(statistic, flare)
                ours = together.distribution(statistic, None if flare is None else k, template=k)
                np.testing.assert_array_equal(ours.counts, wanted.counts)
