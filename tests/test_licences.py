"""The licences of what is embedded are there, word for word; `test_packages.py` looks for them in packages."""

from __future__ import annotations

from pathlib import Path

import pytest
from astropy.table import Table

ROOT = Path(__file__).parent.parent
LIBRARY = ROOT / "host" / "stars" / "library"
#: What their licences ask to be kept with every copy.
NOTICES = {
    "pyphot": ("Copyright (c) 2016 Morgan Fouesneau", "The above copyright notice and this permission notice shall be"),
    "speclite": (
        "Copyright (c) 2015-2025, Speclite Developers",
        "Redistributions in binary form must reproduce the above",
    ),
    "EXOSIMS": ("Copyright (c) 2015, Dmitry Savransky", "Redistributions in binary form must reproduce the above"),
}


@pytest.mark.parametrize("package", NOTICES)
def test_every_source_of_data_has_its_licence(package: str) -> None:
    text = (LIBRARY / "licenses" / f"{package}.txt").read_text()
    assert all(notice in text for notice in NOTICES[package])


def test_all_data_have_a_licence() -> None:
    for file in LIBRARY.glob("*/*.ecsv"):
        meta = Table.read(file, format="ascii.ecsv").meta
        assert meta["licence"]
        packages = [name for name in NOTICES if name in meta["origin"]]
        assert packages, file
        assert all((LIBRARY / "licenses" / f"{name}.txt").exists() for name in packages)
