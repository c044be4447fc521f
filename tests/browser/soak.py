"""Measures the console in a browser: `python -m tests.browser.soak [--seconds 600] [--tabs 10]`.

It prints the time of the first paint, the frames in a second at 1,000 feedback messages a second,
the memory of one tab over the time, and the memory of the server with many tabs.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from playwright.sync_api import Browser, Page, sync_playwright

from tests.browser.conftest import CHROMIUM
from tests.browser.served import RobotProcess

FRAMES = """() => new Promise(resolve => {
    let frames = 0;
    const begin = performance.now();
    const count = now => {
        frames += 1;
        if (now - begin < 5000) requestAnimationFrame(count);
        else resolve(frames * 1000 / (now - begin));
    };
    requestAnimationFrame(count);
})"""
PAINT = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime ?? 0"
SAMPLES = 10
"""Samples of memory over the whole time."""


def memory_of(pid: int) -> float:
    """Return the resident memory of a process, in MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def heap_of(page: Page) -> float:
    """Return the memory of the objects of a page, after a collection, in MB."""
    client = page.context.new_cdp_session(page)
    client.send("HeapProfiler.collectGarbage")
    used: float = client.send("Runtime.getHeapUsage")["usedSize"]
    client.detach()
    return used / 1e6


def send_flood(page: Page, robot: RobotProcess, rate: int, seconds: float) -> None:
    """Send a goal with much feedback."""
    page.goto(f"{robot.url}/#/flood")
    page.get_by_label("rate 1/s").fill(str(rate))
    page.get_by_label("seconds").fill(str(seconds))
    page.get_by_role("button", name="Send goal").click()
    page.locator(".goal .badge.executing").wait_for()


def count_of(page: Page) -> int:
    """Return the number of feedback messages that a page shows."""
    return int(page.locator(".feedback h3").inner_text().split()[1])


def measure_frames(browser: Browser, robot: RobotProcess) -> None:
    """Print the first paint, and the frames at 1,000 feedback messages a second."""
    page = browser.new_page(viewport={"width": 1280, "height": 860})
    page.goto(robot.url)
    page.get_by_role("link", name="flood").wait_for()
    print(f"first paint: {page.evaluate(PAINT):.0f} ms after the begin of the navigation")
    send_flood(page, robot, 1000, 12)
    begin, before = time.monotonic(), count_of(page)
    frames = page.evaluate(FRAMES)
    rate = (count_of(page) - before) / (time.monotonic() - begin)
    print(f"frames: {frames:.1f} a second, at {rate:.0f} feedback messages a second")
    page.close()


def measure_memory(browser: Browser, robot: RobotProcess, seconds: float) -> None:
    """Print the memory of one tab while goals with much feedback come and go."""
    page = browser.new_page(viewport={"width": 1280, "height": 860})
    for sample in range(SAMPLES):
        part = seconds / SAMPLES
        send_flood(page, robot, 1000, max(part - 1, 1))
        page.locator(".goal .badge.succeeded").wait_for(timeout=(part + 30) * 1000)
        print(f"tab: {heap_of(page):.1f} MB after {(sample + 1) * part:.0f} s")
    page.close()


def measure_server(browser: Browser, robot: RobotProcess, tabs: int, seconds: float) -> None:
    """Print the memory of the server with many tabs that follow the same goal."""
    print(f"server: {memory_of(robot.pid):.1f} MB before the tabs")
    first = browser.new_page()
    send_flood(first, robot, 200, seconds + 30)
    address = first.url
    others = [browser.new_page() for _ in range(tabs - 1)]
    for page in others:
        page.goto(address)
        page.locator(".goal .badge.executing").wait_for()
    for sample in range(SAMPLES):
        first.wait_for_timeout(1000 * seconds / SAMPLES)
        used, passed = memory_of(robot.pid), (sample + 1) * seconds / SAMPLES
        print(f"server: {used:.1f} MB with {tabs} tabs after {passed:.0f} s")
    for page in (first, *others):
        page.close()


def main() -> None:
    """Measure everything, and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600, help="of each measure of memory")
    parser.add_argument("--tabs", type=int, default=10)
    options = parser.parse_args()
    with RobotProcess() as robot, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        measure_frames(browser, robot)
        measure_memory(browser, robot, options.seconds)
        measure_server(browser, robot, options.tabs, options.seconds)
        browser.close()


if __name__ == "__main__":
    main()
