"""The line that states the assumptions of an answer."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from mauvecl.study.study import Study

#: Parts of a study that answers use.
Use = Literal["instrument", "sky", "flare", "orbit", "unknowns", "templates", "seed"]


def assumption_line(study: Study, uses: Collection[Use], varied: Collection[str] = ()) -> str:
    """Return one line with the assumptions of a study about the parts that an answer uses.

    Parameters
    ----------
    study : Study
    uses : collection of str
        Parts of the study; see `Use`.
    varied : collection of str
        Quantities that the answer varies in addition to those that the study sweeps.
    """
    swept = {axis.quantity for axis in study.sweep.axes} | set(varied)
    words: dict[Use, Callable[[], str]] = {
        "instrument": lambda: _instrument(study, swept),
        "sky": lambda: _sky(study, swept),
        "flare": lambda: _flare(study, swept),
        "orbit": lambda: _orbit(study),
        "unknowns": lambda: _unknowns(study),
        "templates": lambda: f"flares of the shape {study.search.shape}; noise as measured",
        "seed": lambda: f"seed {study.run.seed}",
    }
    return f"Assumed: {'; '.join(words[use]() for use in words if use in uses)}."


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
    return f"flares {temperature}, {geometry}, amplitudes in the {f.band} band"


def _orbit(study: Study) -> str:
    limits = study.orbit.limits
    kept = [
        f"{name} {value:g} deg"
        for name, value in (
            ("Earth's limb", limits.earth_limb_deg),
            ("Sun", limits.sun_deg),
            ("Moon", limits.moon_deg),
        )
        if not isinstance(value, str)
    ]
    source = "embedded elements" if study.orbit.tle is None else study.orbit.tle.name
    return f"orbit of {source}; least angles: {', '.join(kept) or 'none'}"


def _unknowns(study: Study) -> str:
    """List the unknowns: those drawn, those marginalised over, and those of the instrument."""
    n, s = study.nuisances, study.stare
    named = [name for name in type(n).model_fields if name not in ("usual", "own") and getattr(n, name) is not None]
    drawn = [name.replace("_", " ") for name, value in study.processes if value is not None]
    drawn += [name for name in ("thermal", "variability", "throughput", "sky") if getattr(s, name) is not None]
    drawn += [
        f"{how} of {', '.join(of)}" for how in ("jitters", "offsets", "drifts", "cycles") if (of := getattr(s, how))
    ]
    parts = ["the usual unknowns drawn and marginalised"] if n.usual else []
    parts += [f"drawn: {', '.join(drawn)}"] if drawn else []
    parts += [f"marginalised: {', '.join([*named, *n.own])}"] if named or n.own else []
    parts += [f"{study.unknowns.draws} draws of the instrument's unknowns"] if study.unknowns.draws else []
    return "; ".join(parts) or "everything known"
