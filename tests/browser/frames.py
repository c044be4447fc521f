"""Frames of the console with many goals, and what each costs: `python -m tests.browser.frames`.

The server has 10,000 goals in its history and 300 active ones, which the page shows with 300 rows.
Names of folders after the command are other consoles, each measured in turn with the one here: such
as that of an earlier commit, from `git worktree add /tmp/before COMMIT`.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import cast

from playwright.sync_api import Browser, Page, Route, expect, sync_playwright

from tests.browser.conftest import CHROMIUM
from tests.browser.served import RobotProcess

PAST = 10_000
ACTIVE = 300
SECONDS = 4
ROUNDS = 5
CONSOLE = "transports/fibaction_transports/web/console"
COUNT = """
    (seconds) => new Promise((done) => {
        const began = performance.now();
        let frames = 0;
        const next = () => {
            frames += 1;
            const past = performance.now() - began;
            if (past < 1000 * seconds) {
                requestAnimationFrame(next);
            } else {
                done(1000 * frames / past);
            }
        };
        requestAnimationFrame(next);
    })
"""
COSTS = {
    "ScriptDuration": "script",
    "LayoutDuration": "layout",
    "RecalcStyleDuration": "style",
    "TaskDuration": "all",
}


class CrowdProcess(RobotProcess):
    """A process of a robot with many goals."""

    def __init__(self, folder: Path, past: int = PAST, active: int = ACTIVE) -> None:
        super().__init__()
        self._arguments = [str(folder / "goals.db"), str(past), str(active)]

    def program(self) -> list[str]:
        """Return the module to run, and its arguments."""
        return ["tests.browser.crowd", self.url, *self._arguments]


def opened(browser: Browser, robot: RobotProcess, console: Path | None) -> Page:
    """Open a page of the list, with the files of a console."""
    page = browser.new_page(viewport={"width": 1280, "height": 860})

    def answer(route: Route) -> None:
        assert console is not None
        file = console / route.request.url.split("/console/")[1].split("?")[0]
        route.fulfill(path=file)

    if console is not None:
        page.route("**/console/*", answer)
    page.goto(f"{robot.url}/#/pick?rows=300")
    running = page.locator(".goals tbody .badge", has_text="executing")
    expect(running).to_have_count(ACTIVE, timeout=60_000)
    sent = page.locator(".goals tbody .request", has_text="things:")
    expect(sent).to_have_count(ACTIVE, timeout=60_000)  # from now on the page only follows
    return page


def measured(page: Page) -> dict[str, float]:
    """Count frames for some seconds; return them a second, and milliseconds of each part of one."""
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable")

    def costs() -> dict[str, float]:
        metrics = session.send("Performance.getMetrics")["metrics"]
        return {one["name"]: float(one["value"]) for one in metrics}

    before = costs()
    rate = cast(float, page.evaluate(COUNT, SECONDS))
    after = costs()
    frames = rate * SECONDS
    each = {text: 1000 * (after[name] - before[name]) / frames for name, text in COSTS.items()}
    return {"frames/s": rate, **each}


def main(folders: list[str]) -> None:
    """Measure the console here and those of other folders in turns, and print the medians."""
    consoles: dict[str, Path | None] = {"here": None}
    consoles |= {folder: Path(folder) / CONSOLE for folder in folders}
    told: dict[str, list[dict[str, float]]] = {name: [] for name in consoles}
    with (
        tempfile.TemporaryDirectory() as folder,
        CrowdProcess(Path(folder)) as robot,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for _ in range(ROUNDS):
            for name, console in consoles.items():
                page = opened(browser, robot, console)
                told[name].append(measured(page))
                page.close()
        browser.close()
    print(f"{PAST} goals of the past, {ACTIVE} active, {ROUNDS} rounds of {SECONDS} s; ms a frame")
    for name, rounds in told.items():
        numbers = {part: median(one[part] for one in rounds) for part in rounds[0]}
        text = ", ".join(f"{part} {number:.2f}" for part, number in numbers.items())
        least = min(one["frames/s"] for one in rounds)
        print(f"{name}: {text}; least {least:.1f} frames/s")


if __name__ == "__main__":
    main(sys.argv[1:])
