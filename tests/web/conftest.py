"""One server of the page for all tests of a process, and one browser for those of a module."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

pytest.importorskip("bokeh")
pytest.importorskip("tornado")

from tests.web.visits import CHROMIUM, Server, Window

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    found = Server(tmp_path_factory.mktemp("serve") / "log.txt")
    yield found
    found.end()


@pytest.fixture(scope="session")
def words(server: Server) -> dict[str, Any]:
    return server.words()


@pytest.fixture
def talk(request: pytest.FixtureRequest) -> Server:
    """Return the test's server; a test that is a coroutine gets the talk of a new visitor in its place."""
    return request.getfixturevalue("strict" if "strict" in request.fixturenames else "server")


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine as a visit to the page."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    given = {name: pyfuncitem.funcargs[name] for name in inspect.signature(pyfuncitem.obj).parameters}
    given.pop("talk").visited(lambda talk: pyfuncitem.obj(talk=talk, **given))
    return True


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
def visit(browser: Browser, server: Server) -> Iterator[Callable[..., Window]]:
    """Return a function that opens the page for a new visitor, with a link and options of the browser."""
    yield lambda link="", **how: Window(browser, server.address + link, **how)
    for context in browser.contexts:
        context.close()


@pytest.fixture
def page(visit: Callable[..., Window]) -> Window:
    return visit()
