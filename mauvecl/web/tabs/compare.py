"""Comparison of pinned and simulated scenarios, which the browser stores."""

from __future__ import annotations

from mauvecl.web.tabs.tab import Tab


class Compare(Tab):
    """Pinned scenarios and the history of runs."""

    name, title = "compare", "Compare"
    about = "Scenarios that you have pinned, side by side, and what you have simulated; this browser tab keeps them."
