"""A visitor's question: the values of the fields as a study."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mauvecl.schema.errors import InputError
from mauvecl.study.analyses import SPECTRUM
from mauvecl.study.cases import Case, Loader
from mauvecl.study.study import Study
from mauvecl.web.fields import FIELDS, WITH_FILE, Draws, Field
from mauvecl.web.uploads import content_folder

if TYPE_CHECKING:
    from mauvecl.host.spectra.conversion import ReadSpectrum
    from mauvecl.host.stars.source import Source

#: Fields that set their keys together with the file of another field; units do not, since files are written in nm.
SET_WITH_FILE = {"flare_file": ("continue_at_k", "flare_quiescent", "as_observed"), "change_file": ("change_band",)}
#: Fields whose values only apply together with those of others.
CONDITIONAL = (
    "sky_brightness", "target", "time", "second_area", "hours", "pointing_rate", "pointing_duration",
    "pointing_depth", *itertools.chain(*WITH_FILE.values()),
)  # fmt: skip
#: Names of uploaded spectra by field, and of a table of neighbours, in the folder of their study.
SPECTRA = {
    "star": "star.ecsv",
    "flare_file": "flare.ecsv",
    "flare_quiescent": "quiescent.ecsv",
    "change_file": "added.ecsv",
}
NEIGHBOURS_FILE = "neighbours.csv"


@dataclass(frozen=True, eq=False)
class Question:
    """Valid values of all fields of `fields.FIELDS`, by name, and the contents of files that stand in them."""

    values: Mapping[str, Any]
    uploads: Mapping[str, Any] = field(default_factory=dict)

    @property
    def uploaded(self) -> Source | None:
        """The visitor's own star, or None."""
        return self.uploads.get("star")

    def __getattr__(self, name: str) -> Any:
        """Return the value of a field, as in ``question.magnitude``."""
        if name != "values" and name in self.values:
            return self.values[name]
        raise AttributeError(name)

    @property
    def as_bright_as_observed(self) -> bool:
        """Whether the flare has the brightness of the visitor's file, in place of the amplitude."""
        return "flare_file" in self.uploads and bool(self.values["as_observed"])

    def study(self, folder: Path | None = None) -> Study:
        """Return the question as a study; parameters and errors as for `case`."""
        return self.case(folder).study

    def case(self, folder: Path | None = None) -> Case:
        """Return the question as a case; a flare that is as bright as observed has the amplitude of its brightness.

        The visitor's files are written to the folder for the study to find. Raises InputError for incompatible values.
        """
        if folder is None and (self.uploads.keys() - {"own_unknown"} or self.neighbours is not None):
            raise InputError("no folder for the visitor's files", "a folder", key="folder")
        uploaded = self.uploaded
        # An uploaded spectrum is not read from its file at every change.
        loader = Loader(None if uploaded is None else lambda star: star.applied(uploaded))
        case = Case(Study.build(self._data(folder), "page"), loader=loader)
        return case.at_observed_brightness() if self.as_bright_as_observed else case

    def _data(self, folder: Path | None) -> dict[str, Any]:
        """Return the question as the data of a study, whose files are written to a folder."""
        values = self.values
        data: dict[str, Any] = {}
        for name, page_field in FIELDS.items():
            if page_field.path and name not in CONDITIONAL:
                self._set_valid(data, name, folder)
        data["star"] = [self._star(data["star"], folder)]
        data["sky"] = {
            "brightness": {"surface_brightness": values["sky_brightness"]},
            "target and time": {"target": values["target"], "time": values["time"]},
            "none": {"none": True},
        }[values["sky"]]
        if values["second_temperature_k"] is not None:
            self._set(data, FIELDS["second_area"], values["second_area"])
        if values["pointing_rate"] is not None:
            for name in ("pointing_rate", "pointing_duration", "pointing_depth"):
                self._set(data, FIELDS[name], values[name])
        if values["lines"]:
            data["flare"].setdefault("spectrum", {})["lines"] = dict(values["lines"])
        for name in SET_WITH_FILE.keys() & self.uploads.keys():
            for other in SET_WITH_FILE[name]:
                self._set_valid(data, other, folder)
        if "change_file" in self.uploads and SPECTRUM not in values["changes"]:
            self._set(data, FIELDS["changes"], (*values["changes"], SPECTRUM))
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

    def _star(self, star: dict[str, Any], folder: Path | None) -> dict[str, Any]:
        """Return the data of a star with its spectrum and neighbours."""
        if folder is not None and self.neighbours is not None:
            star["neighbours"] = str(write_table(self.neighbours, folder))
        if folder is not None and self.uploaded is not None:
            return star | {"file": str(write_spectrum(self.uploaded, folder, SPECTRA["star"]))}
        return star | {"library": self.values["star"]}

    def _set_valid(self, data: dict[str, Any], name: str, folder: Path | None) -> None:
        """Set the key of a field in the data of a study, in place, unless it is empty; its file goes to a folder."""
        page_field, value = FIELDS[name], self.values[name]
        if page_field.kind in ("file", "upload"):
            if folder is None or name not in self.uploads:
                return
            upload = self.uploads[name]
            written = (
                write_spectrum(upload, folder, SPECTRA[name]) if page_field.kind == "file" else upload.written(folder)
            )
            value = str(written) if isinstance(written, Path) else written
        if value is not None:
            self._set(data, page_field, value)

    @staticmethod
    def _set(data: dict[str, Any], target: Field, value: Any) -> None:
        """Set the key of a field in the data of a study, in place."""
        *sections, key = target.path
        for section in sections:
            data = data.setdefault(section, {})
        if target.scale != 1.0:
            value = value / target.scale
        # A single flare.
        data[key] = [value] if key == "amplitudes" else value


def write_table(text: str, folder: Path) -> Path:
    """Write a table of neighbours to a file, once per text, and return its path."""
    home = content_folder(folder, text.encode(), lambda new: (new / NEIGHBOURS_FILE).write_text(text))
    return home / NEIGHBOURS_FILE


def write_spectrum(source: Source | ReadSpectrum, folder: Path, name: str) -> Path:
    """Write an uploaded spectrum to a file of this name without loss, once per spectrum, and return its path."""
    from astropy.table import Table

    def write(new: Path) -> None:
        table = Table({"wavelength": source.wavelength_nm, "flux": source.flux_flam})
        table["wavelength"].unit, table["flux"].unit = "nm", "erg / (s cm2 Angstrom)"
        table.meta |= {"name": source.name, "told": list(source.messages)}
        table.write(new / name, format="ascii.ecsv")

    content = name.encode() + source.wavelength_nm.tobytes() + source.flux_flam.tobytes()
    return content_folder(folder, content, write) / name
