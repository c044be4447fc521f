"""The console of several robots in a real browser: one is killed, frozen and started again."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Generator

import pytest
from playwright.sync_api import FilePayload, Page, expect

from fibaction import __version__
from tests.browser.pages import (
    LONG,
    NewRobot,
    action,
    fits,
    goal,
    is_accessible,
    line,
    open_action,
    row,
    send,
)
from tests.browser.served import ConsoleProcess, RobotProcess
from tests.browser.test_console import drive, png


@pytest.fixture
def north(new_robot: NewRobot) -> RobotProcess:
    return new_robot()


@pytest.fixture
def console(north: RobotProcess, robot: RobotProcess) -> Generator[ConsoleProcess, None, None]:
    """Start the console of a robot of the test's own, and of one for all tests."""
    with ConsoleProcess(f"north={north.url}", f"south={robot.url}") as running:
        yield running


def test_the_servers_are_listed_and_their_actions_are_in_namespaces(
    page: Page, console: ConsoleProcess
) -> None:
    page.goto(console.address)
    action(page, "Servers").click()
    expect(page).to_have_title("servers · fibaction console")
    for text in ("connected", "0 active goals", "13 actions", __version__):
        expect(line(page, "north")).to_contain_text(text)
    schedules = page.get_by_role("table", name="Schedules")
    schedule = schedules.get_by_role("row").filter(has_text="south/fibonacci")
    expect(schedule).to_have_text("south/fibonaccitakes goalsall goals run at once")
    action(page, "south/fibonacci").click()
    sent = send(page, order="3")
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
    page.get_by_role("navigation").get_by_role("link", name="north/", exact=True).click()
    expect(page.get_by_role("heading", name="north/", exact=True)).to_be_visible()
    expect(row(page, sent)).to_have_count(0)
    page.get_by_role("navigation").get_by_role("link", name="south/", exact=True).click()
    expect(row(page, sent)).to_have_count(1)
    action(page, "Servers").click()
    expect(line(page, "north")).to_be_visible()
    is_accessible(page)
    fits(page, 390)
    for part in (
        line(page, "north").get_by_role("rowheader"),
        line(page, "north").locator(".badge"),
    ):
        assert part.evaluate("(one) => one.getBoundingClientRect().height < 40")  # unbroken words


def test_a_robot_that_goes_is_away_in_the_list_and_the_others_stay(
    page: Page, console: ConsoleProcess, north: RobotProcess
) -> None:
    page.goto(f"{console.address}&/north/fibonacci")
    expect(page.get_by_role("heading", name="north/fibonacci")).to_be_visible()
    running = send(page, order=LONG)
    page.goto(f"{console.url}/#servers")
    expect(line(page, "north")).to_contain_text("1 active goal")
    for end, again in (
        (north.kill, north.start),
        (
            lambda: os.kill(north.pid, signal.SIGSTOP),
            lambda: os.kill(north.pid, signal.SIGCONT),
        ),
    ):
        end()
        expect(line(page, "north")).to_contain_text("away since")
        expect(line(page, "south")).to_contain_text("connected")
        expect(action(page, "Servers")).to_contain_text("away")
        expect(page).to_have_title(re.compile(r"^\(1\) servers"))
        again()
        expect(line(page, "north")).to_contain_text("connected")
        page.evaluate("window.dispatchEvent(new Event('focus'))")
        expect(page).to_have_title("servers · fibaction console")
    page.goto(f"{console.url}/#/north/fibonacci")
    expect(row(page, running).locator(".badge")).to_have_text("? unknown")
    send(page, order="3")
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")


def test_a_console_that_is_killed_and_started_again_shows_its_servers_again(
    page: Page, console: ConsoleProcess
) -> None:
    page.goto(console.address)
    action(page, "Servers").click()
    expect(line(page, "north")).to_contain_text("connected")
    console.kill()
    expect(page.locator("#connection")).to_have_text("connection lost, trying again")
    console.start()
    page.goto("about:blank")
    page.goto(console.address)
    expect(page.locator("#connection")).to_have_text("connected")
    expect(action(page, "south/fibonacci")).to_be_visible()
    page.goto(f"{console.url}/#servers")
    expect(line(page, "north")).to_contain_text("connected")


