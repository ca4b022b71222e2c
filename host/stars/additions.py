"""Additions to the user's own stars, from files and from public collections of HST spectra."""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import io
import re
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from urllib.parse import urljoin, urlsplit

from mauvecl.host import VERSION
from mauvecl.host.stars.library import OwnStar, embedded, find, folder, user_stars
from mauvecl.host.stars.source import Source, check_covers
from mauvecl.host.tables.files import limit_bytes, read_bytes, without_columns, write_whole
from mauvecl.host.tables.names import key_of
from mauvecl.schema.errors import InputError


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
    """Keep the spectrum of a file among the user's own stars, which are found by name like those of the library.

    `Source.read` reads the file, to which the units and `extend` are passed on. The name is by default that in the
    file's header, or else that of the file; reports state the `origin`, by default the name of the file. With
    `replace`, a kept star of the same name is replaced. Raises InputError if the file contains no usable spectrum, the
    name is taken or invalid, or the folder cannot be written.
    """
    from astropy.table import Table

    file, _ = without_columns(path)
    content = read_bytes(file, "spectrum file")
    source = Source.read(path, wavelength_unit=wavelength_unit, flux_unit=flux_unit, extend=extend)
    check_covers(source)
    name = (name or source.name).strip()
    target = _path_of(name, replace=replace)
    table = Table(source.table)
    table.meta = {
        "name": name,
        "origin": origin or f"file {file.name}",
        "file_sha256": hashlib.sha256(content).hexdigest(),
        "spectrum_sha256": source.digest,
        "kept_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "notes": list(source.notes),
        "told": list(source.messages),
        "unscaled": source.unscaled,
    }
    if source.measured_nm is not None:
        table.meta["measured_nm"] = list(source.measured_nm)
    text = io.StringIO()
    table.write(text, format="ascii.ecsv")
    try:
        write_whole(target, text.getvalue().encode(), shared=True)
    except InputError as error:
        raise error.within("star folder (MAUVECL_DATA_DIR sets another)") from error
    star = find(name)
    assert star is not None
    return star


def _path_of(name: str, *, replace: bool) -> Path:
    """Return the file of a star to keep; raises InputError if the name is invalid or taken."""
    if not re.fullmatch(r"[\w][\w .+\-*'()]{0,63}", name):
        raise InputError.of("name", name, "up to 64 letters, digits, spaces and . + - * ' ( )")
    if embedded(name) is not None:
        raise InputError(f"star name {name!r} is one of the embedded library's: give another with `name`", key="name")
    if (star := find(name)) is not None:
        if not replace:
            raise InputError(f"star {name!r} is kept already: give another name, or use `replace=True`", key="name")
        return star.path
    if any(key_of(star.name) == key_of(name) for star in user_stars()):
        raise InputError(f"star name {name!r} is too much like another kept star's: give another", key="name")
    path = folder() / f"{re.sub(r'[^A-Za-z0-9.+-]', '_', name)}.ecsv"
    if path.exists():
        # Letters that file names cannot have, such as Greek ones, are equal in them: the digest of the name differs.
        path = path.with_stem(f"{path.stem}-{hashlib.sha256(name.casefold().encode()).hexdigest()[:8]}")
    return path


#: Timeout of a connection, s.
TIMEOUT_S = 20.0
#: Schemes of an address; a local file is added, not downloaded.
SCHEMES = ("http", "https", "ftp")
#: Longest duration of a download, s: the largest file of `files.LIMITS` at 0.5 MB/s.
MAX_DOWNLOAD_S = 600.0
#: Largest size of a listing, bytes.
MAX_LISTING_BYTES = 20 * 2**20


@dataclass(frozen=True)
class Collection:
    """A public collection of HST spectra."""

    name: str
    title: str
    citation: str
    base: str  # address of the files, from the archive's pages; not verified by the tests
    # Path of a star's file below the base, from the star's name in names of files and a function that lists the files.
    file_of: Callable[[str, Callable[[], list[str]]], str]


def _ngsl_file(plain: str, listing: Callable[[], list[str]]) -> str:
    """Return the path of a star's file, whose name has HD numbers of six digits."""
    padded = re.sub(r"^hd0*(\d{1,6})$", lambda match: f"hd{int(match[1]):06d}", plain)
    return f"{padded}/h_stis_ngsl_{padded}_v2.fits"


def _latest_calspec(plain: str, listing: Callable[[], list[str]]) -> str:
    """Return the name of a star's STIS file with the highest version number."""
    files = [file for file in listing() if re.fullmatch(rf"{re.escape(plain)}_stis(wfcnic|wfc|nic)?_\d+\.fits", file)]
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
        _ngsl_file,
    ),
    Collection(
        "lowlib",
        "the HST stellar library of 513 stars, dereddened",
        "Pal et al. 2023, doi 10.17909/kmdt-pw63",
        "https://archive.stsci.edu/hlsps/lowlib/",
        lambda plain, listing: f"hlsp_lowlib_hst_stis_{plain}_g230lb-g430l-g750l_v1.0_spect.fits",
    ),
)


