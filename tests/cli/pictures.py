"""Pictures of what people see in a terminal, for people to look at.

    python -m tests.cli.pictures [--light] [FOLDER]

It runs a server, and the commands in terminals of 80 and of 100 columns, and draws as SVG what is
on them then: into docs/cli/, unless another folder is named. The server is at the usual port, so
nobody else may be.
"""

from __future__ import annotations

import re
import sys
from collections.abc import AsyncGenerator, Generator, Iterable, Iterator
from contextlib import closing, contextmanager
from html import escape
from itertools import groupby
from math import hypot
from pathlib import Path
from typing import Any, TypeAlias

import anyio
import msgspec
import pyte
from pyte.screens import Char

from fibaction import Action, ActionServer, GoalAborted, GoalHandle
from tests.cli.conftest import Terminal, start_command
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.support.processes import ended, lines_until

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "cli"
URL = "tcp://127.0.0.1:7400"
WIDTHS = (80, 100)
LINES = 12
CELL = (8.43, 18)
"""Points that a letter is wide and a line is high, for letters of 14 points."""
EDGE = 10

Colors: TypeAlias = "dict[str, str]"
DARK = {
    "text": "#d0d0d0",
    "background": "#1b1d23",
    "black": "#3b3f4a",
    "red": "#e06c75",
    "green": "#98c379",
    "brown": "#e5c07b",
    "blue": "#61afef",
    "magenta": "#c678dd",
    "cyan": "#56b6c2",
    "white": "#d0d0d0",
}
LIGHT = {
    "text": "#202020",
    "background": "#ffffff",
    "black": "#000000",
    "red": "#cd0000",
    "green": "#00a000",
    "brown": "#a08000",
    "blue": "#0000ee",
    "magenta": "#cd00cd",
    "cyan": "#009090",
    "white": "#b0b0b0",
}
"""What the terminals of the day make of the colours that have names."""

# What is looked at


class Place(msgspec.Struct):
    x: float
    y: float


class Drive(msgspec.Struct):
    to: Place
    speed: float = 0.5


class Driving(msgspec.Struct):
    progress: float
    position: Place
    obstacle: str


class Arrived(msgspec.Struct):
    position: Place


class Pick(msgspec.Struct):
    object_name: str


class Picking(msgspec.Struct):
    step: str
    force: float


class Picked(msgspec.Struct):
    grasped: bool


DRIVE = Action(
    "base/drive_to", goal=Drive, feedback=Driving, result=Arrived, type_name="base/action/DriveTo"
)
PICK = Action("arm/pick", goal=Pick, feedback=Picking, result=Picked, type_name="arm/action/Pick")


async def drive(goal: GoalHandle[Drive]) -> AsyncGenerator[Driving | Arrived, None]:
    """Drive straight, ten times a second a bit."""
    to, speed = goal.request.to, goal.request.speed
    steps = max(int(hypot(to.x, to.y) / speed * 10), 1)
    for step in range(1, steps + 1):
        await anyio.sleep(0.1)
        done = step / steps
        yield Driving(
            round(done, 3),
            Place(round(to.x * done, 2), round(to.y * done, 2)),
            "none" if step % 30 else "füñf 鳥",
        )
    yield Arrived(to)


async def pick(goal: GoalHandle[Pick]) -> AsyncGenerator[Picking | Picked, None]:
    for step in ("approach", "open", "grasp", "lift"):
        yield Picking(step, 0.25)
        await anyio.sleep(0.05)
    if goal.request.object_name == "ghost":
        raise GoalAborted("there is no ghost")
    yield Picked(True)


async def fibonacci(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    sequence = [0, 1]
    for _ in range(1, goal.request.order):
        sequence.append(sequence[-1] + sequence[-2])
        yield Feedback(sequence)
        await anyio.sleep(0.7)
    yield Result(sequence)


def servers() -> list[ActionServer[Any, Any, Any]]:
    """What `fibaction serve` serves for the pictures."""
    return [
        ActionServer(DRIVE, drive, result_timeout=3600),
        ActionServer(PICK, pick, result_timeout=3600),
        ActionServer(FIBONACCI, fibonacci, result_timeout=3600),
    ]


# The terminal, and how it is drawn


class _Faint(pyte.HistoryScreen):
    """A screen that knows faint letters, too: they blink, which nothing else here does."""

    def select_graphic_rendition(self, *attributes: int, **settings: Any) -> None:
        told = list(attributes)
        known: list[int] = []
        while told:
            if told[0] in (38, 48):  # a colour, whose numbers are no attributes
                count = {2: 5, 5: 3}[told[1]]
                known += told[:count]
                del told[:count]
            else:
                one = told.pop(0)
                known += {2: [5], 22: [22, 25]}.get(one, [one])
        super().select_graphic_rendition(*known, **settings)


class Drawn(Terminal):
    """A terminal that can be drawn."""

    screen_type = _Faint

    def svg(self, colors: Colors) -> str:
        """What is on the screen now."""
        screen = self._screen
        cells = [[screen.buffer[y][x] for x in range(screen.columns)] for y in range(screen.lines)]
        width, height = screen.columns * CELL[0] + 2 * EDGE, screen.lines * CELL[1] + 2 * EDGE
        parts = [part for y, row in enumerate(cells) for part in _drawn(row, y, colors)]
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height}"'
            f' font-family="DejaVu Sans Mono, Menlo, Consolas, monospace" font-size="14">'
        )
        edge = (
            f'<rect width="{width:g}" height="{height}" rx="6" fill="{colors["background"]}"/>'
            f'<g transform="translate({EDGE} {EDGE})">'
        )
        return "\n".join([head, edge, *parts, "</g>", "</svg>", ""])


