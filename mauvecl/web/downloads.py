"""What visitors take along: tables, pictures, and the study that gives them again."""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mauvecl.host.errors import InputError
from mauvecl.web.fields import UPLOADED
from mauvecl.web.question import STAR_FILE

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.host.expectation import Expectation
    from mauvecl.study.study import Study


def study_file(study: Study) -> io.BytesIO:
    """The study for the command line; an uploaded star beside it, in a zip."""
    file = study.star[0].file
    if file is None:
        return io.BytesIO(study.toml().encode())
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.write(file, STAR_FILE)
        # The file as seen from the study: not where the server has it.
        archive.writestr("study.toml", study.toml().replace(str(file.resolve()), STAR_FILE))
    out.seek(0)
    return out


def as_file(name: str, ending: str, study: Study, quiet: Expectation, found: Mapping[str, Any]) -> io.BytesIO:
    """A table or a picture.

    Parameters
    ----------
    name : str
        observation, snr, noise-budget, detection, roc, limit or map.
    ending : {"ecsv", "fits", "png"}
    study : Study
    quiet : Expectation
    found : mapping
        Answers that are simulated, by name.

    Raises
    ------
    InputError
        If it is not computed yet.
    """
    from mauvecl.answers.report import write_table

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.{ending}"
        if ending == "png":
            _draw(name, study, quiet, found, path)
        else:
            write_table(_table(name, study, quiet, found), path)
        return io.BytesIO(path.read_bytes())


def _table(name: str, study: Study, quiet: Expectation, found: Mapping[str, Any]) -> Table:
    tables: dict[str, Callable[[], Table]] = {
        "noise-budget": quiet.noise_budget,
        "observation": lambda: _observed(study),
        "snr": lambda: found["snr"].element if "snr" in found else _closed_snr(quiet),
    }
    if "detection" in found:
        tables |= {"detection": lambda: found["detection"].table, "roc": lambda: found["detection"].roc}
    tables |= {kind: lambda kind=kind: found[kind].table for kind in ("limit", "map") if kind in found}  # type: ignore[misc]
    if name not in tables:
        raise InputError(f"no {name} is computed yet, expected a simulation first")
    return tables[name]()


def _draw(name: str, study: Study, quiet: Expectation, found: Mapping[str, Any], path: Path) -> None:
    from mauvecl.pictures import answers, plans

    title = study.star[0].library or UPLOADED
    if name == "observation":
        answers.observation(title, _observed(study), path)
    elif name == "noise-budget":
        plans.noise_budget([(f"{title}, {quiet.exposure_s:g} s", quiet)], path=path)
    elif name == "snr" and name not in found:
        answers.signal_to_noise([(title, quiet)], path)
    elif name == "roc" and "detection" in found:
        (star,) = found["detection"].stars
        answers.roc([(one, star.found.roc(one)) for one in star.found.statistics], path)
    elif name in found:
        found[name].plot(path)
    else:
        raise InputError(f"no {name} is computed yet, expected a simulation first")


def _observed(study: Study) -> Table:
    """One observation with the flare, taken apart."""
    from mauvecl.answers.simulate import simulate

    return simulate(study, flaring=True).observations[1][2]


def _closed_snr(quiet: Expectation) -> Table:
    """S/N per element where nothing is simulated yet."""
    from astropy.table import QTable

    table = QTable({"wavelength": quiet.element_wavelength_nm, "expected": quiet.snr_per_element()})
    table["wavelength"].unit = "nm"
    table["expected"].info.description = "closed-form S/N per resolution element of 10.5 nm"
    return table
