"""Photosphere and magnitude of each star of a study, and processes in its stares."""

from typing import Any

import numpy as np
import pytest
from answers import same, small

from mauvecl import Engine, Instrument, Source, Stares, Study, detect, expect, simulate, stare

PART = {"changes": {"output_min_nm": 300.0, "output_max_nm": 330.0}}


def study(*stars: dict[str, Any], **flare: Any) -> Study:
    given = [{"magnitude": 8.0} | star for star in stars]
    return Study.build({"star": given, "flare": {"amplitudes": [0.1]} | flare, "observation": PART}, "test").paper()


def light(asked: Study) -> list[np.ndarray]:
    few = asked.with_settings(["run={realisations=500, fap=0.3, statistics=['matched']}"])
    return [one.detection.flares[0].source_electrons for one in detect(few).stars]


def test_each_star_has_its_own_photosphere() -> None:
    """The default is the library's temperature; a star's own temperature overrides it, as does that of the flare."""
    both = light(study({"library": "G2V"}, {"library": "M3V"}, geometry="replaces"))
    for found, name, kelvin in zip(both, ("G2V", "M3V"), (5636.0, 3295.0), strict=True):
        star = Source.from_library(name).at_magnitude(8.0)
        flaring = star.flaring(0.1, geometry="replaces", photosphere_temperature=kelvin)
        wanted = expect(flaring, Instrument.load("mauvesim").with_(**PART["changes"]), exposure=50)
        np.testing.assert_allclose(found, wanted.source_electrons, rtol=1e-12)
    # In a stare it is below every flare, of which the first is as far from the start as from the next.
    few = ["stare={duration_s=60, search=false, bands_nm=[]}", "flare.amplitudes=[0.1, 0.2]"]
    stared = stare(study({"library": "G2V"}, geometry="replaces").with_settings(few))
    assert stared.events["peak_time"].value.tolist() == [20.0, 40.0]
    staring = stared.stares[0].staring
    rise = both[0] - staring.quiet.source_electrons
    np.testing.assert_allclose(staring.flare_electrons, [rise / 0.1], rtol=1e-9, atol=1e-9 * rise.max())
    own = study({"library": "G2V", "effective_temperature_k": 5000.0, "distance_pc": 10.0}, geometry="replaces")
    one = study({"library": "G2V"}, geometry="replaces", photosphere_temperature_k=5000.0)
    np.testing.assert_array_equal(light(own), light(one))
    assert not np.array_equal(light(own)[0], both[0])
    assert Study.build(own.model_dump(), "again") == own
    # Another star has its own temperature and distance.
    other = own.at("star", "M3V").star[0]
    assert (other.effective_temperature_k, other.distance_pc) == (None, None)
    # Its V in the list is no magnitude in another band.
    bands = {"Kepler": None, "V": 8.81, "Johnson V": 8.81}
    vega = {band: study({"library": "Vega", "magnitude": None, "band": band}) for band in bands}
    assert {band: one.at("star", "AU Mic").star[0].magnitude for band, one in vega.items()} == bands


def test_sky_is_common_to_both_hypotheses(engine: Engine) -> None:
    """The definition of the signal does not affect detection; a sky 1000 times brighter makes it harder."""
    asked = study({"library": "G2V"}, amplitudes=[0.02]).with_settings(["run={realisations=20000, fap=0.01}"])
    settings = ("observation.signal='net'", "observation.signal='paper'", "sky.surface_brightness=14.6")
    net, paper, bright = (detect(asked.with_settings([one]), engine).stars[0].detection for one in settings)
    same(net, paper)
    seen, drowned = (found.detection_probability(0.01, "matched")[0].value for found in (net, bright))
    assert drowned < seen


#: Normal priors whose effect exceeds the noise of a frame's total light; the cuts are five standard deviations away.
PRIORS = {
    "jitter": {"normal": [0.25, 0.05], "between": [0.0, 0.5]},
    "detector_temperature": {"normal": [20.0, 1.0], "between": [15.0, 25.0]},
    "light_loss": {"normal": [0.4, 0.06], "between": [0.1, 0.7]},
    "pointing_loss": {"normal": [0.3, 0.05], "between": [0.05, 0.55]},
    "qe_scale": {"normal": [1.1, 0.1], "between": [0.6, 1.6]},
    "sky_level": {"normal": [1.2, 0.15], "between": [0.45, 1.95]},
}
#: Sky that is bright enough for its level to be seen.
BRIGHT = {"surface_brightness": 12.0}
N = 4000


def asked(name: str) -> Study:
    star, stare = [{"library": "G2V", "magnitude": 6.0}], {"duration_s": 5.0}
    return small(star=star, sky=BRIGHT, observation={"exposure_s": 5.0}, stare=stare, processes={name: PRIORS[name]})


def frames(study: Study, count: int, **how: Any) -> Any:
    """Draw the total of the only frame of many stares."""
    staring = stare(study).stares[0].staring
    components = staring.components(np.ones((1, staring.quiet.wavelength_nm.size)))
    return Stares().frames(components, staring.stare, count=count, **how)[:, 0, 0]


@pytest.mark.parametrize("name", [name for name, _ in Study().processes if name != "cosmic_rays"])
def test_stare_draws_prior_as_exposure_does(engine: Engine, name: str) -> None:
    """Compare moments of a frame's total: five standard errors of twelve comparisons fail once in 1e5."""
    study = asked(name)
    quiet = simulate(study).observations[0][1]
    exposures = engine.realise(quiet, count=N, seed=3, processes=study.processes).sum(axis=1) - quiet.mean_raw_dn.sum()
    found = frames(study, N, seed=4)
    assert exposures.std() > 3 * np.sqrt(quiet.unsaturated_variance_dn2.sum())
    assert abs(found.mean() - exposures.mean()) < 5 * np.hypot(found.std(), exposures.std()) / np.sqrt(N)
    assert abs(np.log(found.std() / exposures.std())) < 5 / np.sqrt(N)


def test_spreads_of_process_and_stare_add_in_quadrature() -> None:
    study = asked("qe_scale").with_settings(["stare.offsets={light=0.1}"])
    found = stare(study).stares[0].staring.stare
    (unknown,) = found.unknowns
    assert unknown.name == "light offset"
    assert unknown.sd == pytest.approx(np.hypot(0.1, 0.1 / 1.1))
    assert found.light == pytest.approx(1.1)