def test_all_robots_are_on_one_map_with_a_ground_and_one_that_goes_stays_where_it_was(
    page: Page, console: ConsoleProcess, north: RobotProcess
) -> None:
    for name in ("south", "north"):
        page.goto("about:blank")
        page.goto(f"{console.address}&/{name}/arm/drive")
        expect(page.get_by_role("heading", name=f"{name}/arm/drive")).to_be_visible()
        page.get_by_label("gear").select_option("fast" if name == "south" else "slow")
        send(page)
    action(page, "Map").click()
    expect(line(page, "south/arm/drive")).to_contain_text(re.compile("2, 1.*succeeded"))
    expect(line(page, "north/arm/drive")).to_contain_text("executing")
    drawn = page.get_by_role("img", name=re.compile(r"^From above \(m\): position"))
    expect(drawn).to_be_visible()

    page.get_by_text("Image as the ground").click()
    before = drawn.evaluate("canvas => canvas.toDataURL()")
    picture = FilePayload(name="hall.png", mimeType="image/png", buffer=png((9, 200, 9), 100))
    page.get_by_label("Image", exact=True).set_input_files(picture)
    green = """() => {
      const canvas = document.querySelector(".plane canvas");
      if (!canvas?.width) return false;
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
      return data.some((one, at) => at % 4 === 1 && one > data[at - 1] + 90);
    }"""
    page.wait_for_function(green)
    assert drawn.evaluate("canvas => canvas.toDataURL()") != before
    wrong = FilePayload(name="a.txt", mimeType="text/plain", buffer=b"no image")
    page.get_by_label("Image", exact=True).set_input_files(wrong)
    expect(page.get_by_role("alert")).to_contain_text("a.txt is not an image")

    os.kill(north.pid, signal.SIGSTOP)
    expect(line(page, "north/arm/drive")).to_contain_text("was executing")
    os.kill(north.pid, signal.SIGCONT)
    expect(line(page, "north/arm/drive")).not_to_contain_text("was executing")
    north.kill()
    north.start()
    expect(line(page, "north/arm/drive")).to_contain_text("unknown")
    page.get_by_label("Search robots").fill("south")
    expect(line(page, "north/arm/drive")).to_have_count(0)
    page.reload()
    page.wait_for_function(green)
    is_accessible(page)
    fits(page, 390)
    line(page, "south/arm/drive").get_by_role("link").click()
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")


# Of what a person is told


def test_an_aborted_goal_is_told_in_the_title_and_as_a_notification_if_they_are_wanted(
    page: Page, robot: RobotProcess
) -> None:
    page.add_init_script(
        """window.told = [];
        window.Notification = class extends EventTarget {
          static permission = "granted";
          static requestPermission = async () => "granted";
          constructor(text, { body }) { super(); window.told.push([text, body]); }
        };
        window.AudioContext = class {
          constructor() { window.told.push("beep"); throw new Error("there is no sound here"); }
        };"""
    )
    page.add_init_script("document.hasFocus = () => false")
    open_action(page, robot, "break")
    send(page, order="3")
    expect(page).to_have_title("(1) break · fibaction console")
    page.get_by_role("button", name="Settings").click()
    page.get_by_label("By a notification of the system").check()
    page.get_by_label("In the title of the page").uncheck()
    page.keyboard.press("Escape")
    first = send(page, order="3")
    expect(goal(page).locator(".badge")).to_have_text("✕ aborted")
    expect(page).to_have_title("break · fibaction console")
    page.wait_for_function("window.told.length === 1")
    assert page.evaluate("window.told") == [
        [f"break: goal {first} was aborted", "the arm is stuck"]
    ]


def test_times_are_told_in_utc_if_that_is_wanted_and_it_is_remembered(
    page: Page, robot: RobotProcess
) -> None:
    open_action(page, robot)
    send(page, order="3")
    expect(goal(page).locator(".facts")).not_to_contain_text("UTC")
    page.get_by_role("button", name="Settings").click()
    is_accessible(page)
    fits(page, 390)
    page.get_by_label("Times in").select_option("UTC")
    page.keyboard.press("Escape")
    times = re.compile(r"\d\d:\d\d:\d\d UTC")
    expect(goal(page).locator(".facts")).to_contain_text(times)
    expect(page.locator(".goals .time").first).to_contain_text(times)
    page.reload()
    expect(goal(page).locator(".facts")).to_contain_text(times)


def test_a_page_without_a_first_connection_says_so(page: Page, robot: RobotProcess) -> None:
    page.route_web_socket(re.compile(".*"), lambda socket: None)
    page.goto(robot.url)
    expect(page.get_by_text("There is no connection to 127.0.0.1")).to_be_visible()
    expect(page.get_by_role("navigation")).to_contain_text("Not connected yet.")
    expect(page.locator("#connection")).to_have_text("connecting")


# Charts


def test_one_cursor_is_in_all_charts(page: Page, robot: RobotProcess) -> None:
    drive(page, robot)
    values = goal(page).locator(".charts b")
    newest = values.all_inner_texts()
    goal(page).get_by_role("img", name="Chart of battery").hover(position={"x": 90, "y": 40})
    expect(values.last).not_to_have_text(newest[-1])
    page.mouse.move(0, 0)
    expect(values.last).to_have_text(newest[-1])


def test_a_camera_is_beside_the_charts_and_shows_the_time_of_the_cursor(
    page: Page, robot: RobotProcess
) -> None:
    open_action(page, robot, "patrol")
    page.get_by_label("goal", exact=True).fill("0.1")
    send(page)
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
    camera = goal(page).get_by_role("img", name="Image camera of the feedback")
    red = "canvas => canvas.getContext('2d').getImageData(2, 2, 1, 1).data[0]"
    chart = goal(page).get_by_role("img", name="Chart of battery")
    left, right = chart.bounding_box(), camera.bounding_box()
    assert left is not None
    assert right is not None
    assert right["x"] > left["x"] + left["width"]
    begin, width = 52, left["width"] - 62  # of the axis
    for share, shown in ((0.2, 0), (0.75, 100), (1.01, 200)):
        chart.hover(position={"x": begin + share * width, "y": 40})
        arg = [camera.element_handle(), shown]
        page.wait_for_function(f"([canvas, shown]) => ({red})(canvas) === shown", arg=arg)