def _drawn(row: Iterable[Char], y: int, colors: Colors) -> Iterator[str]:
    """The parts of one line: each is what looks the same."""
    across, down = CELL
    for look, places in groupby(enumerate(row), lambda place: place[1]._replace(data="")):
        cells = list(places)
        begin = cells[0][0]
        color, behind = _color(look.fg, colors, "text"), _color(look.bg, colors, "background")
        if look.reverse:
            color, behind = behind, color
        if behind != colors["background"]:
            yield (
                f'<rect x="{begin * across:g}" y="{y * down}" width="{len(cells) * across:g}"'
                f' height="{down}" fill="{behind}"/>'
            )
        weight = ' font-weight="bold"' if look.bold else ""
        faint = ' opacity="0.6"' if look.blink else ""
        # An empty cell is behind a wide letter, so that each letter is counted with its width.
        text = "".join(cell.data or "\0" for _, cell in cells)
        for word in re.finditer(r"[^ ]+(?: [^ ]+)*", text):
            yield (
                f'<text x="{(begin + word.start()) * across:g}" y="{y * down + 14}"'
                f' fill="{color}"{weight}{faint} textLength="{len(word[0]) * across:g}">'
                f"{escape(word[0].replace(chr(0), ''))}</text>"
            )


def _color(name: str, colors: Colors, default: str) -> str:
    if name == "default":
        return colors[default]
    return colors.get(name) or f"#{name}"


# The pictures


def pictures(columns: int, colors: Colors) -> Iterator[tuple[str, str]]:
    """Each picture and its name, while there is something to see."""
    say("base/drive_to", "to: {x: 60, y: 25}")
    with opened("send_goal", "base/drive_to", "to: {x: 2, y: 1}", "-f", columns=columns) as line:
        line.until(r"[4-9]\d%")
        yield "send_goal", line.svg(colors)
    say("arm/pick", "object_name: cup")
    say("arm/pick", "object_name: ghost")
    with opened("send_goal", "fibonacci", "order: 46", "-f", columns=columns) as line:
        line.until(r"feedback 8")
        yield "send_goal_line", line.svg(colors)
        with opened("goals", "--watch", columns=columns) as goals:
            goals.until(r"2 active")
            yield "goals", goals.svg(colors)
        for speed in (2, 3, 5):
            say("base/drive_to", f"{{to: {{x: 25, y: 40}}, speed: {speed}}}")
        for thing in ("plate", "fork", "ghost"):
            say("arm/pick", f"object_name: {thing}")
        with opened("top", columns=columns, lines=34) as top:
            top.until(r"base/drive_to .* [3-9]\d% .* position")
            top.press("\x1b[A" * 11 + "f")  # the cursor may be at a goal that was there before
            top.until(r"^ *speed: 5")
            yield "top", top.svg(colors)


def say(*goal: str) -> None:
    """Send a goal that goes on by itself."""
    done = ended(start_command("send_goal", *goal, "--detach", url=URL))
    assert done.code == 0, done.err


@contextmanager
def opened(*arguments: str, columns: int, lines: int = LINES) -> Generator[Drawn]:
    """The command in a terminal, until the end of the block."""
    colorful = {"COLORTERM": "truecolor"}
    with closing(
        Drawn(*arguments, url=URL, env=colorful, columns=columns, lines=lines)
    ) as terminal:
        yield terminal


def main() -> None:
    """Draw all pictures; with `--light`, as they look on a light background."""
    folders = [Path(argument) for argument in sys.argv[1:] if argument != "--light"]
    colors = LIGHT if "--light" in sys.argv else DARK
    for columns in WIDTHS:
        server = start_command("serve", "tests.cli.pictures:servers", URL)
        try:
            lines_until("serving", server)
            for name, picture in pictures(columns, colors):
                path = (folders or [FOLDER])[0] / f"{name}_{columns}.svg"
                path.write_text(picture, encoding="utf-8")
        finally:
            server.kill()
            ended(server)


if __name__ == "__main__":
    main()
