"""A visitor's question: the values of the fields as a study."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mauvecl.schema.errors import InputError
from mauvecl.study.study import Study
from mauvecl.web.fields import UPLOADED, Draws

if TYPE_CHECKING:
    from mauvecl.host.stars.source import Source

Points = tuple[tuple[float, float], ...]
#: Name of an uploaded star's file beside its study.
STAR_FILE = "star.ecsv"


@dataclass(frozen=True, eq=False)
class Question:
    """Valid values of all fields, which `fields.FIELDS` describes."""

    star: str
    magnitude: float
    band: str
    exposure_s: float
    temperature_c: float
    instrument: str
    signal: str
    sky: str
    sky_brightness: float
    target: str
    time: str
    amplitude_percent: float
    flare_temperature_k: float
    balmer_jump: float | None
    second_temperature_k: float | None
    second_area: float
    lines: tuple[tuple[str, float], ...]
    statistic: str
    fap: float
    realisations: Draws
    unknown: str
    own_unknown: Points
    see: str
    hours: float
    seed: int
    uploaded: Source | None = None

    def study(self, folder: Path | None = None) -> Study:
        """Return the question as a study.

        Parameters
        ----------
        folder : Path, optional
            Where an uploaded spectrum is written for the study to find.

        Raises
        ------
        InputError
            For values that cannot be together.
        """
        if self.uploaded is None:
            return Study.build(self.data(), "page")
        if folder is None:
            raise InputError("no folder for the uploaded star", "a folder", key="folder")
        return Study.build(self.data(str(write_spectrum(self.uploaded, folder))), "page")

    def data(self, file: str = STAR_FILE) -> dict[str, Any]:
        """Return the question as the data of a study.

        Parameters
        ----------
        file : str
            Where an uploaded spectrum is.
        """
        star: dict[str, Any] = {"magnitude": self.magnitude, "band": self.band}
        if self.uploaded is None:
            star["library"] = self.star
        else:
            star["file"] = file
        skies: dict[str, dict[str, Any]] = {
            "brightness": {"surface_brightness": self.sky_brightness},
            "target and time": {"target": self.target, "time": self.time},
            "none": {"none": True},
        }
        own = {"own": {"points": self.own_unknown}} if self.own_unknown else {}
        seen = {"orbit": {"targets": [self.see.strip()]}, "plan": {"hours": self.hours}}
        orbit = seen if self.see.strip() else {}
        spectrum = self.spectrum
        return orbit | {
            "star": [star],
            "flare": {"amplitudes": [self.amplitude_percent / 100.0], "temperature_k": self.flare_temperature_k}
            | ({"spectrum": spectrum} if spectrum else {}),
            "observation": {
                "exposure_s": self.exposure_s,
                "temperature_c": self.temperature_c,
                "instrument": self.instrument,
                "signal": self.signal,
            },
            "sky": skies[self.sky],
            "nuisances": {"usual": self.unknown == "the usual", "own": own},
            "run": {
                "realisations": self.realisations.number,
                "tails": self.realisations.tails,
                "seed": self.seed,
                "statistics": list(dict.fromkeys(["chi2", "chi2_element", self.statistic])),
                "fap": self.fap,
            },
        }

    @property
    def spectrum(self) -> dict[str, Any]:
        """The study's section of the flare's spectrum; empty for a blackbody."""
        given: dict[str, Any] = {}
        if self.balmer_jump is not None:
            given["balmer_jump"] = self.balmer_jump
        if self.second_temperature_k is not None:
            given |= {"second_temperature_k": self.second_temperature_k, "second_area": self.second_area}
        return given | ({"lines": dict(self.lines)} if self.lines else {})


def write_spectrum(source: Source, folder: Path) -> Path:
    """Write an uploaded spectrum to a file without loss, once per spectrum, and return its path."""
    from astropy.table import Table

    path = folder / source.digest / STAR_FILE
    if not path.exists():
        table = Table({"wavelength": source.wavelength_nm, "flux": source.flux_flam})
        table["wavelength"].unit, table["flux"].unit = "nm", "erg / (s cm2 Angstrom)"
        table.meta |= {"name": UPLOADED, "told": list(source.told)}
        path.parent.mkdir(exist_ok=True)
        table.write(path, format="ascii.ecsv")
    return path
