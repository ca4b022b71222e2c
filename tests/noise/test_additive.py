"""Additive processes: every row of the registry, and a second process registered for a test."""

import json
import os
import sys

import pytest
from processes import python

from mauvecl.noise import layout

#: A toy process that is registered before anything else is imported, as a new row of the registry is.
TOY = """
import json, sys
from typing import ClassVar
import numpy as np
import mauvecl.noise.disturbances as additive

class Bursts(additive.AdditiveProcess):
    "Bursts of the dark current: a Poisson number of bursts with exponentially distributed electrons."
    stream: ClassVar[int] = 40
    label: ClassVar[str] = "bursts"
    per_s: float = 0.02
    mean_electrons: float = 300.0
    def charge(self, seconds):
        size = 1 << 15
        one = np.exp(-np.arange(size) / self.mean_electrons)
        one[0] = 0.0
        spectrum = np.exp(self.per_s * seconds * (np.fft.rfft(one / one.sum()) - 1.0))
        return np.maximum(np.fft.irfft(spectrum, size), 0.0)[: self.most_electrons(seconds) + 1]
    def most_electrons(self, seconds):
        return 12_000

additive.ADDITIVE["bursts"] = Bursts
from mauvecl import Engine, Processes, Stare, Stares, Study, simulate
from mauvecl.device.selftest import toy
from mauvecl.flares.frames import Components
from mauvecl.flares.stare_scene import Flares, StareScene
from reference import stares as twin
from mauvecl.noise import reference
from mauvecl.noise.scene import prepare

N = 4000
sections = {"bursts": {"per_s": 0.02}, "cosmic_rays": {"rate_per_cm2_s": 300.0}}
study = Study.build({"star": [{"library": "G2V", "magnitude": 7.4}], "processes": sections}, "t")
both = study.processes
quiet, engine, index = toy(64, 3), Engine(), np.arange(N, dtype=np.uint64)
bursts = Processes(bursts=both.bursts)
clean, hit, all_ = (engine.realise(quiet, count=N, seed=2, processes=p) for p in (Processes(), bursts, both))
few = index[:8]
charge = both.bursts.charge(15.0)
electrons = np.arange(charge.size)
mean = float(charge @ electrons)
gain = quiet.gain_dn_per_electron
one = toy(64, 1)
c, stare = Components.of(one, [], np.ones((1, 64))), Stare.of(50.0)
frames = Stares(engine.open_device).frames(c, stare, count=8, seed=2, processes=both)
scene = StareScene.of(c, stare, both)
slow = twin.pixels(scene, Flares.of(c, stare, None, None, 8), few, range(stare.n_frames), 2)[0]

def same(drawn, processes):
    return bool((drawn[:8] == reference.realise(prepare([quiet], processes=processes), few, 2)).all())

print(json.dumps({
    "keys": list(Processes.model_fields)[:2],
    "kept": Study.build(__import__("tomllib").loads(study.toml()), "t") == study,
    "same": same(hit, bursts) and same(all_, both),
    "stares": bool((frames == slow).all()),
    "added": float(np.mean((hit - clean) / gain)), "mean": mean,
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
    assert found["same"]
    assert found["stares"]
    assert found["column"]
    assert found["particles"] == ["cosmic rays"]
    # Rounding adds 0.03 electrons at most; five standard errors fail once in 2e6.
    assert abs(found["added"] - found["mean"]) < 5 * found["sd"] + 0.03
    assert "bursts" not in layout.STREAMS
