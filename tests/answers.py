"""Answers that must be equal to the bit, and a small study that has some, for pools and clusters."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from typer.main import get_command

import mauvecl
from mauvecl import Detection, Expectation, Study, simulate
from mauvecl.cli import app

#: Questions, in the order of the command line: commands that are functions in Python, too.
VERBS = tuple(name for name in get_command(app.app).commands if name in mauvecl.__all__)  # type: ignore[attr-defined]
#: All statistics.
STATISTICS = ("chi2", "chi2_element", "chi2_pair", "matched", "uv_excess", "paper")
#: Realisations: several shards, the last a short one.
N = 30_000
FEW = ["run.realisations=2000", "run.fap=0.1", 'run.statistics=["matched"]', 'star=[{library="G2V", magnitude=7.4}]',
       "flare.amplitudes=[0.24]"]  # fmt: skip
#: Short questions, one to a verb whose answer takes less than seconds.
QUICK: dict[str, list[str]] = {
    "simulate": [],
    "snr": [],
    "exposure": ["signal.snr=10", "signal.wavelength_nm=300"],
    "detect": [],
    "limit": ["limit.power=0.9"],
    "gaussian": ['sweep.axes=[{quantity="exposure", values=[50, 300]}]'],
    "map": ['map.x={quantity="magnitude", start=6, stop=8, steps=2}',
            'map.y={quantity="amplitude", start=0.1, stop=0.3, steps=2}'],
    "change": ["nuisances.dark=0.1"],
    "visible": ['orbit.targets=["eps Eri", "AU Mic"]', "orbit.days=5"],
    "plan": ["plan.targets=[{name = 'eps Eri'}]", "orbit.days=31", "plan.completeness='closed form'"],
}  # fmt: skip


def detected(engine: Any, scene: list[Expectation], n: int = N, **how: Any) -> Detection:
    return engine.detect(scene[0], scene[1:], realisations=n, **{"seed": 5} | how)


def same(ours: Detection, theirs: Detection) -> None:
    """Check that every count, sum and extreme is equal to the bit."""
    assert ours._distributions.keys() == theirs._distributions.keys()
    for key, found in ours._distributions.items():
        other = theirs._distributions[key]
        np.testing.assert_array_equal(found.counts, other.counts)
        assert (found.sums, found.n) == (other.sums, other.n)
        assert (found.numbers.tolist(), found.filled.tolist()) == (other.numbers.tolist(), other.filled.tolist())
        assert found.undefined == other.undefined
    for key, kept in ours._samples.items():
        np.testing.assert_array_equal(kept.values, theirs._samples[key].values)
        np.testing.assert_array_equal(kept.realisations, theirs._samples[key].realisations)


def of_kind(messages: Iterable[str], kind: str) -> list[str]:
    """Return the messages of a kind, which programs compare in place of the sentence."""
    return [one for one in messages if getattr(one, "kind", "") == kind]


def expectations(study: Study) -> list[Expectation]:
    """Return what a study expects of its first star without and with each flare."""
    observed = simulate(study.model_copy(update={"star": study.star[:1]}), flaring=True).observations
    return [expectation for _, expectation, _ in observed]


def same_snr(one: Any, other: Any) -> None:
    ours, theirs = one.counts, other.counts
    assert ours.n == theirs.n
    np.testing.assert_array_equal(ours.clipped, theirs.clipped)
    assert ours.bins == theirs.bins


def small(**sections: Any) -> Study:
    """Return a study of two stars with the paper's conventions, of few pixels."""
    changes = {"output_min_nm": 300.0, "output_max_nm": 360.0}
    data: dict[str, Any] = {
        "star": [{"library": "G2V", "magnitude": 7.4}, {"library": "K3V", "magnitude": 6.0}],
        "flare": {"amplitudes": [0.05, 0.24]},
        "observation": {"changes": changes},
        "run": {"realisations": 10_000, "seed": 3, "fap": 0.01, "statistics": ["chi2", "matched"]},
    }
    observation = {"instrument": "mauvesim"} | sections.pop("observation", data["observation"])
    known = {"usual": False} | sections.pop("nuisances", {})
    return Study.build(data | sections | {"observation": observation, "nuisances": known}, "test")
