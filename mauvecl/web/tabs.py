"""The tabs: what each shows of an answer, built when it first comes to the front."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import panel as pn

from mauvecl.web.buttons import downloads
from mauvecl.web.fields import TABS
from mauvecl.web.views import Distributions, InputSpectrum, NoiseBudget, RawSpectrum, Roc, SignalToNoise, Smooth

if TYPE_CHECKING:
    from mauvecl.web.page import Page

TITLES = dict(
    zip(
        TABS,
        ("Simulated observation", "S/N", "Noise budget", "Flare detection", "Limiting magnitude and map"),
        strict=True,
    )
)


class Tabs:
    """All tabs of a page.

    Parameters
    ----------
    page : Page
        Whose answers they show.
    """

    def __init__(self, page: Page) -> None:
        self._page = page
        self._rooms = {name: pn.Column(sizing_mode="stretch_width") for name in TABS}
        self._shows: dict[str, Any] = {}
        self._stale: set[str] = set()
        self.whole = pn.Tabs(
            *((TITLES[name], room) for name, room in self._rooms.items()), dynamic=False, sizing_mode="stretch_width"
        )
        self.whole.param.watch(lambda event: page.enter({"tab": TABS[event.new]}), "active")

    def dim(self, dimmed: bool) -> None:
        """What is shown is no answer to the fields, or is one again."""
        styles = {"opacity": "0.25"} if dimmed else {}
        if self.whole.styles != styles:
            self.whole.styles = styles

    def renew(self, *names: str) -> None:
        """Tabs whose answers are others now, all without names; the one in front is shown, others when they come."""
        self._stale |= set(names or TABS)
        self.show()

    def show(self) -> None:
        """The tab in front, as the state has it."""
        name = self._page.state.tab
        if self.whole.active != TABS.index(name):
            self.whole.active = TABS.index(name)
        if name not in self._stale or self._page.quiet is None:
            return
        self._stale.discard(name)
        if name not in self._shows:
            self._shows[name] = getattr(self, f"_make_{name}")()
        self._shows[name]()

    def fresh(self, name: str) -> bool:
        """Whether a tab is in front and shows the present answer."""
        return name == self._page.state.tab and name not in self._stale and name in self._shows

    def draw(self, raw: Any) -> None:
        """A raw spectrum of the present question has been drawn."""
        if self.fresh("observation") and self._page.quiet is not None:
            self._observation.add(self._page.quiet, raw)

    def _make_observation(self) -> Any:
        page, view, spectrum = self._page, RawSpectrum(), InputSpectrum()
        self._observation = view
        self._rooms["observation"].objects = [view.plot, spectrum.plot, downloads(page, "observation")]

        def show() -> None:
            view.show(page.quiet, page.flare)  # type: ignore[arg-type]
            spectrum.show(*page.light)
            page.draw_soon()

        return show

    def _make_snr(self) -> Any:
        page, view = self._page, SignalToNoise()
        self._rooms["snr"].objects = [view.plot, downloads(page, "snr")]

        def show() -> None:
            view.show(page.quiet)  # type: ignore[arg-type]
            if "snr" in page.found:
                view.add(page.found["snr"].element)

        return show

    def _make_noise(self) -> Any:
        page, view = self._page, NoiseBudget()
        self._rooms["noise"].objects = [view.plot, downloads(page, "noise-budget")]
        return lambda: view.show(page.quiet)  # type: ignore[arg-type]

    def _make_detection(self) -> Any:
        page, distributions, roc = self._page, Distributions(), Roc()
        table = pn.pane.DataFrame(None, index=False, sizing_mode="stretch_width", escape=True)
        self._rooms["detection"].objects = [
            table, distributions.plot, roc.plot, downloads(page, "detection"), downloads(page, "roc"),
        ]  # fmt: skip

        def show() -> None:
            q, theory = page.state.question(), page.theory
            assert theory is not None
            null, with_flare = (Smooth(theory.closed_form(q.statistic, k)) for k in (None, 0))
            distributions.show(null, with_flare, page.cut, q.statistic, q.fap)
            roc.show(null, with_flare)
            answer = page.found.get("detection")
            table.object = None if answer is None else _rows(answer)
            if answer is not None:
                distributions.add(answer.stars[0], q.statistic, q.fap)
                roc.add(answer.stars[0], q.statistic)

        return show

    def _make_limit(self) -> Any:
        page, limit, found_map = self._page, pn.Column(), pn.Column()
        for column in (limit, found_map):
            column.sizing_mode = "stretch_width"
        self._rooms["limit"].objects = [
            pn.FlexBox(page.run_limit, page.run_map), limit, found_map,
            downloads(page, "limit", with_study=True), downloads(page, "map", with_study=True),
        ]  # fmt: skip

        def show() -> None:
            limit.objects = page.shown_limit()
            found_map.objects = page.shown_map()

        return show


def _rows(answer: Any) -> Any:
    columns = {
        "statistic": "statistic", "mean": "mean with flare", "threshold": "threshold",
        "probability": "detected", "low": "95 % from", "high": "to", "closed_form_probability": "closed form",
    }  # fmt: skip
    return answer.table.to_pandas()[list(columns)].rename(columns=columns)
