"""Stars of one's own beside the embedded library: added from files, or fetched from public collections of HST spectra.

Each is an ECSV file in a folder of the user's, with its origin and the digest of its spectrum, which is compared at
every reading. Nothing is fetched unless asked for.
"""

from __future__ import annotations

import datetime
import hashlib
import io
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING
from urllib.parse import urljoin, urlsplit

from ..errors import InputError
from ..files.bounded import limit_bytes, read_bytes, shortened
from ..files.ecsv import read_ecsv
from ..files.parsed import parsing
from ..files.whole import write_whole
from ..spectra.formats import without_columns
from ..version import VERSION

if TYPE_CHECKING:
    import numpy as np
    from astropy.table import Table

    from .source import Source

#: Seconds without an answer.
TIMEOUT_S = 20.0
#: Schemes of an address; a local file is added, not fetched.
SCHEMES = ("http", "https", "ftp")
#: Seconds that a file may take to come: `bounded.LIMITS` at 0.5 MB/s.
LONGEST_S = 600.0
#: Bytes of a listing, at most.
MOST_LISTED = 20 * 2**20


@dataclass(frozen=True)
class OwnStar:
    """What is known of a kept star without reading its spectrum."""

    name: str
    origin: str
    notes: tuple[str, ...]
    dereddened: bool
    path: Path
    told: tuple[str, ...] = ()
    measured_nm: tuple[float, float] | None = None
    unscaled: str = ""


def folder() -> Path:
    """Where kept stars are: ``MAUVECL_DATA_DIR``, or the user's data folder."""
    import platformdirs

    given = os.environ.get("MAUVECL_DATA_DIR")
    return (Path(given) if given else platformdirs.user_data_path("mauvecl")) / "stars"


def kept() -> list[OwnStar]:
    """All stars kept, by name."""
    return [star for path in sorted(folder().glob("*.ecsv")) if (star := _described(path)) is not None]


def find(name: str) -> OwnStar | None:
    """One of them by name, in any case, or None."""
    wanted = name.strip().casefold()
    return next((star for star in kept() if star.name.casefold() == wanted), None)


def _described(path: Path) -> OwnStar | None:
    meta = _read(path).meta
    if not {"name", "origin", "spectrum_sha256"} <= set(meta):
        return None
    notes = tuple(str(note) for note in meta.get("notes", ()))
    told = tuple(str(text) for text in meta.get("told", ()))
    measured = meta.get("measured_nm")
    return OwnStar(
        str(meta["name"]), str(meta["origin"]), notes, bool(meta.get("dereddened")), path, told,
        None if measured is None else (float(measured[0]), float(measured[1])), str(meta.get("unscaled", "")),
    )  # fmt: skip


def _read(path: Path) -> Table:
    return read_ecsv(path, "kept star", "the file as it was kept: `mauvecl library remove` takes it away")


def spectrum(star: OwnStar) -> tuple[np.ndarray, np.ndarray]:
    """Wavelengths, nm, and fluxes, erg s-1 cm-2 A-1.

    Raises
    ------
    InputError
        If the file is not as it was kept.
    """
    import numpy as np

    table = _read(star.path)
    wavelength, flux = (np.asarray(table[name], float) for name in ("wavelength", "flux"))
    if _digest(wavelength, flux) != table.meta["spectrum_sha256"]:
        raise InputError(
            f"kept star {star.name!r} is not as it was kept (its digest differs), expected it unchanged: add or "
            "fetch it again"
        )
    return wavelength, flux


def _digest(wavelength: np.ndarray, flux: np.ndarray) -> str:
    return hashlib.sha256(wavelength.tobytes() + flux.tobytes()).hexdigest()


