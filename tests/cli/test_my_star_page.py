"""The commands of the page about a star of one's own work, on files such as it speaks of."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from commands import run

PAGE = Path(__file__).parents[2] / "docs" / "my-star.md"
NM = np.linspace(170.0, 1150.0, 800)
FLUX = 1e-12 * np.exp(-(((NM - 560) / 250) ** 2))


def text(path: Path, *columns: np.ndarray, head: str = "") -> None:
    np.savetxt(path, np.transpose(columns), header=head, comments="", delimiter=",")


def tables(path: Path, names: tuple[str, ...], *extensions: str) -> None:
    columns = [fits.Column("WAVELENGTH", "D", unit="ANGSTROMS", array=10 * NM)]
    columns += [fits.Column(name, "D", unit="FLAM", array=FLUX) for name in names]
    made = [fits.BinTableHDU.from_columns(columns, name=name) for name in extensions]
    fits.HDUList([fits.PrimaryHDU(), *made]).writeto(path)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MAUVECL_DATA_DIR", str(tmp_path / "data"))
    text(tmp_path / "my-star.txt", NM, FLUX)
    text(tmp_path / "angstrom.txt", 10 * NM, FLUX)
    text(tmp_path / "watts.txt", NM, FLUX / 100)
    text(tmp_path / "from-290nm.txt", NM[NM > 290], FLUX[NM > 290])
    text(tmp_path / "spectrum.csv", NM, NM + 1, FLUX, FLUX, head="wave_obs,wave_rest,model_flux,observed_flux")
    text(tmp_path / "flares.csv", np.array([0.05, 0.1]), head="amplitude")
    tables(tmp_path / "grid.fits", ("g40", "g45"), "")
    tables(tmp_path / "two.fits", ("FLUX",), "SCI", "OTHER")
    targets = fits.Column("TARGETID", "K", array=[39627652591521181, 39627652591521182])
    hdus: list[fits.hdu.base.ExtensionHDU] = [fits.BinTableHDU.from_columns([targets], name="FIBERMAP")]
    for arm, low, high in (("B", 3600.0, 5800.0), ("R", 5760.0, 7620.0), ("Z", 7520.0, 9824.0)):
        wave = np.arange(low, high, 0.8)
        light = np.interp(wave / 10, NM, FLUX) * 1e17
        hdus += [
            fits.ImageHDU(wave, name=f"{arm}_WAVELENGTH"),
            fits.ImageHDU(np.array([light, light]), name=f"{arm}_FLUX"),
        ]
        hdus[-1].header["BUNIT"], hdus[-2].header["BUNIT"] = "10**-17 erg/(s cm2 Angstrom)", "Angstrom"
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(tmp_path / "coadd.fits")
    (instrument,) = re.findall(r"```toml\n# red\.toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "red.toml").write_text(instrument)
    return tmp_path


@pytest.mark.long
def test_commands_run(folder: Path) -> None:
    """In the order of the page, all but those that need a network, with few realisations and no pictures."""
    commands = re.findall(r"^    mauvecl (.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(commands) > 10
    for command in commands:
        words = shlex.split(command, comments=True)
        if words[:2] == ["library", "fetch"]:
            continue
        if words[0] != "library":
            words += ["--no-pictures", "--output", "out"]
        if words[0] == "detect":
            words += ["--realisations", "100000"]
        run(*words, folder=folder)
