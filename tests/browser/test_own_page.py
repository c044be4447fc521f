"""The page of docs/howto/with_curl.md in a real browser, as a reader writes it."""

from __future__ import annotations

import functools
import shutil
import threading
from collections.abc import Callable, Generator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.browser.served import ROOT, RobotProcess
from tests.support.pages import blocks_of

GUIDE = ROOT / "docs/howto/with_curl.md"
CLIENT = Path(str(files("fibaction_transports.web"))) / "javascript" / "fibaction.js"


class Quiet(SimpleHTTPRequestHandler):
    """A server of files that writes no log."""

    def log_message(self, format: str, *args: object) -> None:
        """Write nothing."""


@pytest.fixture
def site(tmp_path: Path) -> Generator[str, None, None]:
    """Serve the folder of the reader, and return its address."""
    handler = functools.partial(Quiet, directory=str(tmp_path))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def open_page(page: Page, folder: Path, site: str, robot: RobotProcess) -> None:
    """Open the page of the guide, which asks a robot."""
    [code] = [one.code for one in blocks_of(GUIDE.read_text()) if one.language == "html"]
    assert "ws://127.0.0.1:8080" in code
    code = code.replace("ws://127.0.0.1:8080", robot.url.replace("http", "ws"))
    (folder / "page.html").write_text(code)
    shutil.copy(CLIENT, folder)
    page.goto(f"{site}/page.html")


def test_the_page_sends_follows_and_goes_on_after_the_server_was_away(
    page: Page, tmp_path: Path, site: str, new_robot: Callable[..., RobotProcess]
) -> None:
    robot = new_robot(f"?origins={site}")
    open_page(page, tmp_path, site, robot)
    expect(page).to_have_title("Robot: ready")
    page.get_by_role("button", name="Send").click()
    expect(page.locator("#text")).to_have_text("SUCCEEDED 0,1,1,2,3,5,8,13,21,34,55")
    robot.kill()
    expect(page).to_have_title("Robot: lost")
    robot.start()
    expect(page).to_have_title("Robot: ready")
    page.locator("#text").evaluate("text => text.replaceChildren()")
    page.get_by_role("button", name="Send").click()
    expect(page.locator("#text")).to_have_text("SUCCEEDED 0,1,1,2,3,5,8,13,21,34,55")


def test_the_page_cancels(
    page: Page, tmp_path: Path, site: str, new_robot: Callable[..., RobotProcess]
) -> None:
    robot = new_robot(f"?origins={site}")
    open_page(page, tmp_path, site, robot)
    source = tmp_path / "page.html"
    source.write_text(source.read_text().replace("order: 10", "order: 1000"))
    page.reload()
    page.get_by_role("button", name="Send").click()
    expect(page.locator("#text")).to_contain_text("0,1,1")
    page.get_by_role("button", name="Cancel").click()
    expect(page.locator("#text")).to_have_text("CANCELED ")
