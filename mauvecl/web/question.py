"""A visitor's question: the values of the fields as a study, and the simulations that buttons of the page start."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers.verbs import VERBS
from mauvecl.schema.errors import InputError
from mauvecl.study.analyses import SPECTRUM
from mauvecl.study.cases import Case, Loader
from mauvecl.study.study import Study
from mauvecl.web.fields import FIELDS, REALISTIC, WITH_FILE, Draws, Field
from mauvecl.web.uploads import content_folder

if TYPE_CHECKING:
    from mauvecl.host.spectra.conversion import ReadSpectrum
    from mauvecl.host.stars.source import Source
    from mauvecl.runs.pool import Pool
    from mauvecl.study.study import Study


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
        data["nuisances"] = {"usual": values["unknown"] == REALISTIC, "own": own}
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


#: Name of the detection with the other choice of unknowns; the card shows both.
OTHER = "detection otherwise"
#: Cells along each axis of the page's map, and realisations per cell.
MAP_STEPS, MAP_REALISATIONS = 8, 20_000
#: Injected flares: numbers of sizes and half-widths, flares of each, and positions.
INJECTED = {"of": "amplitude", "sizes": 12, "widths": 3, "count": 200, "positions": 4, "fitted": 0}
#: Largest number of simulated fits, and of those of two temperatures, which take fifty times as long.
MOST_FITS, MOST_OF_TWO = 10_000, 1000


def _map_around(study: Study) -> Study:
    """Return the study of a coarse map around the question's star."""
    star, amplitude = study.star[0], study.flare.amplitudes[0]
    middle = 7.0 if star.magnitude is None else star.magnitude
    x = {"quantity": "magnitude", "start": middle - 2.5, "stop": middle + 2.5, "steps": MAP_STEPS}
    y = {"quantity": "amplitude", "start": amplitude / 10, "stop": amplitude * 3, "steps": MAP_STEPS, "log": True}
    # One statistic and the fewest realisations that the false-alarm probability allows keep the map fast.
    fewest = int(np.ceil(100 / study.run.fap))
    n = min(max(MAP_REALISATIONS, fewest), study.run.realisations)
    return _changed(study, map={"x": x, "y": y}, run={"realisations": n, "statistics": [study.run.statistics[-1]]})


def _changed(study: Study, **sections: dict[str, Any]) -> Study:
    """Return a study with other values of keys, by section."""
    return study.with_changes(sections, None, "page")


def _tabulated(answers: dict[str, Any]) -> dict[str, Any]:
    """Add the tables of a visibility, which are slow to make and read repeatedly."""
    answer = answers["visible"]
    return answers | {"seen": {name: getattr(answer, name) for name in ("table", "months", "by_day")}}


@dataclass(frozen=True)
class Simulation:
    """Question that a button of the page asks."""

    # Verbs that answer it, by the names under which the page keeps their answers; the first is the main one.
    verbs: Mapping[str, str]
    asked: Callable[[Study], Study] = lambda study: study  # makes the study that is asked from that of the page
    # Adds to the answers what the page reads repeatedly.
    completed: Callable[[dict[str, Any]], dict[str, Any]] = lambda answers: answers
    # Further answers of the main verb by name, with what makes their study; a refused one is left out.
    others: Mapping[str, Callable[[Study], Study]] = field(default_factory=dict)
    needs: str = ""  # field without which it cannot start

    def __call__(
        self,
        study: Study,
        pool: Pool,
        progress: Callable[[int, int], None] | None = None,
        *,
        given: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Return the answers by name; the main verb reports its progress and takes the contents of files."""
        asked = self.asked(study)
        main = next(iter(self.verbs.values()))
        wanted = [(name, verb, asked) for name, verb in self.verbs.items()]
        wanted += [(name, main, change(asked)) for name, change in self.others.items()]
        counted = sum(VERBS[verb].counts == "realisations" for _, verb, _ in wanted)
        if counted > 1:
            pool.expect(counted * asked.run.realisations)
        answers: dict[str, Any] = {}
        for name, verb, question in wanted:
            try:
                answers[name] = VERBS[verb].ask(question, pool, progress, **(given or {} if verb == main else {}))
            except InputError:
                if name not in self.others:
                    raise
        return self.completed(answers)


def _fits(study: Study) -> Study:
    """Return the study of fits of the flare's spectrum."""
    most = MOST_FITS if study.flare.spectrum.second_area is None else MOST_OF_TWO
    return _changed(study, measure={"fits": min(study.run.realisations, most)})


def _other_unknowns(study: Study) -> Study:
    """Return the study with the usual unknowns if it has none, or without."""
    return _changed(study, nuisances={"usual": not study.nuisances.usual})


#: Simulations that change the study or have another name than their verb.
_OWN_SIMULATIONS = {
    "detection": Simulation({"detection": "detect", "snr": "snr"}, others={OTHER: _other_unknowns}),
    "map": Simulation({"map": "map"}, _map_around),
    "measure": Simulation({"measure": "measure"}, _fits),
    "completeness": Simulation({"completeness": "inject"}, partial(_changed, injections=INJECTED, search={"nulls": 0})),
    "visible": Simulation({"visible": "visible"}, completed=_tabulated, needs="targets"),
    "plan": Simulation({"plan": "plan"}, needs="targets"),
    "analyse": Simulation({"analyse": "analyse"}, needs="frames"),
    "calibrate": Simulation({"calibrate": "calibrate"}, needs="observations"),
    "periods": Simulation({"periods": "change"}, partial(_changed, change={"periods": True}), needs="targets"),
}
#: All simulations by name: those above, and the verbs that have a tab.
SIMULATIONS = {name: Simulation({name: name}) for name, verb in VERBS.items() if verb.tab} | _OWN_SIMULATIONS


def asked(name: str, study: Study) -> tuple[str, Study]:
    """Return the verb of a simulation, or the verb of that name, with its study derived from the page's."""
    if name not in SIMULATIONS:
        return name, study
    simulation = SIMULATIONS[name]
    return next(iter(simulation.verbs.values())), simulation.asked(study)


def verbs_of(name: str) -> tuple[str, ...]:
    """Return the verbs that answer a simulation, or the verb of that name."""
    return tuple(SIMULATIONS[name].verbs.values()) if name in SIMULATIONS else (name,)


#: Simulations that use the pool's devices.
DRAWING = {"detection", "map"} | {name for name in SIMULATIONS.keys() - _OWN_SIMULATIONS.keys() if VERBS[name].counts}
