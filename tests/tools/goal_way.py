"""The way of one goal: every call inside fibaction and its transports, in order.

`python -m tests.tools.goal_way` prints it in-process, over TCP, over `dds://`, and in-process with
a store, one line for each function that begins. `--figures` prints the figures only, `--modules`
the modules in the order of their calls.

How it is counted:

- A client sends one goal, reads its two feedback messages and its result, inside the block of
  `send_goal`. The same goal was sent directly before, so everything is warm; what the client still
  tells the server about that one counts as well, as it does in a series of goals. The count goes on
  until every task waits again. Both ends are in this process, over TCP on the loopback.
- A call is a `call` event of `sys.setprofile` in a file of the two packages. Python 3.11 has one
  when a function is called, when a coroutine or a generator is made, and each time when one
  resumes. Later versions have none when one is made, and comprehensions are no calls there, so
  figures of different versions cannot be compared.
- The modules are the files with a call; a change is a call in another file than the call before.
- On a busy machine messages arrive in parts, which adds calls, or together, which saves some; a
  heartbeat adds some. So the shortest way that several of many goals go counts.
- Over `dds://`, the clock stands still meanwhile, so no acknowledgement and no repeated list of
  statuses is due; before, everything that was due is waited for.
"""

from __future__ import annotations

import argparse
import dis
import gc
import inspect
import math
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from types import CodeType, FrameType
from typing import Any, NamedTuple

import anyio
from anyio.lowlevel import checkpoint

import fibaction
import fibaction_transports
from fibaction import ActionClient, ActionServer, SqliteStore
from fibaction.border.goal_store import GoalStore
from fibaction_transports.rtps import network
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.ros_domain import own_domain

DDS = "dds"
STORE = "in-process with a store"
WAYS = {
    "in-process": "inproc://goal-way",
    "TCP": "tcp://127.0.0.1:0",
    DDS: "dds://goal_way",
    STORE: "inproc://goal-way",
}
"""The URL that each way is served at."""
INTERFACES = Path(__file__).parents[2] / "examples" / "ros2"
"""The folder with the type of the action, for `dds://`."""
ORDER = 3
"""The goal whose executor sends two feedback messages."""
RUNS, AGREEING = 60, 8
"""The goals that are counted at most, and the number of goals that go a way that counts."""
DUE = 0.3
"""Seconds in which everything is sent that is due after a goal over `dds://`."""
QUIET_TURNS = 20
"""The turns of the event loop without a call after which a goal has gone its way."""

_GENERATORS = inspect.CO_COROUTINE | inspect.CO_GENERATOR | inspect.CO_ASYNC_GENERATOR
_PACKAGES = {
    str(Path(fibaction.__file__).parent): "fibaction",
    str(Path(fibaction_transports.__file__).parent): "transports/fibaction_transports",
}


class Step(NamedTuple):
    """A call."""

    module: str
    """The file, from the root of the repository."""
    function: str
    depth: int
    """The number of callers inside the packages."""
    begins: bool
    """True if the function begins here; False if it is only made, or resumes."""


class Figures(NamedTuple):
    calls: int
    modules: int
    changes: int


class Way(list[Step]):
    """The calls of one goal, in order."""

    @property
    def figures(self) -> Figures:
        modules = [step.module for step in self]
        changes = sum(one != other for one, other in pairwise(modules))
        return Figures(len(self), len(set(modules)), changes)

    def lines(self) -> Iterator[str]:
        """Yield a line for each function that begins, indented below its caller.

        Its module follows, if it is another one than that of the line before.
        """
        module = ""
        for step in self:
            if step.begins:
                function = f"{'  ' * step.depth}{step.function}"
                yield function if step.module == module else f"{function:<64}  {step.module}"
                module = step.module

    def module_lines(self) -> Iterator[str]:
        """Yield a line for each module, in the order of the first calls, with its calls."""
        for module, calls in Counter(step.module for step in self).items():
            yield f"{calls:4}  {module}"


@cache
def module_of(file: str) -> str:
    """Return a file of the packages from the root of the repository; empty for other files, and for
    the executor, which comes from `fibaction.testing` and stands for that of a user.
    """
    for folder, name in _PACKAGES.items():
        if file.startswith(f"{folder}/") and not file.startswith(f"{folder}/testing/"):
            return name + file.removeprefix(folder)
    return ""


