"""Sentences of bad input, one for each kind of error; other tests read key, value and expected."""

from __future__ import annotations

import pickle

import astropy.units as u
import numpy as np
import pytest

from mauvecl import InputError, Instrument, Source, Study


def test_error_of_one_value_has_key_and_unit() -> None:
    error = InputError.of("flare amplitude", -1.0, "at least 0", unit="s", where="a.toml")
    assert str(error) == "a.toml: flare amplitude = -1.0 s, expected at least 0"
    assert (error.key, error.value, error.expected) == ("flare_amplitude", -1.0, "at least 0")


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        ("a\nb", r"'a\nb'"),
        (np.float64(2.5), "2.5"),
        (3 * u.m, "3.0 m"),
        ([1, 2], "[1, 2]"),
        ("x" * 500, "'" + "x" * 56 + "..." + "x" * 19 + "'"),
    ],
)
def test_values_are_shown_on_one_short_line(value: object, shown: str) -> None:
    assert str(InputError.of("key", value, "another")) == f"key = {shown}, expected another"


def test_errors_have_a_place_and_are_pickled() -> None:
    error = InputError("no light", "some", key="flux", value=3).within("star.txt")
    for one in (error, pickle.loads(pickle.dumps(error))):
        assert str(one) == "star.txt: no light, expected some"
        assert (one.key, one.value, one.expected) == ("flux", 3, "some")


def test_each_kind_of_error_has_its_sentence() -> None:
    for call, sentence in (
        (lambda: Source.from_library("G2V").at_magnitude(99.0), "magnitude = 99.0, expected -30 to 40 mag"),
        (lambda: Study().with_settings(["run.fap=3"]), "settings: run.fap = 3, expected a number above 0 and below 1"),
        (
            lambda: Instrument.load("mauve").with_(temprature_c=1),
            "mauve: unknown key 'temprature_c', did you mean 'temperature_c'?",
        ),
        (lambda: Source.read("none.txt"), "spectrum file 'none.txt' does not exist, expected a file"),
    ):
        with pytest.raises(InputError) as caught:
            call()
        assert str(caught.value) == sentence
