"""Hostile files and generated values are answered or refused in one sentence, in little time and memory.

Files without an end or of absurd size, what is no file, and values of every kind; none ends in a traceback.
"""

import os
import re
import shlex
import shutil
from pathlib import Path
from types import ModuleType
from typing import Any

import h5py
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from scripts import tool
from study_keys import fields
from tables import toml

pytestmark = pytest.mark.long

GIB = 2**30


@pytest.fixture(scope="module")
def fuzz() -> ModuleType:
    """Return `tools/fuzz_files.py`, which runs commands within limits."""
    return tool("fuzz_files")


def test_mutated_files_are_answered_or_refused(fuzz: ModuleType) -> None:
    """Mutate each format twice; `python tools/fuzz_files.py` does so two thousand times."""
    assert [fault for fault in fuzz.run(range(82), 4300) if fault is not None] == []


@pytest.fixture(scope="module")
def intact(fuzz: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("intact")
    fuzz.make(folder)
    return folder


@pytest.fixture
def place(intact: Path, tmp_path: Path) -> Path:
    """Return a folder with links to the intact files, of which a test replaces some, and what only these tests need."""
    shutil.copytree(intact, tmp_path, copy_function=os.link, dirs_exist_ok=True)
    mapping = (tmp_path / "wcs.toml").read_text().replace('wavelength = "wcs"', 'wavelength_file = "nm.csv"')
    (tmp_path / "named.toml").write_text(f'{mapping}wavelength_unit = "Angstrom"\n')
    Table({"nm": np.linspace(2505.0, 6505.0, 6)}).write(tmp_path / "nm.csv", format="ascii.csv")
    curve = Table({"wavelength": [150.0, 1100.0], "value": [0.5, 0.5]}, units={"wavelength": "nm"})
    curve.write(tmp_path / "curve.ecsv")
    (tmp_path / "curve.toml").write_text("extends = 'mauvesim'\nfibre_efficiency = 'curve.ecsv'\n")
    names = [path.name for path in sorted((tmp_path / "spectra").glob("*.fits"))]
    Table({"file": names, "T": np.arange(len(names)) * 20.0}).write(tmp_path / "times.csv")
    (tmp_path / "listed.toml").write_text(
        'table = "../times.csv"\ntime = "T"\ntime_unit = "s"\nflux = "FLUX"\nflux_unit = "adu/s"\nerror = "ERR"\n'
        'exposure_s = 18.0\nwavelength = "W"\nwavelength_unit = "Angstrom"\n'
    )
    return tmp_path


def sparse(path: Path, start: bytes = b"", size: int = 8 * GIB) -> None:
    """Replace a file by one of many GiB that takes no room."""
    path.unlink(missing_ok=True)
    with path.open("wb") as file:
        file.write(start)
        file.truncate(size)


def endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


def one_line(path: Path) -> None:
    """Replace a table by one whose last row never ends."""
    sparse(path, path.read_bytes().rstrip().rpartition(b"\n")[0] + b"\n0.1,1")


def many_comments(path: Path) -> None:
    """Replace a table by its first line and a hundred MiB of comments."""
    first = path.read_bytes().splitlines(keepends=True)[0]
    path.unlink()
    path.write_bytes((first if first.startswith(b"#") else b"") + b"# nothing\n" * (10 * 2**20))


ANALYSE = ("analyse", "--no-pictures", "--quiet", "--output", "out")
TABLE = toml("hostile.toml")
#: What reads a file, and what finds it at fault: the file, and the command.
READERS, VERIFIED = ({name: (file, tuple(shlex.split(words))) for name, (file, words) in TABLE[kind].items()}
                     for kind in ("read", "verified"))  # fmt: skip


def logged(fuzz: ModuleType, words: tuple[str, ...], place: Path, *codes: int, **environment: str) -> str:
    """Run a command within its limits, check that it ends with one of some codes, and return its messages."""
    where = {"MAUVECL_DATA_DIR": str(place / "d")} | environment
    code, out, log = fuzz.ended(list(words), place, fuzz.limited, where)
    assert fuzz.fault_of(code, out, log, codes) == "", (words, out + log)
    return out + log


# Weights are read by verbs that draw, which the forked process may not.
@pytest.mark.parametrize("reader", [reader for reader in READERS if reader != "weights"])
def test_intact_files_are_read(reader: str, place: Path, fuzz: ModuleType) -> None:
    """Check that the refusals below are not those of something else."""
    logged(fuzz, READERS[reader][1], place, 0)


@pytest.mark.parametrize("replace", [sparse, os.mkfifo, endless])
@pytest.mark.parametrize("reader", READERS | VERIFIED)
def test_no_file_is_read_without_end(reader: str, replace: Any, place: Path, fuzz: ModuleType) -> None:
    file, words = (READERS | VERIFIED)[reader]
    (place / file).unlink()
    replace(place / file)
    logged(fuzz, words, place, *((1, 2) if reader in VERIFIED else (2,)))


@pytest.mark.parametrize("replace", [one_line, many_comments])
@pytest.mark.parametrize("name", ["f.csv", "f.ecsv"])
def test_lines_have_a_bound(name: str, replace: Any, place: Path, fuzz: ModuleType) -> None:
    """Read tables that are large enough for pieces, whose line or header has no end."""
    replace(place / name)
    assert "characters" in logged(fuzz, (*ANALYSE, name, "--mapping", "m.toml"), place, 2)


def test_descriptions_nested_deeply_are_refused(place: Path, fuzz: ModuleType) -> None:
    path = place / "frames.zarr/star-1/quiescent/zarr.json"
    path.unlink()
    path.write_text('{"a":' * 100_000 + "1" + "}" * 100_000)
    logged(fuzz, ("verify", "frames.zarr"), place, 1)
    logged(fuzz, ("export", "frames.zarr", "n.h5"), place, 2)


@pytest.mark.parametrize("after", [0, GIB])
def test_frames_of_many_gibibytes_are_refused_before_they_are_read(after: int, place: Path, fuzz: ModuleType) -> None:
    """Let the header of a table claim the rows of a sparse file, which may go on after them."""
    content = (place / "f.fits").read_bytes()
    width, rows = int(fits.getheader(place / "f.fits", 1)["NAXIS1"]), 40
    claimed = 8 * GIB // width
    card = f"NAXIS2  = {rows:20d}".encode()
    assert card in content
    header = content[: -(-rows * width // 2880) * -2880]
    size = len(header) - -claimed * width // 2880 * 2880 + after
    sparse(place / "f.fits", header.replace(card, f"NAXIS2  = {claimed:20d}".encode()), size)
    log = logged(fuzz, READERS["frames in FITS"][1], place, 2)
    assert (f"{after} bytes after" if after else f"frames, but has {claimed}") in log


@pytest.mark.parametrize("key", ["wavelength_nm", "quiescent"])
def test_sizes_that_an_hdf5_file_claims_are_refused(key: str, place: Path, fuzz: ModuleType) -> None:
    """Extend an array, which then holds a fill value without taking room."""
    name = place / "frames.h5"
    # It is a link to the intact file.
    shutil.copy(name, place / "own.h5")
    with h5py.File((place / "own.h5").replace(name), "r+") as file:
        group, old = file["star-1"], file["star-1"][key]
        kept = {k: v for k, v in old.attrs.items() if k in ("units", "amplitude")}
        rest, dtype = old.shape[1:], old.dtype
        del group[key]
        group.create_dataset(key, (10**11, *rest), dtype, chunks=(1000, *rest), fillvalue=1).attrs.update(kept)
    assert str(10**11) in logged(fuzz, (*ANALYSE, "frames.h5[star-1/quiescent]"), place, 2)


#: What can be wrong with a value: numbers, texts, names of files, and any text or number.
ODD = st.one_of(
    st.sampled_from(["0", "-1", "1e-308", "5e-324", "1e308", "-1e308", "nan", "inf", "-inf", "1e-31", "1e31", "1e999"]),
    st.sampled_from(["1_0", "0x" + "f" * 2000, "9" * 5000, str(2**63 - 1), str(2**64), "0.1", "1e17", "true", "{}"]),
    st.sampled_from(["", ".", "..", "/", "[/red]", "[bold]x", "a\0b", "\udcff", "\n", "'", '"', "²", "1979-05-27"]),
    st.sampled_from(["x" * 5000, "y" * 300 + ".toml", "/dev/zero", "[" * 3000 + "]" * 3000]),
    st.sampled_from(["G2V", "mauvesim", "stack:5", "V", "chi2", "all", "none"]),
    st.text(max_size=30),
    st.floats(allow_nan=False).map(repr),
    st.integers().map(str),
)
#: Keys of studies, also of stars that are numbered wrongly.
EVERY = [".".join(path) for path, _ in fields() if len(path) < 3] + ["star.0.magnitude", "star.0.file", "star.-1", ""]
GENERATED = TABLE["generated"]


@pytest.mark.parametrize("kind", GENERATED)
def test_generated_inputs_are_answered_or_refused(kind: str, tmp_path: Path, fuzz: ModuleType) -> None:
    row = {"keys": EVERY, "forms": ["{1}"], "file": "", "environment": {}} | GENERATED[kind]

    # The same examples in every run; the first failure will do: looking for a shorter one takes minutes.
    @settings(max_examples=row["examples"], derandomize=True, database=None, deadline=None, phases=[Phase.generate],
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(st.sampled_from(row["keys"]), st.sampled_from(row["forms"]), ODD)
    def ask(key: str, form: str, value: str) -> None:
        # The operating system passes no null bytes, and what is written outside the folder would stay.
        value = re.sub(r"\0|/|\.\." if kind == "output" else r"\0", "?", value)

        def filled(text: str) -> str:
            return text.replace("{0}", key).replace("{1}", form.replace("{1}", value))

        (tmp_path / "mine.toml").write_text(filled(row["file"]), errors="replace")
        words = tuple(filled(word) for word in shlex.split(row["run"].replace("{0}", key)))
        logged(fuzz, words, tmp_path, 0, 2, **{filled(name): filled(text) for name, text in row["environment"].items()})

    ask()