def add(
    path: str | Path,
    name: str | None = None,
    *,
    origin: str | None = None,
    replace: bool = False,
    wavelength_unit: str | None = None,
    flux_unit: str | None = None,
    extend: str | None = None,
) -> OwnStar:
    """Keep a spectrum from a file under a name.

    Parameters
    ----------
    path : str or Path
        As `formats.read_spectrum` takes it.
    name : str, optional
        That of the file's header, or the file's own, by default.
    origin : str, optional
        Where it came from.
    replace : bool
        Take the place of a kept star of that name.
    wavelength_unit, flux_unit, extend : str, optional
        As `Source.read` takes them.

    Raises
    ------
    InputError
        If the file holds no usable spectrum, the name is taken or impossible, or the folder cannot be written.
    """
    from astropy.table import Table

    from ..spectra.ends import check_covers
    from . import catalogue
    from .source import Source

    given = path
    path, _ = without_columns(path)
    content = read_bytes(path, "spectrum file")
    source: Source = Source.read(given, wavelength_unit=wavelength_unit, flux_unit=flux_unit, extend=extend)
    check_covers(source.name, source.measured_nm or (source.wavelength_nm[0], source.wavelength_nm[-1]))
    name = (name or source.name).strip()
    if not re.fullmatch(r"[\w][\w .+\-*'()]{0,63}", name):
        raise InputError(f"star name {name!r}, expected up to 64 letters, digits, spaces and . + - * ' ( )")
    if catalogue.embedded(name) is not None:
        raise InputError(f"star name {name!r} is one of the embedded library's, expected another: give one with --name")
    there = find(name)
    if there is not None and not replace:
        raise InputError(f"star {name!r} is kept already, expected another name, or --replace")
    dereddened = any("dereddened" in note for note in source.notes)
    table = Table({"wavelength": source.wavelength_nm, "flux": source.flux_flam})
    table["wavelength"].unit, table["flux"].unit = "nm", "erg / (s cm2 Angstrom)"
    table.meta |= {
        "name": name,
        "origin": origin or f"file {path.name}",
        "file_sha256": hashlib.sha256(content).hexdigest(),
        "spectrum_sha256": _digest(source.wavelength_nm, source.flux_flam),
        "kept_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "dereddened": dereddened,
        "notes": list(source.notes),
        "told": list(source.told),
        "unscaled": source.unscaled,
    }
    if source.measured_nm is not None:
        table.meta["measured_nm"] = list(source.measured_nm)
    place = there.path if there is not None else folder() / f"{re.sub(r'[^A-Za-z0-9.+-]', '_', name)}.ecsv"
    if there is None and place.exists():
        raise InputError(f"star name {name!r} is too much like another kept star's, expected another name")
    text = io.StringIO()
    table.write(text, format="ascii.ecsv")
    try:
        write_whole(place, text.getvalue().encode(), shared=True)
    except InputError as error:
        raise InputError(f"star folder: {error}; MAUVECL_DATA_DIR sets another") from error
    known = find(name)
    assert known is not None
    return known


def remove(name: str) -> None:
    """Forget a kept star.

    Raises
    ------
    InputError
        If there is none of that name.
    """
    wanted = name.strip().casefold()
    for path in sorted(folder().glob("*.ecsv")):
        if path.stem.casefold() == re.sub(r"[^a-z0-9.+-]", "_", wanted) or _named(path) == wanted:
            path.unlink()
            return
    names = ", ".join(star.name for star in kept()) or "none is kept"
    raise InputError(f"no kept star {name!r}, expected one of: {names}")


def _named(path: Path) -> str | None:
    try:
        described = _described(path)
    except InputError:
        return None
    return None if described is None else described.name.casefold()


@dataclass(frozen=True)
class Collection:
    """A public collection of HST spectra.

    Attributes
    ----------
    name, title, citation : str
    base : str
        Address of its files; assumed from the archive's pages, not verified here.
    file_of : callable
        The address of a star's file below the base, from the star's name and a function that gives a folder's listing.
    """

    name: str
    title: str
    citation: str
    base: str
    file_of: Callable[[str, Callable[[str], list[str]]], str]


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9+-]", "", name.casefold())


