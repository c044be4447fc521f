"""The page of the REST interface in a real browser, with a robot in a process of its own."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Locator, Page, expect

from tests.browser.served import RobotProcess

ID = "0123456789abcdef" * 2


def operation(page: Page, method: str, path: str) -> Locator:
    """Open one operation, and return the part of the page that shows it."""
    found = page.locator(".operation").filter(
        has=page.locator("summary code", has_text=re.compile(f"^{re.escape(path)}$")),
    )
    found = found.filter(has=page.locator(".method", has_text=re.compile(f"^{method}$")))
    found.locator("summary").first.click()
    return found


def send(shown: Locator) -> Locator:
    """Send an operation, and return the part that shows the answer."""
    shown.get_by_role("button", name="Send").click()
    return shown.get_by_label("Answer", exact=True)


def test_a_goal_is_sent_and_its_answer_is_shown(page: Page, robot: RobotProcess) -> None:
    page.goto(f"{robot.url}/docs")
    shown = operation(page, "POST", "/actions/fibonacci/goals")
    expect(shown.locator("textarea")).to_have_value('{\n  "order": 0\n}')
    expect(shown).to_contain_text("order: integer")
    shown.locator("textarea").fill('{"order": 5}')
    shown.get_by_label("wait").fill("20")
    answer = send(shown)
    expect(answer).to_contain_text('"status": "SUCCEEDED"')
    expect(shown.get_by_role("status")).to_contain_text("201 Created · /actions/fibonacci/goals/")
    command = f"curl -X POST '{robot.url}/actions/fibonacci/goals?wait=20'"
    expect(shown).to_contain_text(command)


def test_schemas_show_types_units_limits_and_defaults(page: Page, robot: RobotProcess) -> None:
    page.goto(f"{robot.url}/docs")
    shown = operation(page, "POST", "/actions/arm/drive/goals")
    schema = shown.locator("pre").first
    expect(schema).to_contain_text("speed?: number ≤ 2 > 0 = 0.5  // Speed on straight lines")
    expect(schema).to_contain_text('gear?: "fast" | "normal" | "slow" = "normal"')
    expect(schema).to_contain_text("x?: number [m] = 0")
    expect(schema).to_contain_text("note?: string | null = null")
    expect(schema).to_contain_text("stops?: array of {")
    expect(shown.locator("textarea")).to_have_value(re.compile(r'"target": {\n    "x": 2'))
    send(shown)
    expect(shown.get_by_role("status")).to_contain_text("201 Created")  # the sample is a goal


def test_events_are_shown_as_they_come_until_they_are_stopped(
    page: Page, robot: RobotProcess
) -> None:
    page.goto(f"{robot.url}/docs")
    put = operation(page, "PUT", "/actions/fibonacci/goals/{goal_id}")
    put.get_by_label("goal_id *").fill(ID)
    put.locator("textarea").fill('{"order": 2000}')
    expect(send(put)).to_contain_text('"status"')
    events = operation(page, "GET", "/actions/fibonacci/goals/{goal_id}/events")
    events.get_by_label("goal_id *").fill(ID)
    answer = send(events)
    expect(answer).to_contain_text("event: feedback")
    events.get_by_role("button", name="Stop").click()
    expect(events.get_by_role("status")).to_have_text("200 OK, stopped")
    cancel = operation(page, "DELETE", "/actions/fibonacci/goals/{goal_id}")
    cancel.get_by_label("goal_id *").fill(ID)
    send(cancel)
    expect(cancel.get_by_role("status")).to_have_text("202 Accepted")


@pytest.mark.parametrize(
    ("method", "path", "body", "told"),
    [
        ("POST", "/actions/fibonacci/goals", '{"order"', "the body is not JSON"),
        ("POST", "/actions/fibonacci/goals", '{"order": "x"}', "422 Unprocessable"),
        ("GET", "/actions/fibonacci/goals/{goal_id}", "", "goal_id is missing"),
    ],
)
def test_what_is_wrong_is_told(
    page: Page, robot: RobotProcess, method: str, path: str, body: str, told: str
) -> None:
    page.goto(f"{robot.url}/docs")
    shown = operation(page, method, path)
    if body:
        shown.locator("textarea").fill(body)
    send(shown)
    expect(shown.get_by_role("status")).to_contain_text(told)


def test_operations_are_filtered(page: Page, robot: RobotProcess) -> None:
    page.goto(f"{robot.url}/docs")
    page.get_by_label("Filter operations").fill("flood/goals/{goal_id}/ev")
    expect(page.locator(".operation:visible")).to_have_count(1)
    expect(page.locator("h2:visible")).to_have_text(["flood"])
    expect(page.locator("#announcer")).to_have_text("1 operations")


def test_a_server_with_tokens_is_asked_with_the_token_of_the_user(
    page: Page, new_robot: Callable[..., RobotProcess]
) -> None:
    robot = new_robot(token="correct-horse")
    page.goto(f"{robot.url}/docs")
    page.get_by_label("Token").fill("guess")
    page.get_by_role("button", name="Continue").click()
    expect(page.get_by_role("alert")).to_have_text("The server rejected this token.")
    page.get_by_label("Token").fill("correct-horse")
    page.get_by_role("button", name="Continue").click()
    shown = operation(page, "GET", "/actions")
    expect(send(shown)).to_contain_text('"fibonacci"')
    expect(shown).to_contain_text('-H "Authorization: Bearer $TOKEN"')
    expect(page.locator("body")).not_to_contain_text("correct-horse")


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_is_accessible_and_fits_its_window(
    page: Page, robot: RobotProcess, width: int, scheme: str
) -> None:
    page.set_viewport_size({"width": width, "height": 860})
    # Without transitions, in the middle of which a colour has no contrast yet.
    page.emulate_media(color_scheme=scheme, reduced_motion="reduce")  # type: ignore[arg-type]  # it is one of its words
    page.goto(f"{robot.url}/docs")
    shown = operation(page, "POST", "/actions/fibonacci/goals")
    send(shown)
    expect(shown.get_by_role("status")).to_contain_text("201 Created")
    found = Axe().run(page)
    assert found.violations_count == 0, found.generate_report()
    assert page.evaluate("document.documentElement.scrollWidth") <= width
