"""Tabs of the page: one module each for those with pictures, which are listed below; others follow from their verb."""

from __future__ import annotations

from mauvecl.answers.verbs import VERBS
from mauvecl.web.tabs.calibrations import Calibrate, Change, Periods
from mauvecl.web.tabs.campaigns import Plan, Visibility
from mauvecl.web.tabs.detection import Detection, Unknown
from mauvecl.web.tabs.light_curves import Analyse, Completeness
from mauvecl.web.tabs.limit import Limit
from mauvecl.web.tabs.measurements import Measurement
from mauvecl.web.tabs.spectra import Noise, Signal, Spectrum
from mauvecl.web.tabs.tab import Compare, Tab

#: Tabs with pictures, in the order of the page.
DRAWN: dict[str, Tab] = {
    tab.name: tab
    for tab in (
        Detection(),
        Spectrum(),
        Signal(),
        Noise(),
        Limit(),
        Measurement(),
        Unknown(),
        Change(),
        Periods(),
        Completeness(),
        Analyse(),
        Calibrate(),
        Visibility(),
        Plan(),
    )
}


def _tab_of(verb: str) -> Tab:
    """Return the tab with the first view of a verb's answer."""
    made: Tab = type(verb.capitalize(), (Tab,), {"verb": verb})()
    return made


#: All tabs by name, in the order of the page.
TABS: dict[str, Tab] = {
    **DRAWN,
    **{name: _tab_of(name) for name, verb in VERBS.items() if verb.tab and name not in DRAWN},
    Compare.name: Compare(),
}


def asking(simulation: str) -> Tab:
    """Return the tab whose button starts a simulation."""
    return next(tab for tab in TABS.values() if simulation in tab.simulations)


def reads_of(simulation: str) -> frozenset[str]:
    """Return the fields on which the answers of a simulation depend."""
    return asking(simulation).reads_of(simulation)
