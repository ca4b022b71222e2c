"""One server of the page for all tests of a process, and one browser for those of a module."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from tests.web.visits import CHROMIUM, Server, fresh

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

    from mauvecl.study.study import Study


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    found = Server(tmp_path_factory.mktemp("serve") / "log.txt")
    yield found
    found.kill()
    # A visitor who leaves in mid-sentence is no fault.
    reported = found.log.read_text()
    assert "mauvecl.web" not in reported, reported
    assert "Traceback" not in reported, reported
    assert "Warning" not in reported, reported


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no Chromium here")
    with playwright.sync_playwright() as play:
        found = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()


@pytest.fixture
def short_simulations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce what a button of the page asks: fewer fits, cells of maps, and sinusoids per cell."""
    simulations = pytest.importorskip("mauvecl.web.simulations")
    monkeypatch.setattr(simulations, "MOST_FITS", 200)
    monkeypatch.setattr(simulations, "MOST_OF_TWO", 20)
    monkeypatch.setattr(simulations, "MAP_STEPS", 3)
    whole = simulations.SIMULATIONS["periods"]

    def few(study: Study) -> Study:
        change = {"steps": 2, "trials": 10, "period_fap": 0.1}
        return whole.asked(study).with_changes({"change": change}, None, "test")

    monkeypatch.setitem(simulations.SIMULATIONS, "periods", replace(whole, asked=few))


@pytest.fixture
def page(browser: Browser, server: Server) -> Iterator[Page]:
    found = fresh(browser, server.address)
    yield found
    found.context.close()
