"""A visitor's question: the values of the fields as a study."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mauvecl.schema.errors import InputError
from mauvecl.study.study import Study
from mauvecl.web.fields import FIELDS, READ_WITH, UPLOADED, Draws, Field

if TYPE_CHECKING:
    from mauvecl.host.stars.source import Source

#: Fields whose values only apply together with those of others, and those that an upload was read with.
CONDITIONAL = ("sky_brightness", "target", "time", "second_area", "hours", *itertools.chain(*READ_WITH.values()))
Points = tuple[tuple[float, float], ...]
#: Name of an uploaded star's file in the folder of its study.
STAR_FILE = "star.ecsv"


@dataclass(frozen=True, eq=False)
class Question:
    """Valid values of all fields of `fields.FIELDS`, by name, and the contents of files that stand in them."""

    values: Mapping[str, Any]
    uploads: Mapping[str, Any] = field(default_factory=dict)

    @property
    def uploaded(self) -> Source | None:
        """The visitor's own star, if it is asked for."""
        return self.uploads.get("star")

    def __getattr__(self, name: str) -> Any:
        """Return the value of a field, as in ``question.magnitude``."""
        if name != "values" and name in self.values:
            return self.values[name]
        raise AttributeError(name)

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
        values = self.values
        data: dict[str, Any] = {}
        for name, one in FIELDS.items():
            if one.path and name not in CONDITIONAL and values[name] is not None:
                self._set(data, one, values[name])
        data["star"] = [data["star"] | ({"file": file} if self.uploaded else {"library": values["star"]})]
        data["sky"] = {
            "brightness": {"surface_brightness": values["sky_brightness"]},
            "target and time": {"target": values["target"], "time": values["time"]},
            "none": {"none": True},
        }[values["sky"]]
        if values["second_temperature_k"] is not None:
            self._set(data, FIELDS["second_area"], values["second_area"])
        if values["lines"]:
            data["flare"].setdefault("spectrum", {})["lines"] = dict(values["lines"])
        points = self.uploads.get("own_unknown", values["own_unknown"])
        own = {"own": {"points": points}} if points else {}
        data["nuisances"] = {"usual": values["unknown"] == "the usual", "own": own}
        draws: Draws = values["realisations"]
        data["run"] |= {
            "realisations": draws.number,
            "tails": draws.tails,
            "statistics": list(dict.fromkeys(["chi2", "chi2_element", values["statistic"]])),
        }
        if values["targets"]:
            data["plan"] = {"targets": list(values["targets"]), "hours": values["hours"]}
        return data

    @staticmethod
    def _set(data: dict[str, Any], one: Field, value: Any) -> None:
        """Set the key of a field in the data of a study, in place."""
        *sections, key = one.path
        for section in sections:
            data = data.setdefault(section, {})
        if one.scale != 1.0:
            value = value / one.scale
        # A single flare.
        data[key] = [value] if key == "amplitudes" else value


def write_spectrum(source: Source, folder: Path) -> Path:
    """Write an uploaded spectrum to a file without loss, once per spectrum, and return its path."""
    from astropy.table import Table

    path = folder / source.digest / STAR_FILE
    if not path.exists():
        table = Table({"wavelength": source.wavelength_nm, "flux": source.flux_flam})
        table["wavelength"].unit, table["flux"].unit = "nm", "erg / (s cm2 Angstrom)"
        table.meta |= {"name": UPLOADED, "told": list(source.messages)}
        path.parent.mkdir(exist_ok=True)
        table.write(path, format="ascii.ecsv")
    return path
