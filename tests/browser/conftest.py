"""A real browser for tests: Debian's chromium, driven by Playwright.

`.ci/run` sets FIBACTION_BROWSER=required; elsewhere the tests are skipped without a browser.

Playwright's loop runs in the thread of the tests for as long as the browser is open, and asyncio
permits no other one there. So the browser is closed before tests of other folders.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect, sync_playwright

from tests.browser.served import ArchiveProcess, RobotProcess

CHROMIUM = Path("/usr/bin/chromium-headless-shell")
"""The browser without windows, which takes half of the processor time of the one with windows."""

if not CHROMIUM.exists() and (WITH_WINDOWS := Path("/usr/bin/chromium")).exists():
    CHROMIUM = WITH_WINDOWS

IS_LEFT_OUT = not CHROMIUM.exists() and os.environ.get("FIBACTION_BROWSER") != "required"
PATIENCE = 30_000
"""Milliseconds within which a page does what a test waits for."""
expect.set_options(timeout=PATIENCE)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give tests with a browser more time, as long as a browser needs to start."""
    here = Path(__file__).parent
    for item in items:
        if item.path.is_relative_to(here):
            item.add_marker(pytest.mark.timeout(120))


@pytest.fixture(scope="package")
def browser() -> Generator[Browser, None, None]:
    """Start one browser for the tests of this folder."""
    if IS_LEFT_OUT:
        pytest.skip(f"{CHROMIUM} is not there: apt-get install chromium-headless-shell")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="package")
def robot(browser: Browser) -> Generator[RobotProcess, None, None]:
    """Start one robot for all tests that leave it as it is."""
    with RobotProcess() as running:
        yield running


@pytest.fixture
def context(browser: Browser) -> Generator[BrowserContext, None, None]:
    """Open the browser for a new user, whose pages may not have errors."""
    errors: list[str] = []
    context = browser.new_context(viewport={"width": 1280, "height": 860})
    context.set_default_timeout(PATIENCE)
    context.on("weberror", lambda error: errors.append(str(error.error)))
    yield context
    context.close()
    assert errors == []


@pytest.fixture
def page(context: BrowserContext) -> Page:
    """Open a page."""
    return context.new_page()


@pytest.fixture
def new_robot(browser: Browser) -> Generator[Callable[..., RobotProcess], None, None]:
    """Start a robot of the test's own."""
    started: list[RobotProcess] = []

    def start(query: str = "", token: str = "") -> RobotProcess:
        robot = RobotProcess(query, token)
        started.append(robot)
        robot.start()
        return robot

    yield start
    for robot in started:
        robot.kill()


@pytest.fixture
def archive(browser: Browser, tmp_path: Path) -> Generator[ArchiveProcess, None, None]:
    """Start a robot whose goals of the past are in a history only."""
    with ArchiveProcess(tmp_path) as running:
        yield running
