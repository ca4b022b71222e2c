"""The registry of verbs: the questions that mauvecl answers, by one name in Python and on the command line."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True)
class Verb:
    """One question, answered by the function of the same name: ``verb(study, engine=None, progress=None) -> Answer``.

    Attributes
    ----------
    name : str
    home : str
        Module of `mauvecl.answers` that holds the function; it is imported when the verb is first used.
    counts : str
        What the command line's progress bar counts; empty if a closed form answers at once.
    older : tuple of str
        Names that the function had before; they still work.
    """

    name: str
    home: str
    counts: str = ""
    older: tuple[str, ...] = ()

    @property
    def ask(self) -> Callable[..., Any]:
        """The function that answers."""
        function: Callable[..., Any] = getattr(import_module(f"mauvecl.answers.{self.home}"), self.name)
        return function


#: By name, in the order of `mauvecl --help`: one star, flares, hours and campaigns.
VERBS: dict[str, Verb] = {
    one.name: one
    for one in (
        Verb("simulate", "signal.simulate"),
        Verb("snr", "signal.snr", "realisations"),
        Verb("exposure", "signal.exposures"),
        Verb("detect", "detection.detect", "realisations"),
        Verb("limit", "limits.limits", "limits", older=("limiting_magnitude",)),
        Verb("map", "detection.maps", "cells", older=("detection_map",)),
        Verb("gaussian", "detection.gaussian", "realisations", older=("gaussian_report",)),
        Verb("measure", "measurements.measure", "flares"),
        Verb("stare", "stares.stare", "stares"),
        Verb("inject", "stares.inject", "injections"),
        Verb("analyse", "observations.analyse"),
        Verb("visible", "campaigns.visible"),
        Verb("plan", "campaigns.plan", "targets"),
    )
}
#: Where every public name of a verb is at home, older names among them.
HOMES = {name: f"answers.{verb.home}" for verb in VERBS.values() for name in (verb.name, *verb.older)}
