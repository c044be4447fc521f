"""Topics of a robot beside its goals, in a real browser."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Generator

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from tests.browser.pages import goal, is_accessible, send
from tests.browser.served import ConsoleProcess, RosRobotProcess
from tests.support.ros_domain import own_domain


@pytest.fixture
def robot(browser: Browser) -> Generator[RosRobotProcess, None, None]:
    with own_domain(), RosRobotProcess() as running:
        yield running


@pytest.fixture
def console(robot: RosRobotProcess) -> Generator[ConsoleProcess, None, None]:
    with ConsoleProcess(f"arm={robot.url}", "base=dds://") as running:
        yield running


def topic(page: Page, name: str) -> Locator:
    return page.get_by_role("region", name=f"Topic {name}", exact=True)


def until_another(page: Page, shown: Locator) -> None:
    """Wait until another message is shown."""
    before = shown.inner_text()
    expect(shown).not_to_have_text(before)


def test_a_topic_is_beside_a_goal_if_its_action_names_it_or_a_person_adds_it(
    page: Page, console: ConsoleProcess, robot: RosRobotProcess
) -> None:
    page.goto(f"{console.address}&/arm/move")
    expect(page.get_by_role("heading", name="arm/move")).to_be_visible()
    send(page)
    camera = topic(page, "base/camera/image")
    expect(camera.get_by_role("img", name="Image image of the topic")).to_be_visible()
    until_another(page, camera.get_by_label("Latest message of"))

    choice = goal(page).get_by_label("Add a topic")
    choice.focus()
    expect(choice).to_contain_text("base/odom (nav_msgs/msg/Odometry)")
    choice.select_option("base/odom")
    odom = topic(page, "base/odom")
    expect(odom.get_by_role("img", name=re.compile("From above.*pose"))).to_be_visible()
    is_accessible(page)

    latest = odom.get_by_label("Latest message of")
    os.kill(robot.pid, signal.SIGSTOP)
    before = ""
    while before != (before := latest.inner_text()):
        page.wait_for_timeout(200)  # what was on its way
    os.kill(robot.pid, signal.SIGCONT)
    expect(latest).not_to_have_text(before)
    robot.kill()
    robot.start()
    until_another(page, latest)

    page.reload()
    until_another(page, topic(page, "base/odom").get_by_label("Latest message of"))
    camera.get_by_role("button", name="Remove").click()
    expect(camera).to_have_count(0)
    expect(odom).to_be_visible()


def test_a_topic_with_a_pose_is_on_the_map(page: Page, console: ConsoleProcess) -> None:
    page.goto(console.address)
    page.get_by_role("navigation").get_by_role("link", name="Map").click()
    choice = page.get_by_label("Add a topic")
    choice.focus()
    expect(choice).to_contain_text("base/odom (nav_msgs/msg/Odometry)")
    choice.select_option("base/odom")
    robot = page.get_by_role("row").filter(has=page.get_by_role("rowheader", name="base/odom"))
    expect(robot).to_contain_text("topic")
    until_another(page, robot)
