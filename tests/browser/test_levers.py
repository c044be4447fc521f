"""The levers and the numbers of the console in a real browser."""

from __future__ import annotations

import re
import time
from contextlib import closing
from pathlib import Path

from playwright.sync_api import Page, Route, expect

from fibaction import GoalID, GoalStatus
from fibaction.border.goal_store import StoredGoal
from fibaction.stores._journal_file import JournalFile
from fibaction.stores.journal_rows import WholeRecord, encode_row
from fibaction.words.goals import UNKNOWN_SENDER, digest_of
from fibaction.words.intake import NO_LEVERS
from tests.browser.archive import VARNISH, Paint
from tests.browser.pages import NewRobot, action, fits, goal, is_accessible, open_action, send
from tests.browser.served import ArchiveProcess, RobotProcess


def test_an_action_is_paused_and_resumed_after_questions_that_enter_does_not_answer_with_yes(
    page: Page, new_robot: NewRobot
) -> None:
    robot = new_robot()
    open_action(page, robot)
    page.get_by_role("button", name="Pause…").click()
    dialog = page.get_by_role("dialog")
    expect(dialog.get_by_role("button", name="Do not pause")).to_be_focused()
    page.keyboard.press("Enter")
    expect(dialog).to_have_count(0)
    expect(page.get_by_role("button", name="Resume…")).to_be_hidden()

    page.get_by_role("button", name="Pause…").click()
    dialog.get_by_label("New goals").select_option("refuse")
    dialog.get_by_label("Reason").fill("the floor is wet")
    is_accessible(page)
    dialog.get_by_role("button", name="Pause", exact=True).click()
    note = re.compile(r"^fibonacci: the action is paused since 20.* by 127.*: the floor is wet\.$")
    expect(page.get_by_role("status").filter(has_text="paused")).to_have_text(note)
    expect(action(page, "fibonacci")).to_contain_text("paused")
    page.get_by_label("order").fill("3")
    page.get_by_role("button", name="Send goal").click()
    expect(page.get_by_role("alert")).to_contain_text("Rejected: busy: the action is paused since")
    is_accessible(page)
    for width in (390, 1280):
        fits(page, width)

    page.reload()
    page.get_by_role("button", name="Resume…").click()
    dialog.get_by_role("button", name="Resume").click()
    expect(action(page, "fibonacci")).not_to_contain_text("paused")
    send(page, order="3")
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")

    page.get_by_role("button", name="Drain…").click()
    dialog.get_by_role("button", name="Drain", exact=True).click()
    expect(action(page, "fibonacci")).to_contain_text("drains")
    expect(page.get_by_role("button", name="Pause…")).to_be_hidden()


def test_the_numbers_of_a_day_and_an_hour_are_counted_from_the_history(
    page: Page, archive: ArchiveProcess
) -> None:
    page.goto(archive.url)
    action(page, "paint").click()
    page.get_by_text("Numbers", exact=True).click()
    table = page.get_by_role("table", name="Numbers")
    day = table.get_by_role("row").filter(has_text="a day")
    expect(day).to_contain_text(re.compile(r"^painta day230"))
    cells = day.get_by_role("cell").all_inner_texts()
    assert cells[3:6] == ["207", "0", "23"]
    assert all(re.fullmatch(r"[\d.]+ (ms|s)", text) for text in cells[6:])
    expect(page.locator(".failures")).to_have_text("23 goals: the can is empty")
    page.get_by_label("Span").select_option("1h")
    expect(table.get_by_role("row").filter(has_text="an hour")).to_contain_text("230")
    is_accessible(page)
    for width in (390, 1280):
        fits(page, width)
    page.goto(f"{archive.url}/#/")
    page.get_by_text("Numbers", exact=True).click()
    expect(page.locator(".failures")).to_have_text("23 goals of paint: the can is empty")
    expect(page.locator(".numbers .note").last).to_contain_text("are counted: varnish.")


def test_a_goal_that_was_given_up_runs_again_after_a_question(page: Page, tmp_path: Path) -> None:
    payload = VARNISH.goal.encode(Paint(7))
    old = StoredGoal(GoalID.random(), 1, UNKNOWN_SENDER, digest_of(payload), payload)
    old.checkpoint = b"\x81\xa4done\x04"
    old.status, old.ended_at = GoalStatus.ABORTED, time.time_ns()
    old.reason = "given up after 3 attempts: the server was restarted"
    with closing(JournalFile(str(tmp_path / "goals.db"), "full")) as file:
        file.add(encode_row(file.next_number, [WholeRecord("varnish", old)]))
    with ArchiveProcess(tmp_path) as robot:
        page.goto(f"{robot.url}/#/varnish/{old.goal_id}")
        again = page.get_by_role("button", name="Run again from its checkpoint")
        checkpoint = page.get_by_label("Checkpoint")
        expect(checkpoint).to_contain_text(re.compile(r"done.*4"))
        again.click()
        is_accessible(page)
        page.get_by_role("dialog").get_by_role("button", name="Run again").click()
        expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
        expect(again).to_be_hidden()
        page.goto(f"{robot.url}/#/varnish/{old.goal_id}")
        page.reload()
        expect(goal(page).locator(".badge")).to_have_text("✕ aborted")
        expect(goal(page).locator(".reason")).to_contain_text("given up after 3 attempts")
        expect(page.get_by_label("Result")).to_be_visible()
        expect(again).to_be_hidden()
        expect(checkpoint).to_be_hidden()


def test_the_levers_of_an_action_that_has_none_are_disabled_and_say_why(
    page: Page, robot: RobotProcess
) -> None:
    def without_levers(route: Route) -> None:
        infos = route.fetch().json()
        route.fulfill(json=[info | {"no_levers": NO_LEVERS} for info in infos])

    page.route("**/actions", without_levers)
    open_action(page, robot)
    for name in ("Pause…", "Drain…"):
        lever = page.get_by_role("button", name=name)
        expect(lever).to_be_disabled()
        expect(lever).to_have_attribute("title", f"fibonacci: {NO_LEVERS}.")
    is_accessible(page)
