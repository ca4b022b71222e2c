"""Stacks against their frames; frames are drawn singly where rounding does not act as noise."""

from typing import Any

import exact
import numpy as np
import pytest
from refusals import refused
from scipy import optimize

from mauvecl import Engine, Expectation, Processes, Uniform
from mauvecl.noise.scene import prepare

#: Smallest number of draws of one pixel that distinguish an allowed stack from its frames, by exact convolution.
SOONEST = 4e13


def quiet(read: float, frames: int, **kind: Any) -> Expectation:
    """Return eight pixels whose bias has different fractions of a DN."""
    return exact.flat(8, frames, read=read, **({"bias": 600.0 + np.arange(8) / 8} | kind))


@pytest.mark.long
def test_worst_allowed_stack_is_indistinguishable_from_frames() -> None:
    """Search read noise, counts, gain, frames and phase for the stack that is easiest to distinguish."""
    tried = 0

    def merit(point: np.ndarray) -> float:
        nonlocal tried
        read, dark, light, gain, frames = 10.0 ** point[:5]
        kind = {
            "unit": "electrons" if point[5] > 0.5 else "DN",
            "photon_noise": "poisson" if point[6] > 0.5 else "gaussian",
            "bias": 600.0 + point[7],
        }
        x = quiet(read, round(frames), dark=dark, photons=light if point[2] > -2 else 0.0, gain=gain, **kind)
        if prepare([x]).frames:
            return 30.0
        tried += 1
        return float(np.log10(exact.draws_to_tell(exact.of_frames(x), exact.of_stack(x))))

    bounds = [(-0.8, 0.8), (-3.0, 1.5), (-2.2, 2.0), (-1.5, 0.5), (np.log10(2), 2.0), (0, 1), (0, 1), (0, 1)]
    found = optimize.differential_evolution(merit, bounds, rng=1, popsize=10, maxiter=25, polish=False)
    assert tried > 300
    assert SOONEST < 10**found.fun < 3 * SOONEST


def test_nearly_noiseless_detector_is_drawn_frame_by_frame(engine: Engine) -> None:
    """Compare with frames whose stack would have 118 times their variance; fails once in 1e5 seeds."""
    x = quiet(0.15, 20)
    rows = 40_000
    assert prepare([x]).frames
    with refused("mode", "'stacked'"):
        prepare([x], mode="stacked")
    raw = engine.realise(x, count=rows, seed=5).astype(float)
    for pixel in range(8):
        p = exact.of_frames(x, pixel)
        dn = exact.span(x, pixel)[0] + np.arange(p.size)
        mean = p @ dn
        variance, fourth = (p @ (dn - mean) ** k for k in (2, 4))
        assert abs(raw[:, pixel].mean() - mean) < 5 * np.sqrt(variance / rows) + 1e-9
        spread = np.sqrt(max(fourth - variance**2, 0.0) / rows)
        assert abs(((raw[:, pixel] - mean) ** 2).mean() - variance) < 5 * spread + 1e-9
    # The least light that a prior allows decides, whose photons smooth the rounding least.
    smooth = quiet(0.1, 100, photons=60.0)
    assert not prepare([smooth]).frames
    assert prepare([smooth], processes=Processes(qe_scale=Uniform(0.01, 1.0))).frames
