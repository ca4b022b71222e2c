"""Results of the NumPy reference for every case of the self-test.

    python tests/reference/known_answers.py

writes them into the package, where the self-test reads them.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))

from reference import stares, statistics
from scenes import prepare

from mauvecl import Nuisances
from mauvecl.detection import counts, requests, snr
from mauvecl.device import selftest
from mauvecl.flares import stare_scene
from mauvecl.noise import reference

FILE = Path(selftest.__file__).parent / "known_answers.npz"


def results(name: str, count: int) -> dict[str, np.ndarray]:
    """Return what `selftest.results` gives on a device."""
    if name in selftest.STARE_CASES:
        return stare_results(name, count)
    options, how = selftest.CASES[name]
    quiet, flare = selftest.toy(**options), selftest.toy(flare=0.3, **options)
    drawing = {key: value for key, value in how.items() if key != "nuisances"}
    scene, both = prepare([quiet], **drawing), prepare([quiet, flare], **drawing)
    index, seed = np.arange(selftest.START, selftest.START + count, dtype=np.uint64), selftest.SEED
    names = selftest.statistics_of(how)
    unknown = Nuisances.of(quiet, how["nuisances"]) if how.get("nuisances") else None
    hypotheses = requests.Hypotheses(quiet, (flare,), names, both, nuisances=unknown)
    plan = requests.plan_channels(hypotheses, range(1))
    sums = statistics.statistics(hypotheses, plan, index, seed)
    values = statistics.marginalise(sums, plan.subtractions)
    # The channels of the fast kernel, with zeros for statistics that it does not compute.
    fast = values[: plan.n_rows - len(plan.scales)].copy()
    fast[[2, 5]] = 0.0
    tally = counts.Tally(plan.grids[plan.keys.index(("chi2", "null", 0)) :][:1])
    counted, moments, _ = statistics.tally(values, tally.grids)
    tally.add(counted, moments, count)
    tally.add_far(0, values[tally.grids["channel"][0]])
    seen = statistics.histograms(scene, snr.observers(quiet, scene), snr.elements(quiet), index, seed)
    return {
        "raw": reference.realise(scene, index, seed).astype(np.int32),
        "clipped": statistics.clipped(scene, index, seed).sum(axis=(1, 2)).astype(np.uint32),
        "statistics": values,
        "fast statistics": fast,
        "histograms": selftest.histograms_of(seen),
        "tally": selftest.tally_of(tally.distribution(0)),
    }


def stare_results(name: str, count: int) -> dict[str, np.ndarray]:
    """Return the results of a case of stares."""
    components, stare, given = selftest.stare_case(name, count)
    index, seed = np.arange(selftest.START, selftest.START + count, dtype=np.uint64), selftest.SEED
    flares, frames = stare_scene.Flares.of(components, stare, given, None, count), range(stare.n_frames)
    made = {"pixels": stares.pixels, "cumulants": stares.sums}
    ours = {
        method: made[method](stare_scene.StareScene.of(components, stare, processes), flares, index, frames, seed)[0]
        for method, processes in selftest.METHODS.items()
    }
    return ours | {"noise of flares": stares.glow(stare_scene.StareScene.of(components, stare), index, frames, seed)}


def every_result(count: int) -> dict[str, np.ndarray]:
    """Return all results by the names of case and part."""
    made = ((name, results(name, count)) for name in (*selftest.CASES, *selftest.STARE_CASES))
    return {f"{name}: {part}": array for name, parts in made for part, array in parts.items()}


if __name__ == "__main__":
    np.savez_compressed(FILE, **every_result(selftest.COUNT))
