"""Surveys of stars that several tests share."""

from __future__ import annotations

from functools import cache

import numpy as np
from scenes import instrument

from mauvecl import SHAPES, Sky, Source, expect
from mauvecl.flares.frames import Components
from mauvecl.search.search import Survey
from mauvecl.search.templates import Bank, Baseline, Templates, frame_nuisances

DAVENPORT = SHAPES["davenport2014"]
KELVIN = tuple(np.geomspace(6000.0, 30_000.0, 49))
ONE = np.ones((1, 1))
KNOWN = Baseline(offset=False, slope=False, window_s=0.0)


@cache
def spectra(star, magnitude, kelvin=KELVIN, *, part=False):
    """Return one frame of a quiescent star and the DN added by flares of unit amplitude, for some 200 pixels."""
    source = Source.from_library(star).at_magnitude(magnitude)
    mauve, sky = instrument(part=part), Sky.of_brightness(22.1)
    quiet, *flares = (
        expect(s, mauve, exposure=5, sky=sky) for s in (source, *(source.flaring(1.0, k) for k in kelvin))
    )
    return quiet, np.array([flare.light_dn - quiet.light_dn for flare in flares])


def survey(stare, level, widths, *, star="G2V", magnitude=7.4, more=None, kelvin=10_000.0, part=False):
    """Return a star's survey and templates; the only flare spectrum is of `kelvin`."""
    quiet, flares = spectra(star, magnitude, part=part)
    _, one = spectra(star, magnitude, (kelvin,), part=part)
    templates = Templates.of(quiet, flares, KELVIN, nuisances=frame_nuisances(quiet, stare, more))
    components = Components(quiet, one / quiet.gain_dn_per_electron, templates.weights)
    bank = Bank(widths, templates.directions[list(templates.chosen)], DAVENPORT, 5.0, level)
    return Survey(components, stare, bank), templates