def fetch(
    name: str, *, base: str | None = None, replace: bool = False, show_progress: bool = True, extend: str | None = None
) -> OwnStar:
    """Download a star from a public collection and keep it, as `add` does.

    A name such as ``"HD 37202"`` is searched for in all collections, and ``"ngsl:HD 37202"`` in a single one, for which
    `base` may be the address of a mirror of its files. `extend` is a library spectrum that continues the star's beyond
    its end. The terminal shows the progress unless `show_progress` is false. Raises InputError if the network fails,
    the star is unknown, or its file contains no usable spectrum.
    """
    word, colon, star = map(str.strip, name.partition(":"))
    chosen = [c for c in COLLECTIONS if c.name == word.casefold()] if colon else list(COLLECTIONS)
    if not chosen:
        raise InputError.of("collection", word, f"one of {', '.join(c.name for c in COLLECTIONS)}")
    if base is not None and not colon:
        raise InputError(f"with another address, {name!r} must name its collection too, as in ngsl:{name}", key="name")
    star = star if colon else word
    plain = re.sub(r"[^a-z0-9+-]", "", star.casefold())
    if not plain:
        raise InputError(f"star {name!r} has an empty name; give a name such as ngsl:HD 37202", key="name")
    for collection in chosen:
        try:
            address = _folder_address(base or collection.base)
            url = urljoin(address, collection.file_of(plain, partial(_listing, address)))
            content = _download(url, limit_bytes("MAUVECL_LARGEST_FILE_MIB"), show_progress)
        except FileNotFoundError:
            continue
        with tempfile.TemporaryDirectory(prefix="mauvecl-fetch-") as directory:
            # Messages and notes use the archive's file name.
            local = Path(directory) / url.rsplit("/", 1)[1]
            local.write_bytes(content)
            try:
                title = f"{collection.title}; {collection.citation}; {url}"
                return add(local, star, origin=title, replace=replace, extend=extend)
            except InputError as error:
                fault = f"the file downloaded from {url} must be a complete, usable spectrum, but is not ({error})"
                raise InputError(fault, key="base") from error
    fault = f"no star {star!r} is in {' or '.join(collection.title for collection in chosen)}"
    remedy = "give the collection's name of the star, such as HD 37202, or add a file: mauvecl library add"
    raise InputError(f"{fault}; {remedy}", key="name")


def _folder_address(address: str) -> str:
    """Return an address that ends in a slash; raises InputError unless it is a URL of a supported scheme."""
    is_address = False
    with contextlib.suppress(ValueError):
        url = urlsplit(address)
        is_address = url.scheme in SCHEMES and bool(url.hostname) and url.port != 0
    if not (is_address and address.isprintable() and " " not in address):
        raise InputError.of("base", address, "one such as https://host/folder/")
    return address if address.endswith("/") else address + "/"


def _download(url: str, max_bytes: int, show_progress: bool) -> bytes:
    """Download a file within limits of size and time; raises FileNotFoundError if the server has none."""
    # Imported here because TLS is slow to import and most runs download nothing.
    import http.client
    import urllib.error
    import urllib.request

    from astropy.utils.console import ProgressBarOrSpinner

    latest, content = time.monotonic() + MAX_DOWNLOAD_S, bytearray()
    request = urllib.request.Request(url, headers={"User-Agent": f"mauvecl/{VERSION}"})
    terminal = sys.stderr if show_progress else io.StringIO()
    try:
        with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
            length = answer.headers.get("Content-Length", "")
            size = int(length) if length.isascii() and length.isdigit() and len(length) < 20 else 0
            with ProgressBarOrSpinner(size or None, f"Fetching {url}", file=terminal) as bar:
                # A server may state no size or a wrong one, and never stop sending.
                while max(size, len(content)) <= max_bytes and (piece := answer.read1(1 << 16)):
                    content += piece
                    bar.update(len(content))
                    if time.monotonic() > latest:
                        raise TimeoutError(f"it takes more than {MAX_DOWNLOAD_S:.0f} s")
    except urllib.error.HTTPError as error:
        if error.code in (403, 404, 410):
            # Object stores answer 403 for a missing file.
            raise FileNotFoundError(url) from error
        raise InputError(f"{url} answers {error.code} {error.reason}: try again later", key="base") from error
    except (OSError, ValueError, http.client.HTTPException) as error:
        # Invalid host names raise ValueError (IDNA codec), malformed responses HTTPException.
        fault = f"{url} cannot be downloaded ({getattr(error, 'reason', error)})"
        remedy = f"without a network give the file: mauvecl library add {url.rsplit('/', 1)[1] or 'FILE'}"
        raise InputError(f"{fault}; {remedy}", key="base") from error
    if max(size, len(content)) > max_bytes:
        limit = "MAUVECL_LARGEST_FILE_MIB"
        fault = f"{url} has more than {max_bytes >> 20} MiB; {limit} may set a higher limit for files"
        raise InputError(fault, key=limit)
    if len(content) < size:
        fault = f"the download of {url} ended early ({len(content)} of {size} bytes received): try again"
        raise InputError(fault, key="base")
    return bytes(content)


def _listing(address: str) -> list[str]:
    """Return the names of the files to which a server's page of a folder links."""
    text = _download(address, MAX_LISTING_BYTES, False).decode("utf-8", "replace")
    return [link.rsplit("/", 1)[-1] for link in re.findall(r'href="([^"?#]+)"', text, flags=re.IGNORECASE)]
