"""Common Python usage: names, single flares, 1e5, equality, text, pickles, and pictures in given axes."""

import pickle
from collections.abc import Callable
from functools import cache
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from marks import long_but
from refusals import refused
from scenes import study_of_g2v

import mauvecl
from mauvecl import Engine, Expectation, Instrument, Pool, Sky, Source, Study, detect, expect, snr


def study(**settings: object) -> Study:
    x, y = {"quantity": "magnitude", "values": [7.0, 8.0]}, {"quantity": "amplitude", "values": [0.1, 0.3]}
    asked = study_of_g2v(
        flare={"amplitudes": [0.1, 0.3]},
        run={"realisations": 5000, "fap": 0.05, "statistics": ["matched", "chi2"]},
        observation={"changes": {"output_min_nm": 300.0, "output_max_nm": 322.0}},
        map={"x": x, "y": y},
    )
    return asked.with_settings([f"{key}={value}" for key, value in settings.items()])


ONE = {"run.statistics": "['matched']", "flare.amplitudes": "[0.3]"}
ANSWERS: dict[str, Callable[[Engine, dict[str, object]], Any]] = {
    "detect": lambda e, s: detect(study(**s), e),
    "detection": lambda e, s: detect(study(**s), e).stars[0].detection,
    "snr": lambda e, s: snr(study(**s), e),
    "snr result": lambda e, s: snr(study(**s), e).stars[0].result,
    "exposure": lambda e, s: mauvecl.exposure_for(study(**s), 5.0, 310.0),
    "simulate": lambda e, s: mauvecl.simulate(study(**s)),
    "limit": lambda e, s: mauvecl.limit(study(**ONE, **s), e),
    "map": lambda e, s: mauvecl.map(study(**ONE, **s), e),
    "gaussian": lambda e, s: mauvecl.gaussian(study(**{"sweep.axes": "[{quantity='magnitude',values=[7.0]}]"}, **s), e),
}


@cache
def pair() -> tuple[Expectation, Expectation]:
    payload = Instrument.load("mauvesim").with_(output_min_nm=300.0, output_max_nm=322.0)
    star = Source.from_library("G2V").at_magnitude(7.4)
    quiet, flare = (expect(s, payload, exposure=50) for s in (star, star.flaring(0.3)))
    return quiet, flare


def things() -> dict[str, Callable[[float], Any]]:
    mauve = Instrument.load("mauvesim")
    return {
        "Source": lambda v: Source.from_library("G2V").at_magnitude(v),
        "Instrument": lambda v: mauve.with_(temperature_c=v),
        "Expectation": lambda v: expect(Source.from_library("G2V").at_magnitude(v), mauve, exposure=50),
        "Sky": Sky.of_brightness,
        "Study": lambda v: study(**{"star.0.magnitude": v}),
        "PixelMap": lambda v: mauvecl.PixelMap.made_up(50, seed=int(v)),
        "Linear": lambda v: mauvecl.Linear("mine", np.full(9, v)),
        "Nuisances": lambda v: mauvecl.Nuisances(("own",), np.ones((1, 5)), np.array([v])),
    }


@pytest.mark.parametrize("name", [*ANSWERS, *things()])
def test_objects_compare_by_content_are_pickled_and_have_short_repr(engine: Engine, name: str) -> None:
    def make(value: float) -> Any:
        changes = {"run.seed": int(value), "star.0.magnitude": value}
        return ANSWERS[name](engine, changes) if name in ANSWERS else things()[name](value)

    one, same, other = make(7.0), make(7.0), make(9.0)
    assert pickle.loads(pickle.dumps(one)) == one == same
    assert one not in (other, "another thing")
    if name != "Study":
        assert len({one, same, pickle.loads(pickle.dumps(one)), other}) == 2
    assert len(repr(one)) < (200 if name in ANSWERS else 160)
    assert "\n" not in repr(one)


def test_tuples_may_be_single_values(engine: Engine) -> None:
    quiet, flare = pair()
    found = engine.detect(quiet, [flare], realisations=10_000, seed=1, statistics=("matched",))
    for one in (engine, Pool()):
        assert one.detect(quiet, flare, realisations=1e4, seed=1, statistics="matched") == found


def test_tables_have_units() -> None:
    quiet, _ = pair()
    for table, snr_of in ((quiet.table, quiet.snr()), (quiet.element_table, quiet.snr_per_element())):
        assert (table["wavelength"].unit, table["signal"].unit, table["noise"].unit) == (u.nm, u.DN, u.DN)
        np.testing.assert_allclose((table["signal"] / table["noise"]).value, snr_of)
    mauve = Instrument.load("mauvesim").table
    assert mauve["effective_area"].unit == u.cm**2
    np.testing.assert_allclose(mauve["effective_area"].value / mauve["throughput"], 122.0)
    star = Source.from_library("G2V").table
    again = Source.from_arrays(star["wavelength"], star["flux"])
    np.testing.assert_allclose(again.flux_flam, Source.from_library("G2V").flux_flam)


@pytest.mark.parametrize("name", long_but(["Source", "Expectation", *ANSWERS], "Source", "Expectation", "snr", "limit"))
def test_pictures_are_drawn_into_given_axes(engine: Engine, name: str) -> None:
    """Draw into the second of three axes; nothing outside of them changes."""
    import matplotlib.pyplot as plt

    made = ANSWERS[name](engine, {}) if name in ANSWERS else things()[name](7.0)
    figure, axes = plt.subplots(1, 3, figsize=(15, 6))
    before = [ax.get_position().bounds for ax in axes]
    how = {"fap": 0.05} if name == "detection" else {}
    assert made.plot(ax=axes[1], **how) is axes[1]
    drawn = [axes[1]] + [ax for part in figure.subfigs for ax in part.axes]
    assert any(ax.lines or ax.collections or ax.images or ax.patches for ax in drawn)
    assert not any(ax.lines for ax in (axes[0], axes[2]))
    assert figure._suptitle is None
    figure.canvas.draw()
    # A colour bar takes its room from its own axes.
    after = [ax.get_position().bounds for ax in axes]
    assert (after[0], after[2]) == (before[0], before[2])
    assert plt.fignum_exists(figure.number)
    plt.close(figure)
    own = made.plot(**how)
    assert own.axes
    # One panel needs no grid, with or without a colour bar.
    if len(own.axes) > 1 and name != "map":
        figure = plt.figure()
        with refused("ax"):
            made.plot(ax=figure.add_axes((0, 0, 1, 1)), **how)
        plt.close(figure)
