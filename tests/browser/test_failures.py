"""Each page of the console while the robot, the console itself or the broker is killed or frozen.

All pages are open at once, so each failure is made once. Of a robot behind a bridge, of servers and
of a fleet the tests beside this one show more.
"""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager
from typing import NamedTuple

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect

from tests.browser.pages import LONG, goal, line, row, rows, send
from tests.browser.served import BridgeProcess, ConsoleProcess, RobotProcess, WorkerProcess
from tests.support.nats_server import IS_LEFT_OUT, NatsServer, nats_server

AT_ONCE = 3000
"""Milliseconds within which a page refuses to send to a server that is known to be away."""


COUNT_LINES = """
    () => {
      const texts = document.createTreeWalker(document.querySelector(".bar"), NodeFilter.SHOW_TEXT);
      const middles = [];
      const range = document.createRange();
      while (texts.nextNode()) {
        range.selectNodeContents(texts.currentNode);
        for (const { top, bottom } of range.getClientRects()) {
          const middle = (top + bottom) / 2;
          if (!middles.some((one) => Math.abs(one - middle) < 8)) middles.push(middle);
        }
      }
      return middles.length;
    }
"""
"""Counts the lines of the header."""


class Part(NamedTuple):
    """A process that fails, and the one whose page shows the robot."""

    served: RobotProcess
    process: RobotProcess | NatsServer

    def show(self, page: Page, view: str) -> None:
        """Open a view of the page, such as `/arm/fibonacci`."""
        if isinstance(self.served, ConsoleProcess):
            page.goto(self.served.address)  # whose token lasts as long as the tab
        page.goto(f"{self.served.url}/#{view}")

    def fail(self, how: str) -> None:
        if how == "kill":
            self.process.kill()
        else:
            os.kill(self.process.pid, signal.SIGSTOP)

    def recover(self, how: str) -> None:
        if how == "kill":
            self.process.start()
        else:
            os.kill(self.process.pid, signal.SIGCONT)


@contextmanager
def robot_part() -> Generator[Part, None, None]:
    with RobotProcess() as robot, ConsoleProcess(f"arm={robot.url}") as console:
        yield Part(console, robot)


@contextmanager
def console_part() -> Generator[Part, None, None]:
    with robot_part() as part:
        yield Part(part.served, part.served)


@contextmanager
def bridge_part() -> Generator[Part, None, None]:
    with RobotProcess() as robot, BridgeProcess(robot, "arm") as bridge:
        yield Part(bridge, bridge)


@contextmanager
def broker_part() -> Generator[Part, None, None]:
    if IS_LEFT_OUT:
        pytest.skip("nats-server is not installed")
    with nats_server() as broker:
        url = broker.url("arms")
        with WorkerProcess(f"{url}?worker=left"), ConsoleProcess(f"arm={url}") as console:
            yield Part(console, broker)


OWN_AWAY = re.compile("does not answer|connection lost")
WELL = "connected"
SERVER_AWAY = re.compile("(a server is|servers are) away")


class Case(NamedTuple):
    """A failure, and what the pages say of it and after it."""

    part: Callable[[], AbstractContextManager[Part]]
    how: str
    head: re.Pattern[str]
    """The head of each page."""
    server: str
    """The row of the server, in a list of servers."""
    after: str
    """The badge of the goal that ran, once all is well again; empty for any."""


CASES = {
    "robot-killed": Case(robot_part, "kill", SERVER_AWAY, "away since", "? unknown"),
    "robot-frozen": Case(robot_part, "freeze", SERVER_AWAY, "away since", "▶ executing"),
    "console-frozen": Case(console_part, "freeze", OWN_AWAY, "not known since", "▶ executing"),
    "bridge-killed": Case(bridge_part, "kill", OWN_AWAY, "", "▶ executing"),
    "broker-killed": Case(broker_part, "kill", SERVER_AWAY, "away since", ""),
    "broker-frozen": Case(broker_part, "freeze", SERVER_AWAY, "away since", ""),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_each_page_says_what_is_gone_sends_nothing_and_comes_back_by_itself(
    browser: Browser, context: BrowserContext, case: Case
) -> None:
    with case.part() as part:
        own, every, servers, robots = (context.new_page() for _ in range(4))
        for page, view in (
            (own, "/arm/fibonacci"),
            (every, "/"),
            (servers, "servers"),
            (robots, "map"),
        ):
            part.show(page, view)
        expect(own.get_by_role("heading", name="arm/fibonacci")).to_be_visible()
        running = send(own, order=LONG)
        own.get_by_text("Numbers", exact=True).click()
        numbers = own.locator(".numbers")
        expect(numbers.get_by_role("table")).to_contain_text("arm/fibonacci")
        for page in (own, every):
            expect(row(page, running).locator(".badge")).to_have_text("▶ executing")
        expect(robots.get_by_role("heading", name="Map")).to_be_visible()

        part.fail(case.how)
        if case.part is console_part:  # also before the page knows
            own.get_by_role("button", name="Send goal").click()
            expect(own.get_by_role("alert").first).to_contain_text("nothing was sent")
        for page in (own, every, robots, *([servers] if case.server else [])):
            expect(page.locator("#connection")).to_have_text(case.head)
        if case.head is SERVER_AWAY:
            expect(own.get_by_text("The server of arm/fibonacci is away since")).to_be_visible()
        own.set_viewport_size({"width": 390, "height": 844})
        assert own.evaluate(COUNT_LINES) == 2
        own.set_viewport_size({"width": 1280, "height": 860})
        for page in (own, every):
            expect(row(page, running).locator(".badge")).to_have_text("▶ was executing")
        if case.server:
            expect(line(servers, "arm")).to_contain_text(case.server)
        expect(numbers.locator(".note").last).to_contain_text("These are the numbers of")
        expect(numbers.get_by_role("table")).to_contain_text("arm/fibonacci")
        own.get_by_role("button", name="Send goal").click()
        expect(own.get_by_role("alert").first).to_contain_text("nothing was sent", timeout=AT_ONCE)

        part.recover(case.how)
        for page in (own, every, robots):
            expect(page.locator("#connection")).to_have_text(WELL)
        for page in (own, every):
            if case.after:
                expect(row(page, running).locator(".badge")).to_have_text(case.after)
        if case.after == "▶ executing":
            expect(goal(own).locator(".reason")).to_be_hidden()
            expect(row(page, running)).to_have_count(1)
        if case.server:
            expect(line(servers, "arm")).to_contain_text("connected")
        sent = send(own, order="3")
        for page in (own, every):
            expect(row(page, sent).locator(".badge")).to_have_text("✓ succeeded")
            expect(rows(page)).to_have_count(2)
