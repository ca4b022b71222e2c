"""Spectral weights of a frame."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from searches import spectra

from mauvecl import Stare
from mauvecl.lightcurve.search.templates import TEMPERATURES_K, Templates, frame_nuisances

CASES = {
    "known": {},
    "jitter": {"light": 0.01, "dark": 0.02},
    "free": {"dark": np.inf, "light": np.inf},
}


@pytest.fixture(params=["G2V", "M3V"])
def star(request):
    return spectra(request.param, 7.4 if request.param == "G2V" else 9.0)


@pytest.mark.parametrize("case", CASES)
def test_sums_have_covariance_one(star, case):
    """Check W C W^T = 1 for finite spreads, and that projected directions change no sum."""
    quiet, flares = star
    nuisances = frame_nuisances(quiet, Stare.of(100.0), CASES[case])
    t = Templates.of(quiet, flares, TEMPERATURES_K, nuisances=nuisances)
    covariance = (t.weights * quiet.variance_dn2) @ t.weights.T
    if nuisances:
        along = t.weights @ nuisances.spectra.T
        known = np.isfinite(nuisances.sd)
        covariance = covariance + (along[:, known] * nuisances.sd[known] ** 2) @ along[:, known].T
        assert np.abs(along[:, ~known]).max(initial=0) < 1e-8 * np.abs(t.weights @ quiet.signal_dn).max()
    assert np.abs(covariance - np.eye(3)).max() < 1e-8


@pytest.mark.parametrize("case", CASES)
def test_few_temperatures_lose_little_snr(star, case):
    """Use flares of 6000-20 000 K between the templates; time may cost 1.3 % of the S/N."""
    quiet, flares = star
    nuisances = frame_nuisances(quiet, Stare.of(100.0), CASES[case])
    t = Templates.of(quiet, flares, TEMPERATURES_K, nuisances=nuisances)
    unit = t.directions[list(t.chosen)]
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    cool = flares[np.array(TEMPERATURES_K) <= 20_100]
    # Between two temperatures the spectrum is their mean, to a thousandth.
    between = np.vstack([cool, (cool[1:] + cool[:-1]) / 2])
    own = np.array([Templates.of(quiet, one[None], (1.0,), nuisances=nuisances).best[0] for one in between])
    kept = (t.of_flares(between) @ unit.T).max(axis=1) / own
    assert t.loss.max() < 0.006
    assert (1 - kept).max() < 0.007
    # Two sums are not enough for this, and one is far from it.
    assert Templates.of(quiet, flares, TEMPERATURES_K, nuisances=nuisances, rank=1).loss.max() > 0.1


def test_impossible_templates_raise(star):
    quiet, _ = star
    stare = Stare.of(100.0)
    light = frame_nuisances(quiet, stare, {"light": np.inf})
    with refused("nuisances", value="light"):
        Templates.of(quiet, light.spectra, (1.0,), nuisances=light)
    jittered = Stare.of(100.0, jitters={"light": 0.01, "temperature": 0.1})
    assert frame_nuisances(quiet, stare) is None
    assert frame_nuisances(quiet, jittered).names == ("light", "dark")
    assert frame_nuisances(quiet, jittered, {"dark": np.inf}).sd.tolist() == [0.01, np.inf]
