"""The page arrives in a browser, as the server's headers permit."""

from __future__ import annotations

from playwright.sync_api import Page

from tests.browser.served import RobotProcess


def test_the_page_of_a_server_is_the_console(page: Page, robot: RobotProcess) -> None:
    answer = page.goto(robot.url)
    assert answer is not None
    assert answer.status == 200
    assert page.title() == "fibaction console"
