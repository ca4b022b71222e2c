"""Write `docs/dependencies.md`: licence, last release and known vulnerabilities of what mauvecl depends on.

Run it in an environment with all extras, `python tools/audit_dependencies.py INDEX`, where INDEX is the address of a
package index with PyPI's JSON interface. Licences are read from the installed packages, releases and vulnerabilities
from the index, which takes the latter from https://osv.dev. It fails if a dependency has no purpose here.
"""

from __future__ import annotations

import json
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date
from importlib import metadata
from pathlib import Path
from urllib.request import urlopen

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/dependencies.md"

PURPOSES = {
    "numpy": "arrays",
    "scipy": "distributions, interpolation, optimisation, sparse matrices",
    "astropy": "units, tables, FITS, times, coordinates, blackbodies",
    "synphot": "bandpasses, magnitudes, extinction",
    "mako": "templates of the OpenCL kernels",
    "pyopencl": "OpenCL; its extra `pocl` brings a driver for processors",
    "pydantic": "studies, instruments and arguments: validation, JSON schema",
    "typer": "the command line",
    "rich": "progress and tables in the terminal",
    "platformdirs": "folders of caches and of the user's own spectra",
    "tomli-w": "study files that are written",
    "sgp4": "positions of the satellite from its orbital elements",
    "celerite2": "Gaussian processes of the quiescent light of stars",
    "matplotlib": "pictures",
    "dust_extinction": "extinction laws",
    "specutils": "spectrum files of many archives",
    "zarr": "stores of raw spectra",
    "xarray": "stores of raw spectra with named axes",
    "xxhash": "digests of raw spectra",
    "google-crc32c": "checksums of the parts of a store",
    "h5py": "raw spectra as HDF5",
    "astroquery": "names of stars from SIMBAD",
    "distributed": "many machines, through Dask",
    "cryptography": "encrypted connections of Dask",
    "intel-opencl-rt": "Intel's OpenCL driver for processors",
    "intel-cmplr-lib-rt": "libraries of Intel's driver",
    "tbb": "threads of Intel's driver",
    "bokeh": "plots of the page",
    "tornado": "the server of the page",
}
#: Extras for development; what users install is audited.
DEVELOPMENT = ("all", "test", "coverage", "dist", "lint", "bench", "docs")


@dataclass(frozen=True)
class Dependency:
    """A package that pyproject.toml names, and the extra that needs it."""

    requirement: Requirement
    extra: str

    @property
    def lowest(self) -> str:
        """Lower bound of the version."""
        return next((one.version for one in self.requirement.specifier if one.operator == ">="), "")


def dependencies() -> Iterator[Dependency]:
    """Yield the dependencies of the package, then those of its extras, each once."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    groups = {"": project["dependencies"], **project["optional-dependencies"]}
    found: set[str] = set()
    for extra, lines in groups.items():
        for requirement in map(Requirement, lines):
            if extra in DEVELOPMENT or requirement.name in found:
                continue
            if requirement.name not in PURPOSES:
                sys.exit(f"{requirement.name} has no purpose in {Path(__file__).name}")
            found.add(requirement.name)
            yield Dependency(requirement, extra)
    if unused := PURPOSES.keys() - found:
        sys.exit(f"pyproject.toml does not name {', '.join(sorted(unused))}")


def licence(name: str) -> str:
    """Return the licence that an installed package states, or an empty text if it is not installed."""
    try:
        about = metadata.metadata(name)
    except metadata.PackageNotFoundError:
        return ""
    stated = [about.get("License-Expression"), *(about.get("License") or "").splitlines()[:1]]
    stated += [
        line.rsplit("::", 1)[1].strip() for line in about.get_all("Classifier", []) if line.startswith("License ::")
    ]
    return next((text for text in stated if text and len(text) < 60), "")


def published(index: str, name: str) -> tuple[str, date, list[str]]:
    """Return the last release on the index, its date, and the vulnerabilities that are known of it."""
    with urlopen(f"{index.rstrip('/')}/pypi/{name}/json", timeout=60) as answer:
        about = json.load(answer)
    files = about["urls"]
    day = date.fromisoformat(max(one["upload_time"] for one in files)[:10])
    return about["info"]["version"], day, [one["id"] for one in about["vulnerabilities"] if not one["withdrawn"]]


def page(index: str) -> str:
    """Return the text of the page."""
    lines = [
        "# Dependencies",
        "",
        f"Made by `tools/audit_dependencies.py` on {date.today()}: licences as the installed packages state them, last",
        "releases and their known vulnerabilities as PyPI lists them.",
        "`make lowest` runs the short tests with the lowest versions.",
        "",
        "| package | extra | used for | lowest | last release | licence | known vulnerabilities |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in dependencies():
        name = one.requirement.name
        version, day, faults = published(index, name)
        cells = (
            name,
            one.extra and f"`[{one.extra}]`",
            PURPOSES[name],
            one.lowest,
            f"{version}, {day}",
            licence(name),
            ", ".join(faults) or "none",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    PAGE.write_text(page(sys.argv[1]), encoding="utf-8")
