"""Wheel and sdist: the same bytes for the same files, complete, with the licences of the embedded data."""

import io
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from typing import NamedTuple

import pytest

import mauvecl

pytestmark = pytest.mark.long

ROOT = Path(__file__).parent.parent
#: What a checkout has, or an unpacked sdist; a working copy has much more beside it.
FOLDERS = (".ci", ".github", "bench", "docs", "host", "kernels", "mauvecl", "paper", "recipe", "tests", "tools")
FILES = (
    ".dockerignore", ".gitignore", "CHANGELOG.md", "CITATION.cff", "CODE_OF_CONDUCT.md", "CONTRIBUTING.md",
    "Dockerfile", "LICENSE", "Makefile", "README.md", "SECURITY.md", "SUPPORT.md", "environment.yml", "pyproject.toml",
)  # fmt: skip
MADE = ("__pycache__", "_build", "_generated", "commands", "jupyter_execute", ".ipynb_checkpoints", "*_cache",
        ".hypothesis", "node_modules")  # fmt: skip
VERSION = mauvecl.__version__
WHEEL = f"mauvecl-{VERSION}-py3-none-any.whl"
SDIST = f"mauvecl-{VERSION}.tar.gz"
BUILD = """import sys
from hatchling.build import build_sdist, build_wheel
build_sdist(sys.argv[1])
build_wheel(sys.argv[1])
"""


class Packages(NamedTuple):
    """Tree of sources and the packages that are built from it."""

    tree: Path
    wheel: bytes
    sdist: bytes


def copied(tree: Path) -> Path:
    """Copy the sources, links as links."""
    for name in FOLDERS:
        shutil.copytree(ROOT / name, tree / name, symlinks=True, ignore=shutil.ignore_patterns(*MADE))
    for name in FILES:
        shutil.copyfile(ROOT / name, tree / name)
    return tree


def built(tree: Path, out: Path) -> Packages:
    """Build without a network: the backend is installed with the tests."""
    unset = {key: value for key, value in os.environ.items() if key != "SOURCE_DATE_EPOCH"}
    subprocess.run([sys.executable, "-c", BUILD, str(out)], cwd=tree, env=unset, check=True)
    return Packages(tree, (out / WHEEL).read_bytes(), (out / SDIST).read_bytes())


def files_below(tree: Path) -> set[str]:
    """Return the files of a tree, those behind links as well."""
    return {
        str((Path(folder) / name).relative_to(tree))
        for folder, _, names in os.walk(tree, followlinks=True)
        for name in names
    }


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Packages:
    tree = copied(tmp_path_factory.mktemp("checkout"))
    return built(tree, tmp_path_factory.mktemp("built"))


@pytest.fixture(scope="module")
def unpacked(packages: Packages, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unpacked")
    (folder / SDIST).write_bytes(packages.sdist)
    with tarfile.open(folder / SDIST) as archive:
        archive.extractall(folder, filter="data")
    return folder / f"mauvecl-{VERSION}"


def test_same_files_give_the_same_packages(packages: Packages, tmp_path: Path) -> None:
    """Build in another folder, with other times and permissions of the files."""
    tree = copied(tmp_path / "elsewhere")
    for number, path in enumerate(sorted(tree.rglob("*"))):
        if not path.is_symlink():
            os.utime(path, (1_000_000_000 + number, 1_000_000_000 + number))
            path.chmod(path.stat().st_mode & 0o750)
    again = built(tree, tmp_path / "out")
    assert again.wheel == packages.wheel
    assert again.sdist == packages.sdist


def test_sdist_holds_every_file_and_no_link(packages: Packages, unpacked: Path) -> None:
    assert files_below(unpacked) - {"PKG-INFO"} == files_below(packages.tree)
    assert not [path for path in unpacked.rglob("*") if path.is_symlink()]


def test_wheel_from_the_sdist_equals_that_from_the_checkout(packages: Packages, unpacked: Path, tmp_path: Path) -> None:
    assert built(unpacked, tmp_path).wheel == packages.wheel


def test_wheel_holds_the_package_and_the_licences(packages: Packages) -> None:
    """Check that it holds nothing else; the sdist, from which the same wheel is built, has the licences as well."""
    wheel = zipfile.ZipFile(io.BytesIO(packages.wheel))
    package = {f"mauvecl/{name}" for name in files_below(packages.tree / "mauvecl")}
    assert {name for name in wheel.namelist() if ".dist-info/" not in name} == package
    texts = [ROOT / "LICENSE", *(ROOT / "host" / "stars" / "library" / "licenses").iterdir()]
    assert len(texts) == 4
    for text in texts:
        assert wheel.read(f"mauvecl-{VERSION}.dist-info/licenses/{text.relative_to(ROOT)}") == text.read_bytes()
