"""Mutate files of every format that mauvecl reads, and check that the command line answers or refuses each of them.

    python tools/fuzz_files.py --cases 2000 --seed 43 --output faults

Each mutated file is given to a command that reads its format, in a process with limits of time and memory. The exit
code must be 0, or 2 with one sentence (also 1 for `verify`, which finds faults). Other outcomes are listed, and their
files are kept in the output folder. A case depends only on its number and the seed.
"""

from __future__ import annotations

import argparse
import gzip
import importlib
import itertools
import json
import os
import pkgutil
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import tomllib
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

#: Limits of a command: processor time, s, and memory beyond that of the process that imported mauvecl, bytes.
SECONDS, ROOM = 10, 1 << 30
#: Wall-clock time after which a command that computes nothing is ended, s.
PATIENCE = 60
#: Values that replace numbers and texts.
ODD = ("nan", "inf", "-1", "0", "1e400", "-1e308", "9" * 400, "", "[", "\0", "é", "1e-320", "18446744073709551616", "x")
#: Values that replace those of JSON and TOML.
ODD_VALUES: tuple[Any, ...] = (None, [], {}, "", "x", -1, 0, 2**70, 1e308, True, [[]], {"a": []}, "\ud7ff", [1, "a"])
#: Signs of another library's text or of an object in a message.
FOREIGN = re.compile(
    r" object at 0x|<class |Traceback|_ValidHDU|NonstandardHDU|Errno"
    r"|numpy|astropy|h5py|\bzarr\.(?!json)|pydantic|tomllib"
)
FITS_VALUES = (
    "''", "'x'", "T", "-1", "0", "1", "3", "999999999", "1E400", "", "NaN", "(1,2)", "'1PE(7)'", "'999999999D'", "'32X'"
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A file in a folder, its mutations, and the commands that read it."""

    #: Path of the mutated file in the folder.
    file: str
    commands: tuple[tuple[str, ...], ...]
    #: Accepted exit codes.
    codes: tuple[int, ...] = (0, 2)


def _frames() -> dict[str, Any]:
    """Return the columns of 40 frames of six pixels."""
    random_numbers = np.random.default_rng(43)
    flux = random_numbers.normal(1000.0, 5.0, (40, 6)) * np.linspace(0.5, 1.5, 6)
    return {
        "T": np.arange(40) * 20.0 / 86_400,
        "FLUX": flux,
        "ERR": 0.01 * flux,
        "QUAL": (np.arange(40) == 7).astype(np.int64),
        "EXPT": np.full(40, 18.0),
        "W": np.tile(np.linspace(2505.0, 6505.0, 6), (40, 1)),
    }


MAPPING = """time = "T"
time_unit = "d"
epoch = "2025-11-21"
scale = "tt"
flux = "FLUX"
flux_unit = "adu/s"
error = "ERR"
quality = "QUAL"
exposure = "EXPT"
exposure_unit = "s"
"""
STUDY = """[[star]]
library = "G2V"
magnitude = 7.4

[observation]
exposure_s = 50.0

[flare]
amplitudes = [0.1, 0.2]
"""
EXPOSURE = ("exposure", "--snr", "20", "--at", "500", "--quiet", "--output", "out")
ANALYSE = ("analyse", "--no-pictures", "--quiet", "--output", "out")
ADD = ("library", "add", "--name", "a")


def make(folder: Path) -> dict[str, Case]:
    """Write intact files to a folder, and return the case of each, by name."""
    import astropy.units as u
    from astropy.io import fits
    from astropy.table import Table

    nm = np.linspace(200.0, 1100.0, 200)
    light = 1e-13 * np.exp(-(((nm - 600.0) / 300.0) ** 2))
    spectrum = Table({"WAVELENGTH": nm * 10 * u.AA, "FLUX": light * u.Unit("erg / (s cm2 AA)")})
    for name, form in (("s.fits", "fits"), ("s.ecsv", "ascii.ecsv"), ("s.vot", "votable"), ("s.csv", "ascii.csv")):
        spectrum.write(folder / name, format=form)
    spectrum.write(folder / "s.txt", format="ascii.commented_header")
    (folder / "s.fits.gz").write_bytes(gzip.compress((folder / "s.fits").read_bytes()))
    image = fits.PrimaryHDU(light.astype("f4"))
    image.header.update({"CTYPE1": "WAVE", "CUNIT1": "nm", "CRPIX1": 1.0, "CRVAL1": nm[0], "CDELT1": nm[1] - nm[0],
                         "BUNIT": "erg / (s cm2 Angstrom)"})  # fmt: skip
    image.writeto(folder / "image.fits", checksum=True)
    cases = {name: Case(name, ((*ADD, name), (*EXPOSURE, "--star", name)))
             for name in ("s.fits", "s.ecsv", "s.vot", "s.csv", "s.txt", "s.fits.gz", "image.fits")}  # fmt: skip

    frames = _frames()
    Table(frames).write(folder / "f.fits")
    curve = {key: value.mean(axis=1) if value.ndim == 2 else value for key, value in frames.items() if key != "W"}
    for name, form in (("f.ecsv", "ascii.ecsv"), ("f.csv", "ascii.csv"), ("f.txt", "ascii.commented_header")):
        Table(curve).write(folder / name, format=form)
    images = [fits.ImageHDU(frames[key], name=key) for key in ("FLUX", "ERR")]
    for one in images:
        one.header.update({"CTYPE1": "WAVE", "CUNIT1": "Angstrom", "CRPIX1": 1.0, "CRVAL1": 2505.0, "CDELT1": 800.0})
    table = fits.BinTableHDU(Table({key: frames[key] for key in ("T", "QUAL", "EXPT")}))
    fits.HDUList([fits.PrimaryHDU(), *images, table]).writeto(folder / "i.fits", checksum=True)
    (folder / "m.toml").write_text(MAPPING)
    (folder / "wcs.toml").write_text(f'{MAPPING}wavelength = "wcs"\n')
    (folder / "w.toml").write_text(f'{MAPPING}wavelength = "W"\nwavelength_unit = "Angstrom"\n')
    for name in ("f.fits", "f.ecsv", "f.csv", "f.txt", "i.fits"):
        mapping = {"f.fits": "w.toml", "i.fits": "wcs.toml"}.get(name, "m.toml")
        cases[name] = Case(name, ((*ANALYSE, name, "--mapping", mapping),))
    cases["m.toml"] = Case("m.toml", ((*ANALYSE, "f.csv", "--mapping", "m.toml"),))
    cases["w.toml"] = Case("w.toml", ((*ANALYSE, "f.fits", "--mapping", "w.toml"),))

    (folder / "spectra").mkdir()
    for k in range(24):
        one = Table({"W": frames["W"][k], "FLUX": frames["FLUX"][k], "ERR": frames["ERR"][k]})
        one.meta = {"DATE-OBS": f"2026-03-01T12:{k:02d}:00", "EXPTIME": 18.0}
        one.write(folder / "spectra" / f"{k:02d}.fits")
    (folder / "folder.toml").write_text(
        'time = "DATE-OBS"\nflux = "FLUX"\nflux_unit = "adu/s"\nerror = "ERR"\nexposure = "EXPTIME"\n'
        'exposure_unit = "s"\nwavelength = "W"\nwavelength_unit = "Angstrom"\n'
    )
    folder_words = (*ANALYSE, "spectra", "--mapping", "folder.toml")
    cases["folder"] = Case("spectra/07.fits", (folder_words,))
    cases["first of folder"] = Case("spectra/00.fits", (folder_words,))

    (folder / "study.toml").write_text(STUDY)
    cases["study.toml"] = Case("study.toml", ((*EXPOSURE[:1], "study.toml", *EXPOSURE[1:]),))
    (folder / "own.toml").write_text('extends = "mauvesim"\nname = "own"\n')
    star = ("--star", "G2V", "--magnitude", "8")
    cases["own.toml"] = Case("own.toml", ((*EXPOSURE, *star, "--instrument", "own.toml"),))
    (folder / "neighbours.csv").write_text("name,separation,magnitude,type\na,10,9,G2V\nb,20,10,K3V\n")
    cases["neighbours.csv"] = Case("neighbours.csv", ((*EXPOSURE, *star, "--neighbours", "neighbours.csv"),))
    (folder / "targets.csv").write_text("name,ra,dec,V\na,10.0,20.0,8\nb,100.0,-20.0,9\n")
    cases["targets.csv"] = Case(
        "targets.csv", (("visible", "--targets", "targets.csv", "--no-pictures", "--quiet", "--output", "out"),)
    )
    # Fewer realisations than the threshold needs: everything is read, and then refused.
    few = ("detect", *star, "-n", "100", "--tails", "counted", "--no-pictures")
    for ending, form in (("csv", "ascii.csv"), ("ecsv", "ascii.ecsv"), ("fits", "fits")):
        name = f"flares.{ending}"
        Table({"amplitude": [0.1, 0.2], "tstart": [1.0, 2.0]}).write(folder / name, format=form)
        cases[name] = Case(name, ((*few, "--flares", name),))
    (folder / "weights.txt").write_text("190 0.5\n400 1\n700 1\n")
    cases["weights.txt"] = Case("weights.txt", ((*few, "--set", "run.weights.mine='weights.txt'"),))
    return cases | _stores(folder) | _answer(folder)


def _stores(folder: Path) -> dict[str, Case]:
    """Write a store of raw spectra with an engine that draws nothing, and its exports."""
    from mauvecl.device.engine import Engine
    from mauvecl.runs import bulk
    from mauvecl.runs.bulk import Selection, export
    from mauvecl.study.study import Study

    class Painter(Engine):
        """Engine without a device, whose rows are the expectation and a known pattern."""

        def __init__(self) -> None:
            """Make an engine without a device."""

        def realise(self, x: Any, *, start: int, count: int, out: Any = None, **_: Any) -> Any:
            pattern = (np.arange(start, start + count)[:, None] * 7 + np.arange(x.wavelength_nm.size) * 3) % 41 - 20
            rows = np.rint(x.mean_raw_dn + pattern).astype(np.uint16)
            if out is None:
                return rows
            out[:] = rows
            return out

    study = Study.build(
        {
            "star": [{"library": "G2V", "magnitude": 7.4}],
            "flare": {"amplitudes": [0.24]},
            "observation": {"exposure_s": 5.0, "changes": {"output_min_nm": 300.0, "output_max_nm": 330.0}},
            "run": {"realisations": 30, "seed": 11},
        },
        "fuzz",
    )
    store = bulk.realise(study, folder / "frames.zarr", Painter())
    for name in ("frames.h5", "frames.fits"):
        export(Selection.of(store), folder / name)
    words = (
        ("verify", "frames.zarr"),
        ("export", "frames.zarr", "new.h5"),
        (*ANALYSE, "frames.zarr[star-1/quiescent]"),
    )
    cases = {
        f"store {file}": Case(f"frames.zarr/{file}", words, (0, 1, 2))
        for file in ("zarr.json", "star-1/zarr.json", "star-1/quiescent/zarr.json", "star-1/quiescent/digests.txt",
                     "star-1/quiescent/c/0/0", "star-1/dark_dn/zarr.json", "star-1/dark_dn/c/0")
    }  # fmt: skip
    for name in ("frames.h5", "frames.fits"):
        cases[name] = Case(name, ((*ANALYSE, f"{name}[star-1/quiescent]"), (*ANALYSE, name)))
    return cases


def _answer(folder: Path) -> dict[str, Case]:
    """Write the answer of a verb, whose files `verify` checks and whose tables are studies."""
    code, _, log = ended(
        [*EXPOSURE, "--star", "G2V", "--magnitude", "8"], folder, lambda: None, {"MAUVECL_DATA_DIR": str(folder / "d")}
    )
    assert code == 0, log
    (folder / "out").rename(folder / "answer")
    table = next((folder / "answer").glob("*.ecsv")).name
    return {
        f"answer {name}": Case(f"answer/{name}", words, (0, 1, 2))
        for name, words in {
            "run.json": (("verify", "answer"),),
            "study.toml": (("verify", "answer"), ("exposure", "answer/study.toml", *EXPOSURE[1:])),
            table: (("verify", "answer"), ("exposure", f"answer/{table}", *EXPOSURE[1:])),
        }.items()
    }


# Mutations.


def mutated(content: bytes, name: str, chance: random.Random) -> bytes:
    """Return content with one to three mutations that suit its format."""
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        kinds: list[Callable[[bytes, random.Random], bytes]] = [_bytes]
        if content.startswith(b"SIMPLE"):
            kinds += [_cards, _cards, _cards, _extensions]
        elif name.endswith(".json"):
            kinds += [_json, _json, _json]
        elif not content.startswith((b"\x1f\x8b", b"\x89HDF")) and b"\0" not in content[:4096]:
            kinds += [_lines, _lines, _tokens, _tokens]
            if name.endswith(".toml"):
                kinds += [_toml, _toml]
        content = chance.choice(kinds)(content, chance)
    return content


def _bytes(content: bytes, chance: random.Random) -> bytes:
    data, n = bytearray(content), len(content)
    if not n:
        return chance.randbytes(20)
    a, b = sorted((chance.randrange(n), chance.randrange(n)))
    short = slice(a, a + chance.choice((1, 4, 80, 2880)))
    match chance.randrange(7):
        case 0:
            for _ in range(chance.choice((1, 3, 30))):
                data[chance.randrange(n)] ^= 1 << chance.randrange(8)
        case 1:
            del data[a:]
        case 2:
            del data[short]
        case 3:
            data[a:a] = data[short]
        case 4:
            data[short] = bytes(len(data[short]))
        case 5:
            data[a:a] = chance.randbytes(chance.choice((1, 100)))
        case _:
            data[a:b] = data[b : 2 * b - a]
    return bytes(data)


def _headers(content: bytes) -> list[tuple[int, int]]:
    """Return the places of the headers of a FITS file."""
    found = []
    for match in re.finditer(rb"SIMPLE  =|XTENSION=", content):
        if match.start() % 2880 == 0 and (end := content.find(b"END" + b" " * 77, match.start())) > 0:
            found.append((match.start(), end))
    return found


def _cards(content: bytes, chance: random.Random) -> bytes:
    """Change a card of a header: its value, its keyword, twice, or none."""
    headers = _headers(content)
    if not headers:
        return _bytes(content, chance)
    start, end = chance.choice(headers)
    place = start + 80 * chance.randrange(max(1, (end - start) // 80))
    card = content[place : place + 80]
    match chance.randrange(6):
        case 0:
            card = b" " * 80
        case 1:
            other = start + 80 * chance.randrange(max(1, (end - start) // 80))
            card = content[other : other + 80]
        case 2:
            card = card[:8].ljust(8) + b"= "
        case 3:
            card = bytes(chance.randrange(256) for _ in range(80))
        case _:
            card = card[:8] + b"= " + chance.choice(FITS_VALUES).rjust(20).encode()
    return content[:place] + card[:80].ljust(80) + content[place + 80 :]


def _extensions(content: bytes, chance: random.Random) -> bytes:
    """Repeat, remove or move an extension."""
    starts = [start for start, _ in _headers(content)] + [len(content)]
    parts = [content[a:b] for a, b in itertools.pairwise(starts)]
    if len(parts) < 2:
        return content * 2
    k = chance.randrange(len(parts))
    match chance.randrange(4):
        case 0:
            parts.insert(k, parts[chance.randrange(len(parts))])
        case 1:
            del parts[k]
        case 2:
            chance.shuffle(parts)
        case _:
            parts[k] = parts[k][:2880]
    return b"".join(parts)


def _lines(content: bytes, chance: random.Random) -> bytes:
    lines = content.split(b"\n")
    k = chance.randrange(len(lines))
    match chance.randrange(8):
        case 0:
            del lines[k]
        case 1:
            lines.insert(k, chance.choice(lines))
        case 2:
            lines[k] = lines[k][: len(lines[k]) // 2]
        case 3:
            return b" ".join(lines)
        case 4:
            lines[k] *= chance.choice((2, 3000))
        case 5:
            lines[k] = b",".join(reversed(lines[k].split(b",")))
        case 6:
            return content.replace(b"\n", b"\r")
        case _:
            lines = lines[:k] + [b""] * 3 + lines[k:]
    return b"\n".join(lines)


def _tokens(content: bytes, chance: random.Random) -> bytes:
    tokens = list(re.finditer(rb"[^\s,;|<>=\"]+", content))
    if not tokens:
        return _bytes(content, chance)
    token = chance.choice(tokens)
    new = chance.choice(ODD).encode() if chance.random() < 0.7 else chance.choice(tokens)[0]
    return content[: token.start()] + new + content[token.end() :]


def _changed(data: Any, chance: random.Random) -> Any:
    """Replace, remove or add a value of nested data."""
    places: list[tuple[Any, Any]] = []

    def find(value: Any) -> None:
        items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        for key, item in items:
            places.append((value, key))
            find(item)

    find(data)
    if not places:
        return data
    parent, key = chance.choice(places)
    match chance.randrange(4):
        case 0:
            del parent[key]
        case 1:
            parent[key] = [parent[key]] * chance.choice((1, 2, 50))
        case _:
            parent[key] = chance.choice(ODD_VALUES)
    return data


def _json(content: bytes, chance: random.Random) -> bytes:
    if chance.random() < 0.1:
        return chance.choice((b"[" * 200_000, b'{"a":' * 5000 + b"1" + b"}" * 5000, b"null", b"1e999", b'"x"'))
    try:
        return json.dumps(_changed(json.loads(content), chance)).encode()
    except (ValueError, RecursionError):
        return _bytes(content, chance)


def _toml(content: bytes, chance: random.Random) -> bytes:
    import tomli_w

    try:
        data = _changed(tomllib.loads(content.decode()), chance)
        return tomli_w.dumps(data).encode()
    except (ValueError, TypeError, UnicodeError):
        return _bytes(content, chance)


# Runs.


def ended(
    words: list[str], folder: Path, limit: Callable[[], None], environment: dict[str, str]
) -> tuple[int, str, str]:
    """Run a command in a forked process; return its exit code, output and messages; codes above 1000 are signals."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as log:
        child = os.fork()
        if child == 0:
            code = 70
            try:
                os.chdir(folder)
                os.environ.update(environment)
                os.dup2(out.fileno(), 1)
                os.dup2(log.fileno(), 2)
                sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
                sys.argv = ["mauvecl", *words]
                limit()
                from mauvecl.cli.app import main

                main()
                code = 0
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else 0
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        deadline = time.monotonic() + PATIENCE
        while (status := os.waitpid(child, os.WNOHANG))[0] == 0:
            if time.monotonic() > deadline:
                os.kill(child, signal.SIGKILL)
            time.sleep(0.005)
        texts = []
        for file in (out, log):
            file.seek(0)
            texts.append(file.read(100_000).decode(errors="replace"))
    code = os.waitstatus_to_exitcode(status[1])
    return (code if code >= 0 else 1000 - code), *texts


def limited() -> None:
    """Limit the processor time and the memory of this process."""
    here = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (here + ROOM, here + ROOM))
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def fault_of(code: int, out: str, log: str, codes: tuple[int, ...]) -> str:
    """Return what is wrong with the outcome of a command, or an empty string."""
    if code > 1000:
        return f"ended by signal {code - 1000}"
    if code not in codes:
        return f"exit code {code}"
    if "Traceback" in out + log:
        return "traceback"
    said = [line for line in log.splitlines() if not line.startswith("mauvecl: note: ")]
    if code != 2:
        return f"writes {said[0]!r}" if said else ""
    if len(said) != 1 or not said[0].startswith("mauvecl: "):
        return f"{len(said)} sentences"
    sentence = said[0]
    if len(sentence) > 1200:
        return "long sentence"
    if sentence.endswith((":", ": ", "()", ",")) or ": , expected" in sentence or "()" in sentence:
        return "sentence with an empty part"
    if "memory" in sentence:
        return "refused for memory"
    if found := FOREIGN.search(sentence):
        return f"text of another library: {found[0]!r}"
    return ""


