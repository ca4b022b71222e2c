"""Compare the device's map from words to factors, integrated exactly, with the distribution of the prior."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from probes import Probes
from scenes import prepare
from scipy import stats

from mauvecl import Normal, Processes, Uniform
from mauvecl.device import selftest
from mauvecl.noise import layout, reference

Prior = Normal | Uniform
CONDITIONS = {"temperature_c": 21.0, "dark_slope_per_c": 0.0684, "light_loss": 0.34, "pointing_loss": 0.02}
PRIORS = [
    ("qe_scale", Normal(1.0, 0.01, 0.5, 1.5)),  # cut at 50 sd
    ("qe_scale", Normal(1.0, 1e-6, 0.5, 1.5)),  # narrower than float32 near one
    ("qe_scale", Normal(50.0, 1e-5, 40.0, 60.0)),  # far from one
    ("qe_scale", Normal(1.0, 0.3, 0.4, 1.6)),
    ("qe_scale", Normal(0.5, 0.1, 0.5, 5.0)),  # half a normal
    ("qe_scale", Normal(0.1, 0.03, 1.0, 5.0)),  # cut 30 sd away, an exponential
    ("qe_scale", Normal(90.0, 0.001, 0.5, 1.5)),  # and 88 500 sd on the other side
    ("qe_scale", Normal(1.0, 100.0, 0.99, 1.01)),  # flat between the cuts
    ("qe_scale", Uniform(0.5, 1.5)),
    ("qe_scale", Uniform(1.0, 1.0 + 1e-7)),
    ("light_loss", Normal(0.34, 0.01, 0.1, 0.6)),
    ("light_loss", Uniform(0.24, 0.44)),
    ("pointing_loss", Normal(0.0, 0.02, 0.0, 0.5)),
    ("pointing_loss", Uniform(0.0, 0.99)),
    ("jitter", Uniform(0.0, 0.05)),
    ("jitter", Normal(0.02, 0.001, 0.0, 0.5)),
    ("detector_temperature", Uniform(13.0, 21.0)),
    ("detector_temperature", Normal(21.0, 0.01, -40.0, 65.0)),
    ("detector_temperature", Normal(13.0, 10.0, -40.0, 65.0)),
    ("detector_temperature", Uniform(-40.0, 65.0)),
]


@cache
def factors(name: str, prior: Prior) -> tuple[np.ndarray, float]:
    """Return the table of one prior, made once for all tests, and the factor at its median."""
    scene = prepare([replace(selftest.toy(), conditions=CONDITIONS)], processes=Processes(**{name: prior}))
    return scene.priors[0], float(np.prod(scene.medians))


def drawn(probes: Probes, name: str, prior: Prior, tail: np.ndarray, upper: bool) -> np.ndarray:
    """Return the device's factors at probabilities from an end of the table."""
    table, centre = factors(name, prior)
    scaled = np.append(tail, np.full(-tail.size % 16, 0.5)) * 2**32
    word = np.minimum(np.floor(scaled), 2**31 - 1).astype(np.uint32)
    finer = np.minimum((scaled - word) * 2**23, 2**23 - 1).astype(np.uint32)
    # Bits above the finer ones belong to someone else.
    finer |= np.uint32(0xA5800000)
    less_one = probes.prior(~word if upper else word, finer, table).astype(np.float64)[: tail.size]
    return centre * (1 + less_one)


def law(prior: Prior) -> Any:
    if isinstance(prior, Uniform):
        return stats.uniform(prior.low, prior.high - prior.low)
    cuts = ((end - prior.mean) / prior.sd for end in (prior.low, prior.high))
    return stats.truncnorm(*cuts, prior.mean, prior.sd)


def inverted(name: str, factor: np.ndarray) -> np.ndarray:
    """Return the prior's values that belong to factors on the light or the dark."""
    if name == "detector_temperature":
        return 21.0 + np.log(factor) / 0.0684
    if name == "qe_scale":
        return factor
    return 1 - factor * (1 - CONDITIONS.get(name, 0.0))


def moments(x: np.ndarray, weight: np.ndarray) -> tuple[float, float, float, float]:
    mean = float(weight @ x)
    sd = float(np.sqrt(weight @ (x - mean) ** 2))
    return mean, sd, *(float(weight @ ((x - mean) / sd) ** k) for k in (3, 4))


CHANCES = [1e-9, 1e-7, 1e-5, 1e-3, 0.1]


@pytest.mark.parametrize(("name", "prior"), PRIORS)
def test_drawn_factors_have_the_moments_and_tails_of_the_prior(probes: Probes, name: str, prior: Prior) -> None:
    """Integrate the values of the prior over every cell of the table, without draws."""
    t, w = np.polynomial.legendre.leggauss(3)
    cells = np.arange(layout.PRIOR_NODES - 1)
    octave, part = np.divmod(cells, 2**layout.PRIOR_BITS)
    edges = np.append(0.0, np.ldexp(1.0 + part / 2**layout.PRIOR_BITS, octave - layout.PRIOR_FINEST))
    half = np.diff(edges)[:, None] / 2
    tail, weight = (edges[:-1, None] + half * (1 + t)).ravel(), (half * w).ravel()
    values = np.concatenate([drawn(probes, name, prior, tail, upper) for upper in (False, True)])
    mean, sd, skew, kurtosis = moments(inverted(name, values), np.append(weight, weight))
    wanted = moments(np.append(law(prior).ppf(tail), law(prior).isf(tail)), np.append(weight, weight))
    assert mean == pytest.approx(wanted[0], abs=1e-4 * wanted[1])
    assert sd == pytest.approx(wanted[1], rel=1e-4)
    assert skew == pytest.approx(wanted[2], abs=1e-3, rel=3e-4)
    assert kurtosis == pytest.approx(wanted[3], rel=3e-4)
    # The probability beyond the device's value is that of its word, to 0.1 % and the resolution of float32.
    table, centre = factors(name, prior)
    for upper in (False, True):
        for chance, value in zip(CHANCES, drawn(probes, name, prior, np.array(CHANCES), upper), strict=True):
            ulp = 2.0**-23 * float(np.abs(table).max()) * centre + 1e-15 * value
            near = inverted(name, value + ulp * np.array([-1.0, 0.0, 1.0]))
            beyond = law(prior).sf(near) if upper else law(prior).cdf(near)
            assert min(beyond) * (1 - 1e-3) <= chance <= max(beyond) * (1 + 1e-3), chance


def test_reference_has_the_same_bits(probes: Probes) -> None:
    """Compare at the ends of words, octaves and cells, and at random words."""
    table, _ = factors(*PRIORS[0])
    ends = np.concatenate([[2**k - 1, 2**k, 2**k + 1] for k in range(1, 32)]).astype(np.uint32)
    word, finer = (grid.ravel() for grid in np.meshgrid(np.concatenate([[0], ends, ~ends, [2**32 - 1]]), ends))
    word, finer = word.astype(np.uint32), finer.astype(np.uint32)
    extra = np.random.default_rng(8).integers(0, 2**32, (2, 2**15 - word.size % 16), dtype=np.uint32)
    word, finer = np.append(word, extra[0]), np.append(finer, extra[1])
    found = probes.prior(word, finer, table)
    np.testing.assert_array_equal(found.view(np.uint32), reference.quantile(word, finer, table).view(np.uint32))
    order = np.argsort(word.astype(np.float64) + (finer & np.uint32(0x7FFFFF)) / 2**23 * (word < 2**31), kind="stable")
    low = order[word[order] < 2**31]
    assert (np.diff(found[low]) >= 0).all()