def _hd(name: str) -> str:
    """HD numbers with six digits, as archives write them in file names."""
    plain = _plain(name)
    match = re.fullmatch(r"(hd)0*(\d{1,6})", plain)
    return f"{match[1]}{int(match[2]):06d}" if match else plain


def _latest_calspec(name: str, listing: Callable[[str], list[str]]) -> str:
    """The newest STIS file of a star: CALSPEC counts them."""
    plain = _plain(name)
    files = [file for file in listing("") if re.fullmatch(rf"{re.escape(plain)}_stis(wfcnic|wfc|nic)?_\d+\.fits", file)]
    if not files:
        raise FileNotFoundError(plain)
    return max(files, key=lambda file: (int(file.rsplit("_", 1)[1][:-5]), file))


COLLECTIONS = (
    Collection(
        "calspec",
        "CALSPEC, HST's flux standards",
        "Bohlin, Gordon & Tremblay 2014, PASP 126, 711, doi 10.1086/677655",
        "https://archive.stsci.edu/hlsps/reference-atlases/cdbs/current_calspec/",
        _latest_calspec,
    ),
    Collection(
        "ngsl",
        "Next Generation Spectral Library, version 2",
        "Heap & Lindler 2007, ASP Conf. Ser. 374, 409",
        "https://archive.stsci.edu/pub/hlsp/stisngsl/v2/",
        lambda name, listing: f"{_hd(name)}/h_stis_ngsl_{_hd(name)}_v2.fits",
    ),
    Collection(
        "lowlib",
        "the HST stellar library of 513 stars, dereddened",
        "Pal et al. 2023, doi 10.17909/kmdt-pw63",
        "https://archive.stsci.edu/hlsps/lowlib/",
        lambda name, listing: f"hlsp_lowlib_hst_stis_{_plain(name)}_g230lb-g430l-g750l_v1.0_spect.fits",
    ),
)


def fetch(
    name: str,
    *,
    base: str | None = None,
    replace: bool = False,
    show_progress: bool = True,
    extend: str | None = None,
) -> OwnStar:
    """Fetch a star of a public collection and keep it.

    Parameters
    ----------
    name : str
        Such as ``"HD 37202"``, looked for in one collection after the other, or ``"ngsl:HD 37202"``.
    base : str, optional
        Another address of the collection's files: a mirror. The collection is to be named then.
    replace : bool
        Take the place of a kept star of that name.
    show_progress : bool
    extend : str, optional
        A library spectrum that goes on where the star's file ends.

    Raises
    ------
    InputError
        If there is no network, no such star, or what came is no usable spectrum.
    """
    word, colon, star = (part.strip() for part in name.partition(":"))
    chosen = [c for c in COLLECTIONS if c.name == word.casefold()] if colon else list(COLLECTIONS)
    known = ", ".join(c.name for c in COLLECTIONS)
    if not chosen:
        raise InputError(f"collection {word!r} is unknown, expected one of {known}")
    if base is not None and not colon:
        raise InputError(f"another address is given for {name!r}, expected its collection too, such as ngsl:{name}")
    star = star if colon else word
    if not _plain(star):
        raise InputError(f"star {name!r} has no name to look for, expected one such as ngsl:HD 37202")
    for collection in chosen:
        address = base or collection.base
        try:
            _check_address(address)
            url = urljoin(_folder(address), collection.file_of(star, partial(_listing, address)))
            downloaded = _download(url, show_progress)
        except FileNotFoundError:
            continue
        file = url.rsplit("/", 1)[1]
        # Messages and notes go by the archive's name of the file.
        local = downloaded.rename(downloaded.with_name(f"{downloaded.name}-{file}"))
        try:
            title = f"{collection.title}; {collection.citation}; {url}"
            return add(local, star, origin=title, replace=replace, extend=extend)
        except InputError as error:
            raise InputError(
                f"{url} came, and is no usable spectrum ({str(error).replace(local.name, file)}), expected a whole file"
            ) from error
        finally:
            local.unlink(missing_ok=True)
    where = " or ".join(c.title for c in chosen)
    raise InputError(
        f"no star {star!r} in {where}, expected its name there, such as HD 37202; or bring the file: "
        "mauvecl library add"
    )


