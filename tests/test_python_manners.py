"""Common Python usage: names, single flares, 1e5, equality, text, pickles, and pictures in given axes."""

import pickle
from collections.abc import Callable
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from answers import FEW, QUICK
from marks import long_but
from refusals import refused
from scenes import paper

import mauvecl
from mauvecl import Engine, Expectation, Instrument, Pool, Sky, Source, expect

#: A few pixels and less usual questions.
SETTINGS = ["observation.changes={output_min_nm=300.0, output_max_nm=322.0}", "flare.amplitudes=[0.1, 0.3]"]
ASKED = QUICK | {
    "detect": ["run.statistics=['matched', 'chi2']"],
    "exposure": ["signal.snr=5", "signal.wavelength_nm=310"],
    "limit": ["limit.power=0.9", "flare.amplitudes=[0.3]"],
    "map": ["map.x={quantity='magnitude', values=[7.0, 8.0]}", "map.y={quantity='amplitude', values=[0.1, 0.3]}"],
}
#: Verbs, and parts of their answers.
ANSWERS = (*ASKED, "detect detection", "snr result")


def answer(name: str, engine: Engine, value: float = 7.0) -> Any:
    """Ask a verb about a star of a magnitude, which is the seed as well."""
    verb, *part = name.split()
    asked = paper(*FEW, *SETTINGS, *ASKED[verb], f"star.0.magnitude={value}", f"run.seed={value:.0f}")
    found = getattr(mauvecl, verb)(asked, mauvecl.Stares() if verb == "plan" else engine)
    return getattr(found.stars[0], part[0]) if part else found


def things() -> dict[str, Callable[[float], Any]]:
    mauve = Instrument.load("mauvesim")
    return {
        "Source": lambda v: Source.from_library("G2V").at_magnitude(v),
        "Instrument": lambda v: mauve.with_(temperature_c=v),
        "Expectation": lambda v: expect(Source.from_library("G2V").at_magnitude(v), mauve, exposure=50),
        "Sky": Sky.of_brightness,
        "Study": lambda v: paper(*FEW, f"star.0.magnitude={v}"),
        "PixelMap": lambda v: mauvecl.PixelMap.made_up(50, seed=int(v)),
        "Linear": lambda v: mauvecl.Linear("mine", np.full(9, v)),
        "Nuisances": lambda v: mauvecl.Nuisances(("own",), np.ones((1, 5)), np.array([v])),
    }


@pytest.mark.parametrize("name", [*ANSWERS, *things()])
def test_objects_compare_by_content_are_pickled_and_have_short_repr(engine: Engine, name: str) -> None:
    def make(value: float) -> Any:
        return answer(name, engine, value) if name in ANSWERS else things()[name](value)

    one, same, other = make(7.0), make(7.0), make(9.0)
    # Tables of one are read, which is not to change what it is.
    assert getattr(one, "tables", True)
    assert pickle.loads(pickle.dumps(one)) == one == same
    assert one not in (other, "another thing")
    if name != "Study":
        assert len({one, same, pickle.loads(pickle.dumps(one)), other}) == 2
    assert len(repr(one)) < {"change": 260}.get(name, 200 if name in ANSWERS else 160)
    assert "\n" not in repr(one)


def test_tuples_may_be_single_values(engine: Engine, scene: list[Expectation]) -> None:
    quiet, flare, _ = scene
    found = engine.detect(quiet, [flare], realisations=10_000, seed=1, statistics=("matched",))
    for one in (engine, Pool()):
        assert one.detect(quiet, flare, realisations=1e4, seed=1, statistics="matched") == found


def test_tables_have_units(scene: list[Expectation]) -> None:
    quiet = scene[0]
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

    made = answer(name, engine) if name in ANSWERS else things()[name](7.0)
    figure, axes = plt.subplots(1, 3, figsize=(15, 6))
    before = [ax.get_position().bounds for ax in axes]
    how = {"fap": 0.05} if name == "detect detection" else {}
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
