"""The console of a fleet in a real browser: its workers, and the one that has a goal."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from fibaction import __version__
from tests.browser.pages import LONG, action, fits, goal, is_accessible, line, row, send
from tests.browser.served import ConsoleProcess, WorkerProcess
from tests.support.nats_server import IS_LEFT_OUT, NatsServer

pytestmark = pytest.mark.skipif(IS_LEFT_OUT, reason="nats-server is not installed")


@pytest.fixture
def broker(browser: Browser, tmp_path: Path) -> Generator[NatsServer, None, None]:
    server = NatsServer(tmp_path / "broker").start()
    yield server
    server.kill()


def test_the_workers_of_a_fleet_are_listed_and_a_goal_tells_its_worker(
    page: Page, broker: NatsServer
) -> None:
    url = broker.url("arms", "?worker=left")
    with WorkerProcess(url), ConsoleProcess(f"fleet={broker.url('arms')}") as console:
        page.goto(console.address)
        action(page, "fleet/fibonacci").click()
        running = send(page, order=LONG)
        page.goto(f"{console.url}/#servers")
        worker = line(page, "left")
        expect(worker).to_contain_text("has room")
        expect(worker).to_contain_text(__version__)
        expect(worker).to_contain_text("1 goal")

        page.goto(f"{console.url}/#/fleet/fibonacci")
        expect(row(page, running)).to_be_visible()
        send(page, order="3")
        expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
        expect(goal(page)).to_contain_text("worker left")
        page.goto(f"{console.url}/#servers")
        is_accessible(page)
        fits(page, 390)
