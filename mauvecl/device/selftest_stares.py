"""Checks of stares in the self-test: both methods against the NumPy reference."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mauvecl.device.engine import Engine
from mauvecl.device.program import SAME_BITS
from mauvecl.device.selftest_outcome import Check
from mauvecl.device.stare_engine import Stares
from mauvecl.device.toy_exposure import toy
from mauvecl.flares import reference as stare_reference
from mauvecl.flares.frames import Components
from mauvecl.flares.stare import Stare
from mauvecl.flares.stare_scene import Arrays, Flares, StareScene, StaresRequest
from mauvecl.noise.processes import NONE, CosmicRays, Processes

#: Small stares that run every branch: options of `toy`, unknowns of the stare, number of sums.
CASES: dict[str, tuple[dict[str, Any], dict[str, Any], int]] = {
    "stares that wobble": (
        {"pixels": 8, "unit": "electrons"},
        {"jitters": {"light": 0.02, "sky": 0.02, "temperature": 0.1}, "offsets": {"star": 0.02, "temperature": 0.2}},
        3,
    ),
    "skewed stares": ({"pixels": 4, "dark": 120.0, "photon_noise": "poisson"}, {}, 1),
}


def stares(engine: Engine, first: int, count: int, seed: int) -> Iterator[Check]:
    """Compare every frame of `count` stares with flares, numbered from `first`."""
    index = np.arange(first, first + count, dtype=np.uint64)
    for name, (payload, wobble, n_sums) in CASES.items():
        quiet, flare = toy(frames=1, **payload), toy(frames=1, flare=1.0, **payload)
        components = Components.of(quiet, [flare], np.vander(np.linspace(0.1, 1.0, payload["pixels"]), n_sums).T)
        stare = Stare.of(100.0, gaps=[(10.0, 40.0)], **wobble)
        given = np.linspace(0.0, 2.0, count * stare.n_frames).reshape(count, stare.n_frames, 1)
        flares, frames = Flares.of(components, stare, given, None, count), range(stare.n_frames)
        for method, slow in (("pixels", stare_reference.pixels), ("cumulants", stare_reference.sums)):
            processes = Processes(cosmic_rays=CosmicRays(rate_per_cm2_s=300.0)) if method == "pixels" else NONE
            how: dict[str, Any] = {"seed": seed, "method": method, "processes": processes}
            ours = Stares(engine.open_device).frames(components, stare, given, first=first, count=count, **how)
            theirs = slow(StareScene.of(components, stare, processes), flares, index, frames, seed)[0]
            apart = float(np.max(np.abs(ours - theirs).max(axis=(0, 1)) / theirs.std(axis=(0, 1))))
            if engine.device.promise == SAME_BITS:
                passed, text = bool((ours == theirs).all()), f"{ours.size} sums, {apart:.2g} sigma apart"
            else:
                passed, text = apart < 0.2, f"weaker promise: {apart:.2g} sigma apart"
            yield Check(f"same bits as the NumPy reference: {name}, by {method}", passed, text)
        request = StaresRequest(components, stare, count, seed, start=first, reduction=Glow(), glow=True)
        ours = Stares(engine.open_device).reduced(request)["glow"]
        theirs = stare_reference.glow(StareScene.of(components, stare), index, frames, seed)
        apart = float(np.abs(ours - theirs).max())
        passed = bool((ours == theirs).all()) if engine.device.promise == SAME_BITS else apart < 0.2
        yield Check(f"same bits as the NumPy reference: {name}, noise of flares", passed, f"{apart:.2g} apart")


@dataclass(frozen=True)
class Glow:
    """Reduction that keeps the noise factors of flares."""

    adds: ClassVar[bool] = False

    def __call__(self, values: NDArray[np.float32], first: int, glow: NDArray[np.float32]) -> Arrays:
        """Return the factors as ``glow``."""
        return {"glow": glow.copy()}
