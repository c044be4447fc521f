"""What the tests of the console do with its pages: open, send, find a goal, and check each page."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Literal

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Locator, Page, expect

from tests.browser.served import RobotProcess

ID = re.compile("[0-9a-f]{8}")
LONG = "2000"
"""An order of `fibonacci` whose goal is active for longer than a test, unless it is canceled."""
THEMES: tuple[Literal["light"], Literal["dark"]] = ("light", "dark")
NewRobot = Callable[..., RobotProcess]


def open_action(page: Page, robot: RobotProcess, name: str = "fibonacci") -> None:
    page.goto(f"{robot.url}/#/{name}")
    expect(page.get_by_role("heading", name=name, exact=True)).to_be_visible()


def action(page: Page, name: str) -> Locator:
    """Return the link of an action in the list of actions, as rows of goals link to it too."""
    return page.get_by_role("navigation", name="Actions").get_by_role("link", name=name)


def send(page: Page, **fields: str) -> str:
    """Send a goal, and return the first letters of its ID."""
    shown = page.locator(".goal header code").all_inner_texts()
    for name, value in fields.items():
        page.get_by_label(name, exact=True).fill(value)
    page.get_by_role("button", name="Send goal").click()
    expect(page.locator(".goal header code")).to_have_text(ID)
    for before in shown:
        expect(page.locator(".goal header code")).not_to_have_text(before)
    return page.locator(".goal header code").inner_text()


def goal(page: Page) -> Locator:
    """Return the part of the page that shows one goal."""
    return page.locator(".goal")


def row(page: Page, goal_id: str) -> Locator:
    """Return the row of a goal in the table."""
    return page.get_by_role("row").filter(has=page.get_by_role("link", name=goal_id, exact=True))


def rows(page: Page) -> Locator:
    """Return the rows of the table."""
    return page.get_by_role("table", name="Goals").locator("tbody tr")


def chosen(page: Page) -> Locator:
    """Return the part of the page about the goals that are chosen."""
    return page.get_by_role("group", name="Chosen goals")


def line(page: Page, name: str) -> Locator:
    """Return the row of a server."""
    return page.get_by_role("row").filter(has=page.get_by_role("rowheader", name=name, exact=True))


def is_accessible(page: Page) -> None:
    """Check a page in both themes."""
    for theme in THEMES:
        # Without transitions, in the middle of which a colour has no contrast yet.
        page.emulate_media(color_scheme=theme, reduced_motion="reduce")
        found = Axe().run(page)
        assert found.violations_count == 0, found.generate_report()


def fits(page: Page, width: int) -> None:
    """Check that a page is not wider than a window."""
    page.set_viewport_size({"width": width, "height": 740})
    wide = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
    assert page.evaluate(wide) <= 0
