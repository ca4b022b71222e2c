"""Philox4x32-10 against known answers and independent code."""

from __future__ import annotations

import numpy as np
import pytest
import randomgen

from mauvecl.device.probes import Probes
from mauvecl.noise import twin as reference

#: Random123's kat_vectors: counter, key, output.
KNOWN = [
    ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
]


def hexadecimal(text: str) -> np.ndarray:
    return np.array([int(word, 16) for word in text.split()], np.uint32)


@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN)
def test_known_answers(probes: Probes, counter: str, key: str, answer: str) -> None:
    out = probes.philox(hexadecimal(counter)[None], hexadecimal(key)[None])[0]
    np.testing.assert_array_equal(out[:4], hexadecimal(answer))
    np.testing.assert_array_equal(out[4:], hexadecimal(answer))
    low, high = (int(k) for k in hexadecimal(key))
    twin = reference.philox(hexadecimal(counter), high << 32 | low)
    np.testing.assert_array_equal(np.array(twin), hexadecimal(answer))


def random_counters(n: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(20_261)
    counters = generator.integers(0, 2**32, (n, 4), dtype=np.uint32)
    return counters, generator.integers(0, 2**32, (n, 2), dtype=np.uint32)


def test_the_loop_invariant_form_is_the_plain_one(probes: Probes) -> None:
    out = probes.philox(*random_counters(5000))
    np.testing.assert_array_equal(out[:, :4], out[:, 4:])


def test_against_an_independent_implementation(probes: Probes) -> None:
    counters, keys = random_counters(100)
    ours = probes.philox(counters, keys)[:, :4]
    for counter, key, words in zip(counters, keys, ours, strict=True):
        number = sum(int(word) << (32 * i) for i, word in enumerate(counter))
        key_number = int(key[1]) << 32 | int(key[0])
        # It increments its counter before use.
        oracle = randomgen.Philox(counter=(number - 1) % 2**128, key=key_number, number=4, width=32)
        np.testing.assert_array_equal(words, oracle.random_raw(4).astype(np.uint32))


def test_twin(probes: Probes) -> None:
    counters, keys = random_counters(200)
    ours = probes.philox(counters, keys)[:, :4]
    for counter, key, words in zip(counters, keys, ours, strict=True):
        twin = reference.philox(counter, int(key[1]) << 32 | int(key[0]))
        np.testing.assert_array_equal(np.array(twin), words)
