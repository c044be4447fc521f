"""Pictures of the console for the pages, taken from a real browser.

    python docs/console_pictures.py

A robot is served, goals are sent by hand as it were, and docs/console/ gets the pictures. They
differ each time by the IDs of the goals and the times, so look at them before you commit them.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import Browser, Page, sync_playwright

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docs" / "console"
sys.path.insert(0, str(ROOT))

from tests.browser.conftest import CHROMIUM  # noqa: E402  # the tests are not installed
from tests.browser.served import ArchiveProcess, ConsoleProcess, RobotProcess  # noqa: E402


def send(page: Page, action: str, fields: dict[str, str]) -> None:
    """Send a goal by the form."""
    page.get_by_role("navigation").get_by_role("link", name=action).click()
    page.get_by_role("heading", name=action, exact=True).wait_for()
    before = page.locator(".goals tbody tr").count()
    for name, value in fields.items():
        page.get_by_label(name, exact=True).fill(value)
    page.get_by_role("button", name="Send goal").click()
    page.locator(".goals tbody tr").nth(before).wait_for()


def fill_history(page: Page) -> None:
    """Send goals that end in all ways."""
    send(page, "break", {"order": "3"})
    page.locator(".goal .badge.aborted").wait_for()
    for room in ("kitchen", "hall", "workshop"):
        send(page, "clean", {"room": room, "minutes": "2"})
    send(page, "arm/drive", {"x m": "1", "y m": "3"})
    page.get_by_role("button", name="Cancel goal").click()
    page.get_by_role("button", name="Cancel the goal").click()
    page.locator(".goal .badge.canceled").wait_for()
    page.get_by_label("gear").select_option("fast")
    send(page, "arm/drive", {"x m": "1.5", "y m": "-0.5"})
    page.locator(".goal .badge.succeeded").wait_for()
    page.get_by_label("gear").select_option("normal")


def until_message(page: Page, numbers: str) -> None:
    """Wait until a feedback message has come, whose number is like that."""
    shown = "wanted => new RegExp(wanted).test(document.querySelector('.feedback h3')?.textContent)"
    page.wait_for_function(shown, arg=f"^Feedback: ({numbers}) ")  # looks at each frame


def take(browser: Browser, robot: RobotProcess) -> None:
    """Take all pictures."""
    page = browser.new_page(viewport={"width": 1280, "height": 960}, device_scale_factor=1.25)
    page.goto(robot.url)
    fill_history(page)
    for theme in ("light", "dark"):
        page.emulate_media(color_scheme=theme)
        send(page, "arm/drive", {"x m": "2", "y m": "1"})
        until_message(page, r"3[5-9]")
        page.screenshot(path=FOLDER / f"goal_{theme}.png")
    page.emulate_media(color_scheme="light")
    page.get_by_role("link", name="All actions").click()
    page.locator(".goals .badge.executing").first.wait_for()
    page.screenshot(path=FOLDER / "all_actions.png")
    page.close()
    phone = browser.new_page(viewport={"width": 390, "height": 800}, device_scale_factor=1.5)
    phone.goto(f"{robot.url}/#/arm/drive")
    phone.get_by_role("heading", name="arm/drive", exact=True).wait_for()
    send(phone, "arm/drive", {"x m": "2", "y m": "1"})
    until_message(phone, "3.")
    phone.screenshot(path=FOLDER / "phone.png")
    phone.close()


def take_list(browser: Browser, archive: RobotProcess) -> None:
    """Take the picture of a list with a history."""
    page = browser.new_page(viewport={"width": 1280, "height": 800}, device_scale_factor=1.25)
    columns = "state,request.order,request.color,labels,reason,ran,time"
    page.goto(f"{archive.url}/#/paint?state=not+succeeded&sort=-ran&columns={columns}")
    page.get_by_text("23 goals.").wait_for()
    for place in (0, 2, 3):
        page.locator(".goals tbody tr").nth(place).get_by_role("checkbox").check()
    page.locator(".list").evaluate("one => window.scrollTo(0, one.offsetTop - 70)")
    page.screenshot(path=FOLDER / "goal_list.png")
    page.close()


def take_room(browser: Browser, robots: dict[str, RobotProcess]) -> None:
    """Take the pictures of several servers, of which one has gone: servers, map and numbers."""
    page = browser.new_page(viewport={"width": 1280, "height": 800}, device_scale_factor=1.25)
    with ConsoleProcess(*(f"{name}={robot.url}" for name, robot in robots.items())) as console:
        page.goto(console.address)
        for name, x, y in (("arm1", "2", "1"), ("arm2", "3.5", "-0.5"), ("arm3", "1", "-1.5")):
            send(page, f"{name}/arm/drive", {"x m": x, "y m": y})
            page.locator(".goal .badge.executing").wait_for()
        page.locator(".goal .badge.succeeded").wait_for()
        send(page, "arm2/clean", {"room": "hall", "minutes": "2"})
        robots["arm3"].kill()
        open_view(page, "Servers")
        page.locator(".badge.away").wait_for()
        page.screenshot(path=FOLDER / "servers.png")
        open_view(page, "Map")
        page.get_by_role("rowheader", name="arm3/arm/drive").wait_for()
        page.screenshot(path=FOLDER / "map.png")
        page.goto(f"{console.url}/#/painter/")
        page.get_by_text("Numbers", exact=True).click()
        page.get_by_role("heading", name="Why goals were aborted").wait_for()
        page.screenshot(path=FOLDER / "numbers.png")
    page.close()


def open_view(page: Page, name: str) -> None:
    """Open a view that is not about actions."""
    page.get_by_role("navigation").get_by_role("link", name=name).click()
    page.get_by_role("heading", name=name, exact=True).wait_for()


def main() -> None:
    """Take all pictures, and write them."""
    FOLDER.mkdir(exist_ok=True)
    with ExitStack() as stack:
        robot = stack.enter_context(RobotProcess())
        folder = stack.enter_context(TemporaryDirectory())
        archive = stack.enter_context(ArchiveProcess(Path(folder)))
        playwright = stack.enter_context(sync_playwright())
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        take(browser, robot)
        take_list(browser, archive)
        arms = {f"arm{number}": stack.enter_context(RobotProcess()) for number in (1, 2, 3)}
        take_room(browser, {**arms, "painter": archive})
        browser.close()


if __name__ == "__main__":
    main()
