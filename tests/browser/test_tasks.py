"""What an operator wants to know or do, each within three clicks from the first page."""

from __future__ import annotations

import re
from collections.abc import Generator

import pytest
from playwright.sync_api import Page, expect

from tests.browser.archive import GOALS
from tests.browser.pages import NewRobot, action, goal, open_action, row, send
from tests.browser.served import ArchiveProcess, ConsoleProcess, RobotProcess, RosRobotProcess
from tests.support.ros_domain import own_domain

COUNT = """
    document.addEventListener("click", (event) => {
      sessionStorage.setItem("clicks", Number(sessionStorage.getItem("clicks") ?? 0) + 1);
    }, true);
"""


@pytest.fixture
def page(page: Page) -> Page:
    page.add_init_script(COUNT)
    return page


def begin(page: Page, address: str) -> None:
    """Open the first page, as a person who comes to it; clicks count from here."""
    page.goto("about:blank")
    page.goto(address)
    expect(page.locator("#connection")).to_contain_text("connected")
    expect(page.get_by_role("heading", name="All actions")).to_be_visible()
    page.evaluate("sessionStorage.setItem('clicks', 0)")


def clicks(page: Page) -> int:
    return int(page.evaluate("sessionStorage.getItem('clicks')"))


@pytest.fixture
def two(new_robot: NewRobot, robot: RobotProcess) -> Generator[ConsoleProcess, None, None]:
    """Start the console of two robots, of which one has gone."""
    gone = new_robot()
    with ConsoleProcess(f"arm3={robot.url}", f"arm7={gone.url}") as console:
        yield console


def test_which_robot_is_away(page: Page, new_robot: NewRobot, robot: RobotProcess) -> None:
    gone = new_robot()
    with ConsoleProcess(f"arm3={robot.url}", f"arm7={gone.url}") as console:
        begin(page, console.address)
        expect(action(page, "arm7/fibonacci")).to_be_visible()
        gone.kill()
        expect(action(page, "arm7/").first).to_contain_text("away")
        expect(action(page, "arm3/").first).not_to_contain_text("away")
        assert clicks(page) == 0


def test_why_the_last_goal_of_a_robot_failed(page: Page, two: ConsoleProcess) -> None:
    begin(page, two.address)
    action(page, "arm3/break").click()
    send(page, order="3")
    begin(page, two.address)
    page.get_by_role("navigation").get_by_role("link", name="arm3/", exact=True).click()
    expect(page.get_by_role("row", name="the arm is stuck").first).to_be_visible()
    assert clicks(page) == 1


def test_what_waits_and_why(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot, "clean")
    for _ in range(3):
        last = send(page, room="hall", minutes="0.2")
    begin(page, f"{robot.url}/#/")
    action(page, "clean").click()
    expect(row(page, last)).to_contain_text("waiting, 2 of 2")
    assert clicks(page) == 1
    page.get_by_role("button", name="Cancel all").click()
    page.get_by_role("button", name="Cancel all").last.click()
    expect(row(page, last)).to_contain_text("canceled")


def test_where_a_robot_is(page: Page, two: ConsoleProcess) -> None:
    begin(page, two.address)
    action(page, "arm7/arm/drive").click()
    page.get_by_label("gear").select_option("fast")
    send(page)
    begin(page, two.address)
    action(page, "Map").click()
    robot = page.get_by_role("row").filter(has=page.get_by_role("rowheader", name="arm7/arm/drive"))
    expect(robot).to_contain_text("2, 1")
    assert clicks(page) == 1


def test_to_see_the_camera(page: Page) -> None:
    with own_domain(), RosRobotProcess() as robot:
        with ConsoleProcess(f"arm={robot.url}", "base=dds://") as console:
            begin(page, console.address)
            action(page, "arm/move").click()
            page.get_by_role("button", name="Send goal").click()
            camera = page.get_by_role("img", name="Image image of the topic")
            expect(camera).to_be_visible()
            assert clicks(page) == 2


def test_to_cancel_all_goals_of_a_client(page: Page, new_robot: NewRobot) -> None:
    robot = new_robot()
    other = page.context.new_page()
    open_action(other, robot, "stubborn")
    others = send(other, order="1001")
    open_action(page, robot, "stubborn")
    mine = [send(page, order="1001") for _ in range(2)]
    begin(page, f"{robot.url}/#/")
    rows = [row(page, one) for one in mine]
    rows[0].locator(".client").get_by_role("button").click()
    expect(row(page, others)).to_have_count(0)
    page.get_by_role("button", name="Cancel all").click()
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text("cancel 2 goals of 127.0.0.1:")
    dialog.get_by_role("button", name="Cancel them").click()
    for one in rows:
        expect(one).to_contain_text("canceled")
    assert clicks(page) == 3
    expect(row(other, others)).to_contain_text("executing")


def test_to_run_again_what_failed_since_noon(page: Page, archive: ArchiveProcess) -> None:
    begin(page, f"{archive.url}/#/")
    failed = GOALS // 10
    page.get_by_role("button", name="Failed since noon").click()
    expect(page.locator(".list .note")).to_have_text(f"{failed} goals.")
    page.get_by_role("button", name="Send all again").click()
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text(f"sends {failed} goals once more")
    dialog.get_by_role("button", name="Send them again").click()
    expect(page.locator(".list .note")).to_have_text(f"{2 * failed} goals.")  # the can is empty
    assert clicks(page) == 3


def test_to_compare_two_runs(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot)
    runs = [send(page, order=order) for order in ("2", "3")]
    begin(page, f"{robot.url}/#/")
    row(page, runs[0]).get_by_role("link", name=runs[0], exact=True).click()
    goal(page).get_by_role("button", name="Compare", exact=True).click()
    row(page, runs[1]).get_by_role("link", name=runs[1], exact=True).click()
    comparison = page.get_by_role("region", name="Comparison")
    expect(comparison).to_contain_text(re.compile(r"goal\.order\s*2\s*3"))
    assert clicks(page) == 3


def test_the_p95_of_today(page: Page, archive: ArchiveProcess) -> None:
    begin(page, f"{archive.url}/#/")
    page.get_by_text("Numbers", exact=True).click()
    day = page.get_by_role("table", name="Numbers").get_by_role("row").filter(has_text="a day")
    heads = page.get_by_role("columnheader").filter(has_text="p95")
    expect(heads).to_have_count(2)
    expect(day.first).to_contain_text(re.compile(r"^painta day230.*(s|ms)$"))
    assert clicks(page) == 1


def test_to_pause_an_action(page: Page, new_robot: NewRobot) -> None:
    robot = new_robot()
    begin(page, f"{robot.url}/#/")
    action(page, "fibonacci").click()
    page.get_by_role("button", name="Pause…").click()
    page.get_by_role("dialog").get_by_role("button", name="Pause", exact=True).click()
    expect(action(page, "fibonacci")).to_contain_text("paused")
    assert clicks(page) == 3
