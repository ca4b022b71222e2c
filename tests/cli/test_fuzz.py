"""Generated inputs of every kind: each ends in an answer, or in one sentence and exit code 2; none in a traceback."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from commands import ended
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from study_keys import fields
from tables import toml

pytestmark = pytest.mark.long

#: Memory that a question may take beyond what the process has, and seconds.
ROOM, SECONDS = 1 << 30, 30.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.fixture(autouse=True, scope="module")
def bounded_memory() -> Iterator[None]:
    """Limit the memory; a message about memory then fails the test."""
    here = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    # PoCL maps some gigabytes of its own, in tests that draw.
    resource.setrlimit(resource.RLIMIT_AS, (here + ROOM + (4 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def check(folder: Path, *words: str, **environment: str) -> None:
    """Run the command and check its exit code, message, duration and memory."""
    started, before = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with mock.patch.dict(os.environ, {"MAUVECL_DATA_DIR": str(folder / "data")} | environment):
        code, out, reported = ended(*words, folder=folder)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    sentences = [line for line in reported.splitlines() if not line.startswith("mauvecl: note: ")]
    assert code in (0, 2), (words, code, reported)
    assert "Traceback" not in out + reported
    if code == 2:
        assert len(sentences) == 1, reported
        assert sentences[0].startswith("mauvecl: ")
        assert len(sentences[0]) < 1200
        assert "memory" not in sentences[0]
    else:
        assert not sentences
    assert grown * 1024 < ROOM
    assert time.monotonic() - started < SECONDS


# What can be wrong with a value.

NUMBERS = st.one_of(
    st.sampled_from(["0", "-1", "1e-308", "5e-324", "1e308", "-1e308", "nan", "inf", "-inf", "1e-31", "1e31"]),
    st.sampled_from(
        ["9223372036854775807", "9" * 5000, "0x" + "f" * 2000, "1_0", str(2**64), "1e999", "0.1", "5", "1e17"]
    ),
    st.floats(allow_nan=False).map(repr),
    st.integers().map(str),
)
TEXTS = st.one_of(
    st.text(max_size=30),
    st.sampled_from(["", ".", "..", "/", "[/red]", "[bold]x", "a\0b", "\udcff", "\n", "'", '"', "²", "~"]),
    st.sampled_from(["x" * 5000, "y" * 300 + ".toml", "G2V", "mauvesim", "stack:5", "V", "chi2", "all", "none"]),
    st.sampled_from(["zero.txt", "fifo.txt", "/dev/zero", "good.txt"]),
)
QUOTED = TEXTS.map(lambda text: '"' + "".join(f"\\u{ord(c):04x}" if ord(c) < 0xD800 else "?" for c in text) + '"')
VALUES = st.recursive(
    st.one_of(NUMBERS, QUOTED, st.sampled_from(["true", "false", "1979-05-27", "[]", "{}"])),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4).map(lambda items: f"[{', '.join(items)}]"),
        inner.map(lambda value: f"{{ uniform = [{value}, {value}] }}"),
        inner.map(lambda value: f"{{ value = {value}, tag = 'A' }}"),
        st.integers(1, 3000).map(lambda depth: "[" * depth + "]" * depth),
    ),
    max_leaves=5,
)


#: Keys of studies, also of stars that are numbered wrongly.
EVERY = [".".join(path) for path, _ in fields() if len(path) < 3] + ["star.0.magnitude", "star.0.file", "star.-1"]
KEYS = st.one_of(
    st.sampled_from(EVERY), st.sampled_from(["observation.changes.temperature_c", "run.weights.x", ""]), TEXTS
)
#: What a generated value is given to: keys of instruments, flags, verbs and variables of the environment.
GIVEN = toml("hostile.toml")["generated"]
#: A verb that reads everything and draws nothing.
ASK = ("exposure", "--snr", "10", "--at", "300", "--no-pictures", "--quiet")
STAR = (*ASK, "--star", "G2V", "--magnitude", "7.4")
WORD = st.one_of(NUMBERS, TEXTS)
#: Number of examples, strategies of their parts, and the words and the content of `mine.toml` that these make.
KINDS: dict[str, tuple[int, tuple[st.SearchStrategy[Any], ...], Callable[..., tuple[tuple[str, ...], bytes]]]] = {
    "setting": (40, (KEYS, st.one_of(VALUES, TEXTS)), lambda key, value: ((*STAR, "--set", f"{key}={value}"), b"")),
    "study": (
        30, (st.sampled_from(EVERY), VALUES, st.one_of(st.just(b""), st.binary(max_size=20))),
        lambda key, value, junk: (
            ("exposure", "mine.toml", *ASK[1:]), f"{key.replace('star.0', 'star')} = {value}\n".encode() + junk
        ),
    ),
    "instrument": (
        25, (st.sampled_from(GIVEN["instrument"]), VALUES),
        lambda key, value: (
            (*STAR, "--instrument", "mine.toml"), f"extends = 'mauvesim'\n{key} = {value}\n".encode()
        ),
    ),
    "flag": (35, (st.sampled_from(GIVEN["flags"]), WORD), lambda flag, value: ((*ASK, f"{flag}={value}"), b"")),
    # Not outside the folder: what is written there would stay.
    "output": (5, (WORD,), lambda value: ((*ASK, f"--output={value.replace('/', '?').replace('..', '?')}"), b"")),
    "verb": (
        30, (st.sampled_from(GIVEN["verbs"]), TEXTS),
        lambda verb, value: (tuple(part.format(value) for part in verb.split()), b""),
    ),
    "environment": (
        20, (st.sampled_from(GIVEN["environment"]), TEXTS), lambda name, value: (("library", name, value), b"")
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_generated_inputs_never_crash(kind: str, folder: Path) -> None:
    count, parts, asked = KINDS[kind]

    # The same examples in every run; the first failure will do: looking for a shorter one takes minutes.
    @settings(max_examples=count, derandomize=True, database=None, deadline=None, phases=[Phase.generate],
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(st.tuples(*parts))
    def ask(given: tuple[Any, ...]) -> None:
        words, content = asked(*given)
        (folder / "mine.toml").write_bytes(content)
        # The operating system passes no null bytes.
        words = tuple(word.replace("\0", "?") for word in words)
        environment = {words[1]: words[2]} if kind == "environment" else {}
        check(folder, *words[: 1 if environment else None], **environment)

    ask()


def test_check_detects_an_unexpected_error(folder: Path) -> None:
    with mock.patch("json.dumps", side_effect=KeyError("x")), pytest.raises(AssertionError):
        check(folder, "library", "--json")
