"""Generated inputs of every kind: each ends in an answer, or in one sentence and exit code 2; none in a traceback."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import pytest
from commands import ended
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from study_keys import fields

pytestmark = pytest.mark.long

#: Memory that a question may take beyond what the process has, and seconds.
ROOM, SECONDS = 1 << 30, 30.0


def many(examples: int):
    """Return settings that give the same examples in every run."""
    return settings(
        max_examples=examples,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        # The first failure will do: looking for a shorter one takes minutes.
        phases=[Phase.generate],
    )


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
#: A verb that reads everything and draws nothing.
ASK = ("exposure", "--snr", "10", "--at", "300", "--no-pictures", "--quiet", "--star", "G2V", "--magnitude", "7.4")
KEYS = st.one_of(
    st.sampled_from(EVERY), st.sampled_from(["observation.changes.temperature_c", "run.weights.x", ""]), TEXTS
)


@many(40)
@given(key=KEYS, value=st.one_of(VALUES, TEXTS))
def test_settings_never_crash(folder: Path, key: str, value: str) -> None:
    check(folder, *ASK, "--set", f"{key}={value}")


@many(30)
@given(key=st.sampled_from(EVERY), value=VALUES, junk=st.one_of(st.just(b""), st.binary(max_size=20)))
def test_studies_never_crash(folder: Path, key: str, value: str, junk: bytes) -> None:
    study = folder / "study.toml"
    study.write_bytes(f"{key.replace('star.0', 'star')} = {value}\n".encode() + junk)
    check(folder, "exposure", "study.toml", "--snr", "10", "--at", "300", "--no-pictures", "--quiet")


INSTRUMENT_KEYS = (
    "pixels", "adc_bits", "read_noise_dn", "temperature_c", "light_loss", "fibre_efficiency", "pixel_map", "extends",
    "name", "conversion_uv_per_electron", "frame_s", "sources", "nonsense",
)  # fmt: skip


@many(25)
@given(key=st.sampled_from(INSTRUMENT_KEYS), value=VALUES)
def test_instruments_never_crash(folder: Path, key: str, value: str) -> None:
    (folder / "mine.toml").write_text(f"extends = 'mauvesim'\n{key} = {value}\n")
    check(folder, *ASK, "--instrument", "mine.toml")


FLAGS = st.sampled_from(
    ["--star", "--magnitude", "--band", "--exposure", "--instrument", "--temperature", "--sky", "--target", "--time",
     "--snr", "--at", "--per", "--output", "--realisations", "--nonsense", "--set", "--json", "study_file"]
)  # fmt: skip


@many(40)
@given(flag=FLAGS, value=st.one_of(NUMBERS, TEXTS))
def test_flags_never_crash(folder: Path, flag: str, value: str) -> None:
    if flag == "--output":
        # Not outside the folder: what is written there would stay.
        value = value.replace("/", "?").replace("..", "?")
    # The operating system passes no null bytes.
    value = value.replace("\0", "?")
    words = (value,) if flag == "study_file" else (f"{flag}={value}",)
    check(folder, "exposure", "--no-pictures", "--quiet", "--snr=10", "--at=300", *words)


@many(25)
@given(verb=st.sampled_from(["verify", "export", "realise", "library", "serve", "map", "limit", "detect"]), value=TEXTS)
def test_verbs_never_crash(folder: Path, verb: str, value: str) -> None:
    words = {
        "verify": ("verify", value),
        "export": ("export", value, f"{value}.fits", "--rows", value),
        "realise": ("realise", "--star", value, "--frames", value, "-n", "1"),
        "library": ("library", "add", value),
        "serve": ("serve", "--port", value or "0"),
        "map": ("map", "--x", value),
        "limit": ("limit", "--of", value or "x"),
        "detect": ("detect", "--fap", value or "x", "-o", value),
    }[verb]
    check(folder, *words)


@many(20)
@given(
    name=st.sampled_from(
        ["MAUVECL_DATA_DIR", "MAUVECL_CACHE_DIR", "MAUVECL_LARGEST_FILE_MIB", "MAUVECL_LARGEST_CONTENT_MIB", "COLUMNS",
         "TERM", "NO_COLOR", "PYTHONIOENCODING", "LANG", "TMPDIR"]
    ),
    value=TEXTS.filter(lambda text: "\0" not in text),
)  # fmt: skip
def test_environments_never_crash(folder: Path, name: str, value: str) -> None:
    check(folder, "library", **{name: value})


def test_check_detects_an_unexpected_error(folder: Path) -> None:
    with mock.patch("json.dumps", side_effect=KeyError("x")), pytest.raises(AssertionError):
        check(folder, "library", "--json")
