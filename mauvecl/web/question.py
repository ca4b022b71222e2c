"""What a visitor asks: the values behind the controls, as a study and as a link."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import param

from mauvecl.host.bands import ALIASES
from mauvecl.host.catalogue import library_table
from mauvecl.host.errors import InputError
from mauvecl.host.source import Source
from mauvecl.statistics import STATISTICS
from mauvecl.study import Study
from mauvecl.web.limited import read_limited

#: Bytes of an upload, and points of its spectrum, at most.
MOST_UPLOADED, MOST_POINTS = 4 * 2**20, 200_000
#: What uploads may be; the archive formats that unpack to more are left out.
ENDINGS = (".txt", ".dat", ".csv", ".ecsv", ".fits")
#: Realisations that a visitor may ask for.
REALISATIONS = (10_000, 100_000, 1_000_000, 4_000_000)
UPLOADED = "uploaded star"


def star_names() -> list[str]:
    """The embedded spectra; a server's own kept stars are not its visitors'."""
    table = library_table()
    return [str(row["name"]) for row in table if row["kept"] == "embedded"]


class Question(param.Parameterized):
    """One visitor's question; the default is the paper's G2V star with a flare of 24 %."""

    star = param.String("G2V", doc="Library spectrum")
    magnitude = param.Number(7.4, bounds=(-2, 25), doc="Magnitude of the star")
    band: Any = param.Selector(default="V", objects=list(ALIASES), doc="Band of the magnitude")
    exposure_s = param.Number(50.0, bounds=(0.1, 86_400), doc="Exposure, s; whole frames of 5 s")
    temperature_c = param.Number(21.0, bounds=(-50, 60), doc="Detector temperature, deg C")
    instrument: Any = param.Selector(default="mauve", objects=["mauve", "mauve-electrons"], doc="Payload")
    sky: Any = param.Selector(default="brightness", objects=["brightness", "target and time", "none"], doc="Sky")
    sky_brightness = param.Number(22.1, bounds=(10, 30), doc="Sky brightness, V mag / arcsec2")
    target = param.String("", doc="Target: coordinates such as 290.68 +11.12")
    time = param.String("", doc="Time, UTC, such as 2026-09-01T12:00")
    amplitude_percent = param.Number(24.0, bounds=(0.0001, 1e5), doc="Flare amplitude, %")
    flare_temperature_k = param.Number(10_000.0, bounds=(1000, 100_000), doc="Flare temperature, K")
    statistic: Any = param.Selector(default="matched", objects=list(STATISTICS), doc="Detection statistic")
    fap = param.Number(1e-3, bounds=(1e-6, 0.5), inclusive_bounds=(True, True), doc="False-alarm probability per test")
    realisations: Any = param.Selector(default=100_000, objects=list(REALISATIONS), doc="Realisations")
    seed = param.Integer(1, bounds=(0, 2**31), doc="Seed")

    #: An uploaded spectrum stands for the star where its name is chosen.
    uploaded: Source | None = None

    def upload(self, name: str, content: bytes) -> None:
        """Take a spectrum from a visitor; nothing of it is trusted, least of all its name.

        Raises
        ------
        InputError
            If it is too large, of another kind, or holds no usable spectrum.
        """
        ending = Path(name).suffix.lower()
        if ending not in ENDINGS:
            raise InputError(f"upload {Path(name).name[:40]!r}, expected a name ending in {', '.join(ENDINGS)}")
        if len(content) > MOST_UPLOADED:
            raise InputError(
                f"upload of {len(content) / 2**20:.1f} MiB, expected at most {MOST_UPLOADED / 2**20:g} MiB"
            )
        source = read_limited(content, ending)
        if source.wavelength_nm.size > MOST_POINTS:
            raise InputError(f"upload of {source.wavelength_nm.size} points, expected at most {MOST_POINTS}")
        self.uploaded = replace(source, name=UPLOADED, origin="upload")
        if self.star == UPLOADED:
            self.param.trigger("star")
        else:
            self.star = UPLOADED

    def study(self, folder: Path | None = None) -> Study:
        """The question as a study.

        Parameters
        ----------
        folder : Path, optional
            Where an uploaded spectrum is written for the study to find.

        Raises
        ------
        InputError
            For values that cannot be.
        """
        star: dict[str, Any] = {"magnitude": self.magnitude, "band": self.band}
        if self.star == UPLOADED:
            if self.uploaded is None:
                raise InputError("the uploaded star is not here, expected its file again: links do not hold it")
            if folder is None:
                raise InputError("no folder for the uploaded star")
            star["file"] = str(write_spectrum(self.uploaded, folder))
        else:
            star["library"] = self.star
        skies: dict[str, dict[str, Any]] = {
            "brightness": {"surface_brightness": self.sky_brightness},
            "target and time": {"target": self.target, "time": self.time},
            "none": {"none": True},
        }
        data = {
            "star": [star],
            "flare": {"amplitudes": [self.amplitude_percent / 100.0], "temperature_k": self.flare_temperature_k},
            "observation": {
                "exposure_s": self.exposure_s,
                "temperature_c": self.temperature_c,
                "instrument": self.instrument,
            },
            "sky": skies[self.sky],
            "run": {
                "realisations": self.realisations,
                "seed": self.seed,
                "statistics": list(dict.fromkeys(["chi2", "chi2_element", self.statistic])),
                "fap": self.fap,
            },
        }
        return Study.build(data, "page")


def write_spectrum(source: Source, folder: Path) -> Path:
    """An uploaded spectrum as a file of our own, every bit of its numbers kept."""
    from astropy.table import Table

    table = Table({"wavelength": source.wavelength_nm, "flux": source.flux_flam})
    table["wavelength"].unit, table["flux"].unit = "nm", "erg / (s cm2 Angstrom)"
    table.meta |= {"name": UPLOADED, "told": list(source.told)}
    path = folder / "star.ecsv"
    table.write(path, format="ascii.ecsv", overwrite=True)
    return path
