"""Tabs of the page, one module each; a new tab is added to the list below."""

from __future__ import annotations

from mauvecl.web.tabs.change import Change
from mauvecl.web.tabs.compare import Compare
from mauvecl.web.tabs.completeness import Completeness
from mauvecl.web.tabs.detection import Detection
from mauvecl.web.tabs.limit import Limit
from mauvecl.web.tabs.measurements import Measurement
from mauvecl.web.tabs.noise import Noise
from mauvecl.web.tabs.plan import Plan
from mauvecl.web.tabs.signal import Signal
from mauvecl.web.tabs.spectrum import Spectrum
from mauvecl.web.tabs.tab import Tab
from mauvecl.web.tabs.unknowns import Unknown
from mauvecl.web.tabs.visibility import Visibility

#: By name, in the order of the page.
TABS: dict[str, Tab] = {
    one.name: one
    for one in (
        Detection(),
        Spectrum(),
        Signal(),
        Noise(),
        Limit(),
        Measurement(),
        Unknown(),
        Change(),
        Completeness(),
        Visibility(),
        Plan(),
        Compare(),
    )
}
