"""Addresses, origins and uploads that the page cannot use raise an InputError that names the key."""

from __future__ import annotations

import pytest
from refusals import refused

from mauvecl.web import access
from mauvecl.web.upload import read_pairs


@pytest.mark.parametrize("address", ["", "0.0.0.0", "::", "no such host"])
def test_invalid_address_raises(address: str) -> None:
    """Addresses that are open to others need the names by which they are reached."""
    with refused("address", value=address):
        access.hosts(address, 5006, [])


@pytest.mark.parametrize("origin", ["*", "http://*", "", "a b", "https://x/path", "x:port", "x,y"])
def test_invalid_origin_raises(origin: str) -> None:
    with refused("allow_origin", value=origin):
        access.hosts("0.0.0.0", 5006, [origin])


#: Uploaded spectra of an unknown, and the key of the error.
SPECTRA = {
    "nothing": (b"", "upload"),
    "one wavelength": (b"200 1\n", "upload"),
    "three columns": (b"200 1 2\n300 1 2\n", "upload"),
    "descending wavelengths": (b"300 1\n200 1\n", "upload"),
    "bytes": (b"\xff\xfe", "upload"),
    "words": (b"a b\nc d\n", "file"),
    "nan": (b"1 nan\n2 1\n", "upload"),
    "too many rows": (b"1 1\n" * 100_000, "upload"),
}


@pytest.mark.parametrize("name", SPECTRA)
def test_invalid_spectrum_raises(name: str) -> None:
    content, key = SPECTRA[name]
    with refused(key):
        read_pairs("stray.txt", content)
