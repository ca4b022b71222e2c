"""Stares of the device, compared bit by bit with the NumPy reference and with their own splits."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
from marks import long_but
from reference import stares as stare_reference
from refusals import refused
from scenes import NEAR, instrument, star

from mauvecl import CosmicRays, Engine, Processes, Stare, Stares, Study
from mauvecl.detection import requests
from mauvecl.flares import stare_scene
from mauvecl.flares.frames import Components

SEED = 2**63 + 12345
#: Around the boundary of the counter's first word.
FIRST, COUNT = 2**32 - 24, 40

WOBBLE: dict[str, Any] = {
    "jitters": {"light": 0.02, "sky": 0.03, "temperature": 0.1},
    "offsets": {"star": 0.01, "light": 0.02, "sky": 0.05, "temperature": 0.3},
    "drifts": {"star": 0.02, "temperature": 0.5},
    "thermal": 0.5,
    "gaps": [(20.0, 60.0)],
}
DRIFTS = Study().with_settings(["stare.pointing={rate_per_h=100.0, duration_s=30.0, depth=0.9}"]).stare.pointing
DRIFTING: dict[str, Any] = {"pointing": DRIFTS}
#: Payload, stare, sums, flare temperatures, scenarios, further words.
CASES: dict[str, tuple[dict[str, Any], dict[str, Any], int, int, int, dict[str, Any]]] = {
    "plain": ({}, {}, 1, 0, 0, {}),
    "all that wobbles": ({}, WOBBLE, 3, 2, 0, {}),
    "jitter alone": ({}, {"jitters": {"light": 0.03}}, 2, 1, 0, {}),
    "unknown alone": ({}, {"offsets": {"temperature": 1.0}}, 5, 0, 0, {}),
    "electrons": ({"name": "mauve"}, WOBBLE, 2, 1, 3, {}),
    "cold, fourth cumulants": ({"temperature_c": -20.0, "output_max_nm": 303.0}, WOBBLE, 2, 1, 0, {}),
    "Poisson photons": ({"photon_noise": "poisson"}, WOBBLE, 3, 1, 0, {}),
    "neighbours": ({}, WOBBLE, 3, 2, 0, {}),
    "pointing drifts": ({}, WOBBLE | DRIFTING, 3, 2, 3, {}),
    "pointing drifts alone": ({}, DRIFTING, 2, 1, 0, {}),
    "cosmic rays": ({}, WOBBLE, 2, 1, 2, {"processes": Processes(cosmic_rays=CosmicRays(rate_per_cm2_s=200.0))}),
}


def case(name: str) -> tuple[Components, Stare, Any, Any, dict[str, Any]]:
    """Return components, stare, flares of each stare, amplitudes and further arguments."""
    payload, wobble, n_sums, n_flares, n_scenarios, more = CASES[name]
    options = {"output_min_nm": 300.0, "output_max_nm": 312.0} | payload
    used = instrument(options.pop("name", "mauvesim"), **options)
    near = NEAR if name == "neighbours" else None
    quiet, *flares = star(amplitudes=(0.5, 2.0)[:n_flares], exposure=5.0, payload=used, neighbours=near)
    wavelength = quiet.wavelength_nm - quiet.wavelength_nm.mean()
    weights = np.array([np.cos(k * wavelength / wavelength.max()) + 0.2 for k in range(n_sums)])
    stare = Stare.of(110.0, temperature_c=used.temperature_c, **wobble)
    rng = np.random.default_rng(5)
    flare = rng.uniform(0.0, 2.0, (COUNT, stare.n_frames, n_flares)) if n_flares else None
    amplitudes = rng.uniform(0.0, 3.0, (n_scenarios, COUNT)) if n_scenarios else None
    return Components.of(quiet, flares, weights), stare, flare, amplitudes, more


@pytest.fixture(scope="module", params=["vectors", pytest.param("scalar", marks=pytest.mark.long)])
def stares(request: pytest.FixtureRequest, engine: Engine) -> Stares:
    """Return stares with vectors, as on processors, and with one stare or frame per work-item, as on a GPU."""
    return Stares(engine.open_device) if request.param == "vectors" else Stares(width=1)


@pytest.mark.long
@pytest.mark.parametrize("name", long_but(CASES, "plain", "all that wobbles", "neighbours", "pointing drifts"))
@pytest.mark.parametrize("method", ["pixels", "cumulants"])
def test_stares_equal_the_reference(stares: Stares, name: str, method: Any) -> None:
    components, stare, flare, amplitudes, more = case(name)
    if more and method == "cumulants":
        with refused("method", "cumulants"):
            stares.frames(components, stare, flare, count=COUNT, seed=SEED, method=method, **more)
        return
    how: dict[str, Any] = {"seed": SEED, "method": method, "amplitudes": amplitudes, **more}
    found = stares.frames(components, stare, flare, first=FIRST, count=COUNT, **how)
    scene = stare_scene.StareScene.of(components, stare, **more)
    flares = stare_scene.Flares.of(components, stare, flare, amplitudes, COUNT)
    numbers = np.arange(FIRST, FIRST + COUNT, dtype=np.uint64)
    frames = range(0, stare.n_frames, 1 if method == "cumulants" else 6)
    drawn = {"pixels": stare_reference.pixels, "cumulants": stare_reference.sums}[method]
    ours = drawn(scene, flares, numbers, frames, SEED)
    np.testing.assert_array_equal(found[..., list(frames), :], ours if amplitudes is not None else ours[0])
    assert found.std() > 0


@pytest.mark.long
@pytest.mark.parametrize("method", ["pixels", "cumulants"])
def test_splitting_changes_no_bit(engine: Engine, method: Any) -> None:
    """Check that stares depend on seed and number alone, and frames on their time, however calls are divided."""
    components, stare, flare, amplitudes, _ = case("electrons")
    how: dict[str, Any] = {"seed": SEED, "method": method}

    def part(a: int, b: int, tile: int | None = None) -> np.ndarray:
        some: dict[str, Any] = {"first": FIRST + a, "count": b - a, "amplitudes": amplitudes[:, a:b]}
        return Stares(engine.open_device, tile=tile).frames(components, stare, flare[a:b], **some, **how)

    whole = part(0, COUNT)
    for tile in (None, 16):
        parts = [part(a, b, tile) for a, b in ((0, 1), (1, 23), (23, 40))]
        np.testing.assert_array_equal(np.concatenate(parts, axis=1), whole)
    device, scaled = Stares(engine.open_device), flare * amplitudes[1][:, None, None]
    alone = device.frames(components, stare, scaled, first=FIRST, count=COUNT, **how)
    # The device multiplies in float32 what is multiplied in float64 here: whole DN may differ now and then.
    np.testing.assert_allclose(alone, whole[1], atol=5.0)
    # The frames that a gap leaves are those of the stare without it.
    warm = {"temperature_c": components.quiet.conditions["temperature_c"]}
    gapless, gapped = (Stare.of(110.0, gaps=gaps, **warm) for gaps in ((), [(20.0, 60.0)]))
    both = [device.frames(components, s, None, count=2, **how) for s in (gapless, gapped)]
    np.testing.assert_array_equal(both[0][:, gapped.numbers], both[1])


@dataclass(frozen=True)
class Beside:
    """Keep the statistics and the sums for flares unchanged."""

    adds: ClassVar[bool] = False

    def __call__(self, values: np.ndarray, first: int, glow: np.ndarray) -> dict[str, np.ndarray]:
        return {"values": values.copy(), "glow": glow.copy()}


@pytest.mark.long
@pytest.mark.parametrize("method", ["pixels", "cumulants"])
@pytest.mark.parametrize("name", ["plain", "all that wobbles", "unknown alone"])
def test_sums_for_flares_equal_the_reference(stares: Stares, name: str, method: Any) -> None:
    """Check their own normals and the light of the frames, for any share of drawn stares."""
    components, stare, *_ = case(name)
    how: dict[str, Any] = {"start": FIRST, "method": method, "reduction": Beside(), "glow": True}
    asked = stare_scene.StaresRequest(components, stare, COUNT, SEED, **how)
    found, scene = stares.reduced(asked), stare_scene.StareScene.of(components, stare)
    numbers, frames = np.arange(FIRST, FIRST + COUNT, dtype=np.uint64), range(stare.n_frames)
    np.testing.assert_array_equal(found["glow"], stare_reference.glow(scene, numbers, frames, SEED))
    whole = stares.frames(components, stare, first=FIRST, count=COUNT, seed=SEED, method=method)
    np.testing.assert_array_equal(found["values"], whole)
    part = stares.reduced(asked, requests.Shard(0, FIRST + 5, 21))
    np.testing.assert_array_equal(part["glow"], found["glow"][5:26])
