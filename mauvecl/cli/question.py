"""Study of a verb from a file or the default, and flags."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mauvecl.cli.flags import StudyFlag
    from mauvecl.study.study import Study


def study_of(
    file: Path | None,
    given: dict[str, Any],
    flags: Mapping[str, StudyFlag],
    default: Callable[[dict[str, Any]], Study] | None,
) -> Study:
    """Return a study file, or the default, changed by flags and then by ``--set``."""
    from mauvecl.schema.errors import InputError
    from mauvecl.study.study import Study

    study = Study.read(file) if file is not None else default(given) if default else Study()
    changes: dict[str, dict[str, Any]] = {"sky": sky_of(given)}
    setting: dict[tuple[str, str], str] = {}
    for name, one in flags.items():
        if one.section not in ("star", "sky") and name != "nuisance":
            value = given[name]
            if value is not None:
                other = setting.setdefault((one.section, one.key), name)
                if other != name:
                    raise InputError(
                        f"--{other} and --{name} are both given",
                        f"one of them: both set {one.section}.{one.key}",
                        key=other,
                    )
                changes.setdefault(one.section, {})[one.key] = one.value(value)
    if given.get("nuisance"):
        changes.setdefault("nuisances", {}).update(nuisances_of(study, given["nuisance"]))
    changed = study.with_changes(changes, stars_of(study, given, flags), "command line")
    return changed.with_settings(given["set"], "--set") if given["set"] else changed


def is_star(given: Path) -> bool:
    """Return whether the argument of the study is a star: a name of the library or a spectrum file."""
    from mauvecl.host.stars.library import resolve

    text = str(given)
    if given.suffix.lower() == ".toml" or given.is_dir():
        return False
    if not _is_there(text):
        # The first name decides; a wrong name among others has its own message.
        first = text.split(",")[0].strip()
        star = resolve(first) if first else None
        return star is not None and not (star.spectrum is None and star.known is None)
    if given.suffix.lower() == ".ecsv":
        return not holds_study(given)
    return not given.is_file() or not _is_toml(given)


def _is_toml(file: Path) -> bool:
    """Return whether a file contains TOML, that is a study, regardless of its name."""
    import tomllib

    from mauvecl.host.files.size_limits import read_bytes

    try:
        tomllib.loads(read_bytes(file, "file")[:1_000_000].decode())
    except (ValueError, RecursionError):
        return False
    return True


def holds_study(file: Path) -> bool:
    """Return whether a file is not a plain table, such as CSV, or ECSV that no answer wrote."""
    suffix = file.suffix.lower()
    if suffix != ".ecsv" or not file.is_file():
        return suffix not in (".csv", ".vot", ".votable", ".xml", ".fits", ".fit")
    from mauvecl.host.tables.ecsv import read_ecsv

    return "study" in read_ecsv(file, "table", "a table of targets, or of an answer").meta


def sky_of(given: dict[str, Any]) -> dict[str, Any]:
    from mauvecl.schema.errors import InputError

    if "time" not in given:
        return {}
    sky: dict[str, Any] = {"target": given["target"], "time": given["time"]}
    text = given["sky"]
    if text is not None and text.strip().lower() == "none":
        sky["none"] = True
    elif text is not None:
        try:
            sky["surface_brightness"] = float(text)
        except ValueError as error:
            raise InputError(f"--sky {text!r}", "V mag/arcsec^2 or none", key="sky", value=text) from error
    return sky


def nuisances_of(study: Study, texts: list[str]) -> dict[str, Any]:
    """Read nuisance parameters such as dark=0.1, or with the name of a file, stray.txt=free."""
    from mauvecl.noise.unknowns import NUISANCES
    from mauvecl.schema.errors import InputError
    from mauvecl.schema.text import shortened

    nuisances: dict[str, Any] = {}
    own = {name: one.model_dump(exclude_none=True) for name, one in study.nuisances.own.items()}
    for text in texts:
        name, _, sd = (part.strip() for part in text.rpartition("="))
        if not (name and sd):
            raise InputError(
                f"--nuisance {shortened(text)}",
                f"NAME=SD, with a name of {', '.join(NUISANCES)} or a file's, and a standard deviation or free",
                key="nuisance",
                value=text,
            )
        if name in NUISANCES:
            nuisances[name] = sd
        else:
            own[Path(name).stem] = {"file": Path(name), "sd": sd}
    return nuisances | ({"own": own} if own else {})


def stars_of(study: Study, given: dict[str, Any], flags: Mapping[str, StudyFlag]) -> list[dict[str, Any]] | None:
    """Return the data of the stars that flags name or change, or None."""
    from mauvecl.schema.errors import InputError
    from mauvecl.study.sections import FILE_KEYS

    if "star" not in given:
        return None
    names, magnitudes = given["star"], given["magnitude"]
    of_stars = {one.key: given[name] for name, one in flags.items() if one.section == "star"}
    changed = {
        key: value for key, value in of_stars.items() if value is not None and key not in ("library", "magnitude")
    }
    of_files = {key: value for key, value in changed.items() if key in FILE_KEYS}
    same = {key: value for key, value in changed.items() if key not in FILE_KEYS}
    if not (names or magnitudes or same or of_files):
        return None
    if names:
        # A name of an existing file is a file; other names are searched for in the library.
        each = [one for name in names for one in ([name] if _is_there(name) else map(str.strip, name.split(",")))]
        stars: list[dict[str, Any]] = [{"file": name} if _is_file(name) else {"library": name} for name in each]
    else:
        stars = [entry.model_dump(exclude_none=True) for entry in study.star]
    if magnitudes:
        if len(magnitudes) not in (1, len(stars)):
            of = "one star" if len(stars) == 1 else f"{len(stars)} stars"
            raise InputError(
                f"{len(magnitudes)} magnitudes for {of}", "one for all or one each", key="magnitude", value=magnitudes
            )
        for entry, value in zip(stars, magnitudes * (len(stars) if len(magnitudes) == 1 else 1), strict=True):
            entry["magnitude"] = value
    if of_files and not any("file" in entry for entry in stars):
        named = " and ".join("--" + key.replace("_", "-") for key in of_files)
        raise InputError(f"{named} without a spectrum file among the stars", "--star FILE", key=next(iter(of_files)))
    return [entry | same | (of_files if "file" in entry else {}) for entry in stars]


def _is_there(name: str) -> bool:
    """Return whether a file has that name, which may contain commas."""
    from mauvecl.host.spectra.formats import without_columns

    try:
        return bool(name) and without_columns(name)[0].exists()
    except (OSError, ValueError):
        # Impossible file names raise an error.
        return True


def _is_file(name: str) -> bool:
    if _is_there(name):
        return True
    from mauvecl.host.stars.library import ModelStar

    # "K2.5V" and "power law -1.5" look like file names but are stars.
    if ModelStar.named(name) is not None:
        return False
    suffix = Path(name).suffix
    return bool(suffix) and not suffix[1:].isupper()
