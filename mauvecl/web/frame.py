"""How the page is put together: tabs with their downloads, controls beside them, alerts on top."""

from __future__ import annotations

from typing import Any, ClassVar
from urllib.parse import urlencode
from weakref import WeakKeyDictionary

import panel as pn
from panel.io.location import Location
from panel.theme import fast

from mauvecl.web.buttons import study
from mauvecl.web.page import Page
from mauvecl.web.words import line

NOMINAL = (
    "Nominal throughput, pieced together from the paper, datasheets and assumptions: not a flight calibration. "
    "Sensible uncertainty: 30 %, and 50 % below 250 nm."
)
ABOUT = (
    "Would the Mauve satellite see this stellar flare, and how sure can one be? Closed forms follow every change at "
    "once; <i>Simulate</i> refines them with noise realisations."
)


class Fast(fast.Fast):
    """Panel's design with the system's letters: no visitor's browser asks another server for them.

    Its name is Panel's own, by which the design's files are found.
    """

    _resources: ClassVar[Any] = {**fast.Fast._resources, "font": {}}


def layout(page: Page) -> Any:
    """The whole page."""
    taken = study(page, "Study for the command line", "study", page.study_of, width=260)
    head = pn.Column(
        page.alerts,
        page.summary,
        pn.FlexBox(page.run, page.cancel, taken, sizing_mode="stretch_width"),
        page.bar,
        page.status,
        sizing_mode="stretch_width",
    )
    # Side by side where there is room, below each other on a phone.
    asked = pn.Column(page.controls.column, styles={"flex": "1 1 280px"}, max_width=420)
    answered = pn.Column(page.tabs.whole, styles={"flex": "4 1 340px"}, min_width=300)
    template = pn.template.FastListTemplate(
        title="mauvecl",
        main=[
            pn.Column(line(ABOUT), head, sizing_mode="stretch_width"),
            pn.FlexBox(asked, answered, sizing_mode="stretch_width", gap="20px"),
            line(f"<i>{NOMINAL}</i>"),
        ],
        accent_base_color="#0072B2",
        header_background="#0072B2",
        theme_toggle=False,
        main_layout=None,
        design=Fast,
        # One for all visitors: each change of any of them would be told to everybody.
        busy_indicator=None,
    )
    template.font, template.font_url = "system-ui", ""
    return template


#: Pages by their documents, for as long as these are.
PAGES: WeakKeyDictionary[Any, Page] = WeakKeyDictionary()


def session() -> None:
    """A page for a new visitor, in their document."""
    document: Any = pn.state.curdoc
    given = document.session_context.request.arguments
    link = urlencode([(name, value.decode(errors="replace")) for name, values in given.items() for value in values])
    # The models are looked through once, not after each that is added.
    with document.models.freeze():
        page = PAGES[document] = Page(link)
        # The template asks for one; addresses are the bridge's.
        layout(page).server_doc(document, title="mauvecl", location=Location())
