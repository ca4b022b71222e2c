"""The line that states the assumptions of an answer."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Literal

from mauvecl.noise.unknowns import COURSES, STARE_PROCESSES

if TYPE_CHECKING:
    from mauvecl.study.study import Study

#: Parts of a study that answers use.
Use = Literal["instrument", "sky", "flare", "orbit", "processes", "nuisances", "stare", "values", "templates", "seed"]
#: Parts that hold unknowns: processes of draws, nuisance parameters of statistics, changes during a stare, and
#: instrument values that are averaged over.
UNKNOWN_USES: tuple[Use, ...] = ("processes", "nuisances", "stare", "values")
#: Known changes during a stare.
KNOWN_CHANGES = ("thermal", "variability", "throughput", "sky")


def assumption_line(study: Study, uses: Collection[Use], varied: Collection[str] = ()) -> str:
    """Return one line with the assumptions of a study about the parts that an answer uses.

    Parameters
    ----------
    uses : collection of str
        Parts of the study; see `Use`.
    varied : collection of str
        Quantities that the answer varies in addition to those that the study sweeps.
    """
    swept = {axis.quantity for axis in study.sweep.axes} | set(varied)
    words: dict[str, Callable[[], str]] = {
        "instrument": lambda: _instrument(study, swept),
        "sky": lambda: _sky(study, swept),
        "flare": lambda: _flare(study, swept),
        "orbit": lambda: _orbit(study),
        "unknowns": lambda: _unknowns(study, uses),
        "templates": lambda: f"flares of the shape {study.search.shape}; noise as measured",
        "seed": lambda: f"seed {study.run.seed}",
    }
    stated = {*uses, *(("unknowns",) if {*UNKNOWN_USES} & {*uses} else ())}
    unused = unused_unknowns(study, uses)
    ignored = [f"not used: {', '.join(unused)}"] if unused else []
    return f"Assumed: {'; '.join([*(words[use]() for use in words if use in stated), *ignored])}."


def _instrument(study: Study, swept: set[str]) -> str:
    o = study.observation
    text = f"instrument {o.instrument}"
    if o.changes:
        text += f" with another {', '.join(o.changes)}"
    if "detector_temperature" in swept:
        return f"{text}, detector temperature as swept"
    return f"{text}, detector at {study.observation.load_instrument().temperature_c:g} deg C"


def _sky(study: Study, swept: set[str]) -> str:
    sky = study.sky
    if "sky" in swept:
        return "sky as swept"
    if sky.none:
        return "no sky"
    if sky.target is not None:
        return f"sky at {sky.target}, {sky.time} UTC"
    return f"sky of V = {sky.surface_brightness:g} mag/arcsec2"


def _flare(study: Study, swept: set[str]) -> str:
    f, replaces = study.flare, "replacing photosphere"
    temperature = "of swept temperature" if "flare_temperature" in swept else f"of {f.light().describe()}"
    if f.geometry == "replaces" and f.photosphere_temperature_k is not None:
        replaces += f" of {f.photosphere_temperature_k:g} K"
    geometry = "added to the star" if f.geometry == "added" else replaces
    size = "as bright as observed" if f.spectrum.as_observed else f"amplitudes in the {f.band} band"
    return f"flares {temperature}, {geometry}, {size}"


def _orbit(study: Study) -> str:
    limits = study.orbit.limits
    kept = [
        f"{name} {value:g} deg"
        for name, value in (
            ("Earth's limb", limits.earth_limb_deg),
            ("Sun", limits.sun_deg),
            ("Moon", limits.moon_deg),
        )
        if value is not None
    ]
    source = "embedded elements" if study.orbit.tle is None else study.orbit.tle.name
    return f"orbit of {source}; least angles: {', '.join(kept) or 'none'}"


def _unknowns(study: Study, uses: Collection[Use]) -> str:
    """List the unknowns that an answer draws, marginalises over or averages over."""
    n, s = study.nuisances, study.stare
    drawn = [name.replace("_", " ") for name, value in study.processes if value is not None and "processes" in uses]
    if "stare" in uses:
        drawn += [name for name in KNOWN_CHANGES if getattr(s, name) is not None]
        drawn += [f"{course} of {', '.join(of)}" for course in COURSES if (of := getattr(s, course))]
        drawn += [f"{process.label} (assumed)" for name, process in STARE_PROCESSES.items() if getattr(s, name)]
    usual = "drawn and marginalised" if {"nuisances", "stare"} & {*uses} else "drawn"
    parts = [f"the usual unknowns {usual}"] if n.usual else []
    parts += [f"drawn: {', '.join(drawn)}"] if drawn else []
    named = [*n.spreads(), *n.own] if "nuisances" in uses else []
    parts += [f"marginalised: {', '.join(named)}"] if named else []
    if study.unknowns.draws and "values" in uses:
        parts.append(f"{study.unknowns.draws} draws of the instrument's unknowns")
    return "; ".join(parts) or "everything known but the noise"


def unused_unknowns(study: Study, uses: Collection[Use]) -> list[str]:
    """Return the keys of the study's unknowns that an answer ignores."""
    n, s = study.nuisances, study.stare
    given: dict[Use, list[str]] = {
        "processes": [f"processes.{name}" for name, value in study.processes if value is not None],
        "nuisances": [f"nuisances.{name}" for name in n.spreads()] + [f"nuisances.own.{name}" for name in n.own],
        "stare": [f"stare.{name}" for name in KNOWN_CHANGES if getattr(s, name) is not None]
        + [f"stare.{name}" for name in (*COURSES, *STARE_PROCESSES) if getattr(s, name)],
        "values": ["unknowns.draws"] if study.unknowns.draws else [],
    }
    # Verbs of an orbit look at targets, not at the study's star.
    observes = "instrument" in uses and "orbit" not in uses
    near = [] if observes or all(star.neighbours is None for star in study.star) else ["star.neighbours"]
    usual = ["nuisances.usual"] if n.usual and not {"processes", "stare"} & {*uses} else []
    return [key for use, keys in given.items() if use not in uses for key in keys] + usual + near
