"""How the page is put together: tabs with their downloads, controls beside them, alerts on top."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import panel as pn
from panel.theme import fast

from mauvecl.web.question import UPLOADED

if TYPE_CHECKING:
    from mauvecl.web.page import Page

NOMINAL = (
    "Nominal throughput, pieced together from the paper, datasheets and assumptions: not a flight calibration. "
    "Sensible uncertainty: 30 %, and 50 % below 250 nm."
)
ABOUT = (
    "Would the Mauve satellite see this stellar flare, and how sure can one be? Closed forms follow every change at "
    "once; *Simulate* refines them with noise realisations."
)


class Fast(fast.Fast):
    """Panel's design with the system's letters: no visitor's browser asks another server for them.

    Its name is Panel's own, by which the design's files are found.
    """

    _resources: ClassVar[Any] = {**fast.Fast._resources, "font": {}}


def download(page: Page, label: str, file: Any, make: Callable[[], io.BytesIO], width: int = 200) -> Any:
    """A button that gives a file; `file` is its name, or something that follows the question."""
    button = pn.widgets.FileDownload(
        callback=partial(page.safely, make), label=label, embed=False, auto=True, width=width
    )
    button.filename = file
    return button


def downloads(page: Page, name: str, *, study: bool = False) -> Any:
    """Buttons that give an answer's table and picture, and the study where it is not the question's own."""
    buttons = [
        download(page, f"{name} ({ending})", f"mauvecl-{name}.{ending}", partial(page.file, name, ending))
        for ending in ("ecsv", "fits", "png")
    ]
    if study:
        buttons.append(download(page, f"{name} (study)", named(page, name), partial(page.study_of, name)))
    return pn.FlexBox(*buttons)


def named(page: Page, name: str) -> Any:
    """A study's file: an uploaded star comes beside it."""
    return page.question.param.star.rx.pipe(lambda star: f"{name}.zip" if star == UPLOADED else f"{name}.toml")


def tabs(page: Page) -> Any:
    """A tab for each kind of answer, with what of it can be taken along."""
    observation, snr, budget, distributions, roc = (view.plot for view in page.views)
    taken = downloads(page, "observation")
    return pn.Tabs(
        ("Simulated observation", pn.Column(observation, page.spectrum.plot, taken)),
        ("S/N", pn.Column(snr, downloads(page, "snr"))),
        ("Noise budget", pn.Column(budget, downloads(page, "noise-budget"))),
        (
            "Flare detection",
            pn.Column(
                page.table, distributions, roc, downloads(page, "detection"), downloads(page, "roc"),
            ),
        ),
        (
            "Limiting magnitude and map",
            pn.Column(
                pn.FlexBox(page.run_limit, page.run_map), page.limit, page.map,
                downloads(page, "limit", study=True), downloads(page, "map", study=True),
            ),
        ),
        dynamic=False,
        sizing_mode="stretch_width",
    )  # fmt: skip


def layout(page: Page) -> Any:
    """The whole page."""
    study = download(page, "Study for the command line", named(page, "study"), page.study_of, width=260)
    head = pn.Column(
        page.alerts,
        page.summary,
        pn.FlexBox(page.run, page.cancel, study, sizing_mode="stretch_width"),
        page.bar,
        page.status,
        sizing_mode="stretch_width",
    )
    # Side by side where there is room, below each other on a phone.
    asked = pn.Column(page.controls, styles={"flex": "1 1 280px"}, max_width=420)
    answered = pn.Column(page.tabs, styles={"flex": "4 1 340px"}, min_width=300)
    template = pn.template.FastListTemplate(
        title="mauvecl",
        main=[
            pn.Column(pn.pane.Markdown(ABOUT), head, sizing_mode="stretch_width"),
            pn.FlexBox(asked, answered, sizing_mode="stretch_width", gap="20px"),
            pn.pane.Markdown(f"*{NOMINAL}*"),
        ],
        accent_base_color="#0072B2",
        header_background="#0072B2",
        theme_toggle=False,
        main_layout=None,
        design=Fast,
    )
    template.font, template.font_url = "system-ui", ""
    return template