@cache
def _start_of(code: CodeType) -> int:
    """Return the offset at which the body of a function begins."""
    return next(each.offset for each in dis.get_instructions(code) if each.opname == "RESUME")


def step_of(frame: FrameType) -> Step | None:
    """Describe the call of a frame; None if it is outside the packages."""
    code = frame.f_code
    module = module_of(code.co_filename)
    if not module:
        return None
    depth, caller = 0, frame.f_back
    while caller is not None:
        depth += bool(module_of(caller.f_code.co_filename))
        caller = caller.f_back
    is_generator = bool(code.co_flags & _GENERATORS)
    begins = not is_generator or 0 <= frame.f_lasti <= _start_of(code)
    return Step(module, code.co_qualname, depth, begins)


@contextmanager
def recorded() -> Generator[Way, None, None]:
    """Record the calls of this thread until the block ends."""
    way = Way()

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and (step := step_of(frame)) is not None:
            way.append(step)

    before, has_collected = sys.getprofile(), gc.isenabled()
    gc.disable()  # finalizers would be calls
    sys.setprofile(note)
    try:
        yield way
    finally:
        sys.setprofile(before)
        if has_collected:
            gc.enable()


async def send_goal(client: ActionClient[Goal, Feedback, Result]) -> None:
    """Send the goal, and read its feedback and its result."""
    received = 0
    async with client.send_goal(Goal(ORDER)) as goal:
        async for _ in goal.feedback:
            received += 1
        await goal.result()
    assert received == 2


async def settle(way: Way) -> None:
    """Wait until every task waits, and nothing comes over the line any more."""
    quiet, calls = 0, len(way)
    while quiet < QUIET_TURNS:
        await checkpoint()
        quiet = quiet + 1 if len(way) == calls else 0
        calls = len(way)


@contextmanager
def frozen_clock() -> Generator[None, None, None]:
    """Stop the clock of asyncio's event loops until the block ends, and let one turn take all that
    has arrived over `dds://`.
    """
    now, clock, turn = time.monotonic(), time.monotonic, network.TURN
    time.monotonic, network.TURN = lambda: now, math.inf
    try:
        yield
    finally:
        time.monotonic, network.TURN = clock, turn


async def count(url: str, store: GoalStore | None) -> Way:
    """Return the way of a goal over the transport of a URL."""
    server = ActionServer(FIBONACCI, fibonacci, store=store)
    ways: defaultdict[Figures, list[Way]] = defaultdict(list)
    async with fibaction.serve(server, url) as (at,), fibaction.connect(at, FIBONACCI) as client:
        await client.wait_for_server()
        for _ in range(RUNS):
            await send_goal(client)
            with ExitStack() as stack:
                if url == WAYS[DDS]:
                    await anyio.sleep(DUE)
                    stack.enter_context(frozen_clock())
                way = stack.enter_context(recorded())
                await send_goal(client)
                await settle(way)
            equal = ways[way.figures]
            equal.append(way)
            if len(ways[min(ways)]) == AGREEING:
                break
    often = [equal for equal in ways.values() if len(equal) >= AGREEING]
    return min(often or [max(ways.values(), key=len)], key=lambda equal: equal[0].figures)[0]


def way_of_a_goal(name: str) -> Way:
    """Return one of the ways, on asyncio's own event loop."""
    with TemporaryDirectory() as folder, own_domain() as environment:
        environment.setenv("FIBACTION_SEARCH", str(INTERFACES))
        store = SqliteStore(f"{folder}/goals.db") if name == STORE else None
        return anyio.run(count, WAYS[name], store)


def main(arguments: list[str] | None = None) -> None:
    """Print the way of a goal."""
    parser = argparse.ArgumentParser(description="Print the way of a goal through the modules.")
    shown: Any = parser.add_mutually_exclusive_group()
    shown.add_argument("--figures", action="store_true", help="only the figures")
    shown.add_argument("--modules", action="store_true", help="only the modules, with their calls")
    options = parser.parse_args(arguments)
    for name in WAYS:
        way = way_of_a_goal(name)
        calls, modules, changes = way.figures
        print(f"{name}: {calls} calls, {modules} modules, {changes} changes of module")
        if not options.figures:
            print(*(way.module_lines() if options.modules else way.lines()), sep="\n", end="\n\n")


if __name__ == "__main__":
    main()
