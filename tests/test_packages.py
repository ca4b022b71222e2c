"""Wheel and sdist: the same bytes for the same files, complete, with the licences of the embedded data."""

import io
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from scripts import ROOT

import mauvecl

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


def copied(tree: Path) -> Path:
    """Copy the sources, links as links."""
    for name in FOLDERS:
        shutil.copytree(ROOT / name, tree / name, symlinks=True, ignore=shutil.ignore_patterns(*MADE))
    for name in FILES:
        shutil.copyfile(ROOT / name, tree / name)
    return tree


def built(tree: Path, out: Path) -> tuple[bytes, bytes]:
    """Build wheel and sdist without a network: the backend is installed with the tests."""
    unset = {key: value for key, value in os.environ.items() if key != "SOURCE_DATE_EPOCH"}
    subprocess.run([sys.executable, "-c", BUILD, str(out)], cwd=tree, env=unset, check=True)
    return (out / WHEEL).read_bytes(), (out / SDIST).read_bytes()


def files_below(tree: Path) -> set[str]:
    """Return the files of a tree, those behind links as well."""
    return {
        str((Path(folder) / name).relative_to(tree))
        for folder, _, names in os.walk(tree, followlinks=True)
        for name in names
    }


@pytest.mark.long
def test_packages_are_the_same_for_the_same_files_complete_and_licensed(tmp_path: Path) -> None:
    tree = copied(tmp_path / "checkout")
    packages = wheel, sdist = built(tree, tmp_path / "built")
    with tarfile.open(fileobj=io.BytesIO(sdist)) as archive:
        archive.extractall(tmp_path, filter="data")
    unpacked = tmp_path / f"mauvecl-{VERSION}"
    assert files_below(unpacked) - {"PKG-INFO"} == files_below(tree)
    assert not [path for path in unpacked.rglob("*") if path.is_symlink()]
    assert built(unpacked, tmp_path)[0] == wheel
    # The wheel holds nothing else; the sdist, from which the same wheel is built, has the licences as well.
    held = zipfile.ZipFile(io.BytesIO(wheel))
    package = {f"mauvecl/{name}" for name in files_below(tree / "mauvecl")}
    assert {name for name in held.namelist() if ".dist-info/" not in name} == package
    texts = [ROOT / "LICENSE", *(ROOT / "host" / "stars" / "library" / "licenses").iterdir()]
    assert len(texts) == 4
    for text in texts:
        assert held.read(f"mauvecl-{VERSION}.dist-info/licenses/{text.relative_to(ROOT)}") == text.read_bytes()
    # In another folder, with other times and permissions of the files.
    elsewhere = copied(tmp_path / "elsewhere")
    for number, path in enumerate(sorted(elsewhere.rglob("*"))):
        if not path.is_symlink():
            os.utime(path, (1_000_000_000 + number, 1_000_000_000 + number))
            path.chmod(path.stat().st_mode & 0o750)
    assert built(elsewhere, tmp_path / "again") == packages