def _folder(address: str) -> str:
    return address if address.endswith("/") else address + "/"


def _check_address(address: str) -> None:
    """Refuse what is no address of the network."""
    with parsing(f"address {shortened(address)}", "one such as https://host/folder/"):
        parts = urlsplit(address)
        known = parts.scheme in SCHEMES and bool(parts.hostname) and parts.port != 0
    if not (known and address.isprintable() and " " not in address):
        raise InputError(
            f"address {shortened(address)} is none of the network, expected one such as https://host/folder/"
        )


def _download(url: str, show_progress: bool, most: int | None = None) -> Path:
    """A file of the network, within limits of size and time; FileNotFoundError where the server has none."""
    # TLS takes a while to load, and most runs fetch nothing.
    import http.client
    import urllib.error

    most = limit_bytes("MAUVECL_LARGEST_FILE_MIB") if most is None else most
    descriptor, name = tempfile.mkstemp(prefix="mauvecl-fetch-")
    try:
        with open(descriptor, "wb") as file:
            _receive(url, file, most, show_progress)
        return Path(name)
    except BaseException as error:
        Path(name).unlink(missing_ok=True)
        if isinstance(error, InputError):
            raise
        if isinstance(error, urllib.error.HTTPError):
            if error.code in (403, 404, 410):
                # Archives on object stores answer 403 where there is nothing.
                raise FileNotFoundError(url) from error
            raise InputError(
                f"{url} answers {error.code} {error.reason}, expected the file: try again later"
            ) from error
        if not isinstance(error, OSError | ValueError | http.client.HTTPException):
            raise
        # Names that no host has are ValueErrors of the IDNA codec, wrong answers HTTPExceptions.
        reason = getattr(error, "reason", error)
        raise InputError(
            f"{url} cannot be reached ({reason}), expected a network; without one bring the file: mauvecl library add "
            f"{url.rsplit('/', 1)[1] or 'FILE'}"
        ) from error


def _receive(url: str, file: IO[bytes], most: int, show_progress: bool) -> None:
    """Write what a server sends, piece by piece, for it may tell a wrong size or none, and never end."""
    import urllib.request

    from astropy.utils.console import ProgressBarOrSpinner

    latest, got = time.monotonic() + LONGEST_S, 0
    request = urllib.request.Request(url, headers={"User-Agent": f"mauvecl/{VERSION}"})
    with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
        length = answer.headers.get("Content-Length", "")
        size = int(length) if length.isascii() and length.isdigit() and len(length) < 20 else None
        shown = sys.stderr if show_progress else io.StringIO()
        with ProgressBarOrSpinner(size, f"Fetching {url}", file=shown) as bar:
            while (size is None or size <= most) and (piece := answer.read1(1 << 16)):
                file.write(piece)
                got += len(piece)
                bar.update(got)
                if got > most:
                    size = got
                if time.monotonic() > latest:
                    raise InputError(f"{url} takes more than {LONGEST_S:.0f} s to come, expected less: try again later")
    if size is not None and size > most:
        raise InputError(
            f"{url} has more than {most >> 20} MiB, expected less; MAUVECL_LARGEST_FILE_MIB sets the limit of files"
        )
    if size is not None and got < size:
        raise InputError(f"{url} broke off ({got} of {size} bytes came), expected the whole file: try again")


def _listing(address: str, below: str) -> list[str]:
    """Names of the files that a server's page of a folder links to."""
    page = _download(urljoin(_folder(address), below), False, MOST_LISTED)
    try:
        text = page.read_text(encoding="utf-8", errors="replace")
    finally:
        page.unlink(missing_ok=True)
    return [link.rsplit("/", 1)[-1] for link in re.findall(r'href="([^"?#]+)"', text, flags=re.IGNORECASE)]
