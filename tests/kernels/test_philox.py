"""Philox4x32-10 against known answers and independent code."""

import numpy as np
import pytest
import randomgen
from probes import Probes

from mauvecl.device import selftest
from mauvecl.noise import reference

Words = tuple[int, ...]


@pytest.mark.parametrize(("counter", "key", "answer"), selftest.PHILOX_VECTORS)
def test_philox_gives_the_known_answers(probes: Probes, counter: Words, key: Words, answer: Words) -> None:
    out = probes.philox(np.array([counter], np.uint32), np.array([key], np.uint32))[0]
    np.testing.assert_array_equal(out, [*answer, *answer])
    twin = reference.philox(np.array(counter, np.uint32), key[1] << 32 | key[0])
    np.testing.assert_array_equal(np.array(twin), answer)


def random_counters(n: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(20_261)
    counters = generator.integers(0, 2**32, (n, 4), dtype=np.uint32)
    return counters, generator.integers(0, 2**32, (n, 2), dtype=np.uint32)


def test_device_numpy_and_an_independent_implementation_give_equal_words(probes: Probes) -> None:
    counters, keys = random_counters(5000)
    ours = probes.philox(counters, keys)
    np.testing.assert_array_equal(ours[:, :4], ours[:, 4:], err_msg="the loop-invariant form")
    for counter, key, words in zip(counters[:200], keys, ours[:, :4], strict=False):
        number = sum(int(word) << (32 * i) for i, word in enumerate(counter))
        key_number = int(key[1]) << 32 | int(key[0])
        np.testing.assert_array_equal(np.array(reference.philox(counter, key_number)), words)
        # It increments its counter before use.
        oracle = randomgen.Philox(counter=(number - 1) % 2**128, key=key_number, number=4, width=32)
        np.testing.assert_array_equal(words, oracle.random_raw(4).astype(np.uint32))