@dataclass(frozen=True)
class Fault:
    """A mutated file that is not taken as it should be."""

    number: int
    name: str
    words: tuple[str, ...]
    fault: str
    said: str


def run(numbers: range, seed: int, only: str = "", keep: Path | None = None) -> Iterator[Fault | None]:
    """Run cases by number; yield the fault of each, or None."""
    import mauvecl

    # Forked processes import nothing more, which saves half a second of each.
    for module in pkgutil.walk_packages(mauvecl.__path__, "mauvecl."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    with tempfile.TemporaryDirectory(prefix="mauvecl-fuzz-") as place:
        intact = Path(place) / "intact"
        intact.mkdir()
        cases = {name: case for name, case in make(intact).items() if only in name}
        for number in numbers:
            chance = random.Random(f"{seed} {number}")
            name = list(cases)[number % len(cases)]
            case = cases[name]
            folder = Path(place) / str(number)
            shutil.copytree(intact, folder)
            content = (folder / case.file).read_bytes()
            (folder / case.file).write_bytes(mutated(content, case.file, chance))
            words = chance.choice(case.commands)
            code, out, log = ended(
                list(words), folder, limited, {"MAUVECL_DATA_DIR": str(folder / "d"), "COLUMNS": "200"}
            )
            fault = fault_of(code, out, log, case.codes)
            if fault and keep is not None:
                kept = keep / f"{number}" / case.file
                kept.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(folder / case.file, kept)
            shutil.rmtree(folder)
            yield Fault(number, name, words, fault, log.strip()[-3000:]) if fault else None


def main() -> int:
    """Run the cases, and print those that fail."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=43)
    parser.add_argument("--only", default="", help="part of the names of the files")
    parser.add_argument("--output", type=Path, default=None, help="folder for files that fail")
    asked = parser.parse_args()
    numbers = range(asked.first, asked.first + asked.cases)
    faults = 0
    for fault in run(numbers, asked.seed, asked.only, asked.output):
        if fault is not None:
            faults += 1
            print(
                f"{fault.number} {fault.name}: {fault.fault}\n  mauvecl {' '.join(fault.words)}\n  {fault.said}",
                flush=True,
            )
    print(f"{faults} of {asked.cases} cases failed (seed {asked.seed})")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
