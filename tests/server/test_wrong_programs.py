"""Each wrong program gets one sentence, which says what is wrong, where, and what to write."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionServer,
    GoalHandle,
    GoalHistory,
    GoalRejected,
    Limits,
    Report,
    Retry,
    Return,
    Schedule,
    SqliteStore,
    action,
    call,
    connect,
    serve,
)
from fibaction.testing import run_executor
from fibaction_transports.inprocess import InProcessTransport

pytestmark = pytest.mark.anyio

Program = Callable[[], Awaitable[object]]


@dataclass
class Pose:
    x: int
    y: int = 0


@dataclass
class Turn:
    angle: int


class Named(msgspec.Struct):
    name: str
    count: int = 0


COUNT = Action("count", goal=Named, feedback=int, result=str)
ANY = Action("any", goal=Any, feedback=Any, result=str)


async def counted(goal: GoalHandle[Named]) -> AsyncIterator[int | str]:
    yield 1
    yield "done"


def generator(executor: Any) -> Program:
    """Return the program that sends a goal to a generator."""

    async def program() -> None:
        where = InProcessTransport()
        async with serve(ActionServer(COUNT, executor), where):
            await call(where, COUNT, Named("a"))

    return program


def function(body: Any) -> Program:
    """Return the program that serves a function, and sends it a goal."""

    async def program() -> None:
        made, where = action("work")(body), InProcessTransport()
        async with serve(made, where):
            await call(where, made, Pose(1))

    return program


def client(use: Callable[[Any], Any]) -> Program:
    """Return the program that does something with a goal that it has sent."""

    async def program() -> None:
        where = InProcessTransport()
        async with serve(ActionServer(COUNT, counted), where), connect(where, COUNT) as opened:
            goal = await opened.send_goal(Named("a"))
            answer = use(goal)
            if isinstance(answer, Awaitable):
                await answer

    return program


def with_client(use: Callable[[Any], Awaitable[object]]) -> Program:
    """Return the program that does something with a client."""

    async def program() -> None:
        async with connect(InProcessTransport(), COUNT) as opened:
            await use(opened)

    return program


def code(run: Callable[[], object]) -> Program:
    """Return the program that runs code without an `await`."""

    async def program() -> None:
        run()

    return program


async def forgets_its_return(goal: Pose) -> int:  # type: ignore[return]  # the mistake
    goal.x += 1


async def returns_a_text(goal: Pose) -> int:
    return "3"  # type: ignore[return-value]  # the mistake


async def reports_a_text(goal: Pose, report: Report[int]) -> None:
    await report("3")  # type: ignore[arg-type]  # the mistake


async def adds_to_a_struct(goal: Pose) -> int:
    return goal + 1  # type: ignore[operator]  # the mistake


async def rejects(goal: Pose) -> int:
    raise GoalRejected("the battery is charging")


async def rejected_by_another(goal: Pose) -> int:
    await refuse_all()
    return 1


async def refuse_all() -> None:
    def on_goal(goal: Named) -> None:
        raise GoalRejected("it is full")

    where = InProcessTransport()
    async with serve(ActionServer(COUNT, counted, on_goal=on_goal), where):
        await call(where, COUNT, Named("a"))


async def returns_too_much(goal: Pose) -> dict[str, list[int]]:
    return {"sums": [1, 2**64]}


async def reports_half_a_character(goal: Pose, report: Report[Named]) -> None:
    await report(Named("\ud800"))


async def awaits_its_report(goal: Pose, report: Report[int]) -> None:
    await report  # type: ignore[misc]  # the mistake


async def sends_by_its_report(goal: Pose, report: Report[int]) -> None:
    report.send(1)  # type: ignore[attr-defined]  # the mistake


async def waits_in_a_trial() -> None:
    @action
    async def wait() -> None:
        await anyio.sleep_forever()

    await run_executor(wait, timeout=0.01)


async def returns_a_text_in_a_field() -> None:
    @action
    async def name() -> Named:
        return Named(cast("str", 1))

    await run_executor(name)


async def yields_a_float(goal: GoalHandle[Named]) -> AsyncIterator[float]:
    yield 1.5


async def returns_a_number(goal: GoalHandle[Named]) -> AsyncIterator[Return[int]]:
    yield Return(3)


async def compares_its_handle(goal: GoalHandle[Named]) -> AsyncIterator[int]:
    yield goal < 3  # type: ignore[operator]  # the mistake


async def with_a_block(block: Any) -> None:
    with block:
        pass


async def looks_for_a_server() -> None:
    async with connect("tcp://127.0.0.1:1", COUNT) as opened:
        await opened.wait_for_server(timeout=0.1)


async def looks_for_another_action() -> None:
    where = InProcessTransport()
    async with serve(ActionServer(COUNT, counted), where), connect(where, ANY) as opened:
        await opened.wait_for_server(timeout=0.1)


async def iterates_over_events() -> None:
    where = InProcessTransport()
    async with serve(ActionServer(COUNT, counted), where), connect(where, COUNT) as opened:
        async with opened.events() as events:
            list(events)  # type: ignore[call-overload]  # the mistake


made = action("made")(returns_a_text)
FUNCTION = "in an `async def`; without async code, use fibaction.blocking"

PROGRAMS = {
    "a forgotten return": (
        function(forgets_its_return),
        "forgets_its_return() returned None, and its result is int: is a return missing?",
    ),
    "a result of another type": (
        function(returns_a_text),
        "returns_a_text() returned a str, and its result is int",
    ),
    "feedback of another type": (
        function(reports_a_text),
        "TypeError: feedback of action 'work' is int, and not a str",
    ),
    "a struct as a number": (
        function(adds_to_a_struct),
        "unsupported operand type(s) for +: 'Pose' and 'int' (Pose has the fields x, y)",
    ),
    "a rejection by a function": (
        function(rejects),
        (
            "GoalRejected: the battery is charging (the goal is accepted by now: raise GoalAborted"
            " here, or reject it in on_goal)"
        ),
    ),
    "a rejection of another goal": (function(rejected_by_another), "was rejected: it is full$"),
    "a report that is awaited": (
        function(awaits_its_report),
        "'await' expression (a report is called with one feedback: `await report(feedback)`)",
    ),
    "a report that sends": (
        function(sends_by_its_report),
        "'send' (a report is called with one feedback: `await report(feedback)`)",
    ),
    "a trial of a function that does not end": (
        waits_in_a_trial,
        "the goal of action 'wait' has not ended within 0.01 s$",
    ),
    "a result with a field of another type": (
        returns_a_text_in_a_field,
        "the function of 'name' is wrong: the result of action 'name' is not of its type",
    ),
    "a goal that is awaited": (
        client(lambda goal: goal),
        "a goal is not its result: write `await goal.result()`$",
    ),
    "a goal as a number": (
        client(lambda goal: goal + 1),
        "a goal is not its result: write `await goal.result()`$",
    ),
    "the ID of no goal": (
        with_client(lambda opened: opened.attach("abc")),
        (
            "a goal ID has 32 hexadecimal digits, not 'abc': goal.goal_id is one, and"
            " client.goals() lists those of the server"
        ),
    ),
    "a step that is a name": (
        with_client(lambda opened: opened.send_goal(Named("a"), step="a")),
        "a step is made by a goal, as `goal.step('drive')`; 'a' is not one",
    ),
    "a number of more than 64 bits": (
        function(returns_too_much),
        (
            "OverflowError: a whole number of more than 64 bits cannot be sent: send it as text"
            " - at `$.sums[1]`"
        ),
    ),
    "half a character": (
        function(reports_half_a_character),
        (
            r"ValueError: text with half a character, such as '\ud800', cannot be sent: replace it"
            " - at `$.name`"
        ),
    ),
    "what is neither feedback nor result": (
        generator(yields_a_float),
        (
            "the executor is wrong: it yielded a float, which is neither feedback (int) nor a"
            " result (str)"
        ),
    ),
    "a marked result of another type": (
        generator(returns_a_number),
        "the executor is wrong: it returned an int, and its result is str$",
    ),
    "a handle as a number": (
        generator(compares_its_handle),
        "'GoalHandle' and 'int' (what the client sent is goal.request)",
    ),
    "a union of two dataclasses": (
        code(lambda: Action("x", goal=Pose | Turn, feedback=None, result=None)),
        (
            "Pose | tests.server.test_wrong_programs.Turn apart: make each a msgspec.Struct with"
            " tag=True"
        ),
    ),
    "a function and itself": (
        code(lambda: ActionServer(made, made)),  # type: ignore[arg-type]  # the mistake
        "<Action 'made'> has its executor: write ActionServer(returns_a_text)",
    ),
    "a typo in a schedule": (
        code(lambda: Schedule(concurency=1)),  # type: ignore[call-arg]  # the mistake
        "Schedule has no setting 'concurency': did you mean 'concurrency'? Its settings are",
    ),
    "a typo in limits": (
        code(lambda: Limits(frames=1)),  # type: ignore[call-arg]  # the mistake
        "Limits has no setting 'frames': did you mean 'frame'?",
    ),
    "a typo in a retry": (
        code(lambda: Retry(tries=1)),  # type: ignore[call-arg]  # the mistake
        "Retry has no setting 'tries'; its settings are attempts,",
    ),
    "a typo in a history": (
        code(lambda: GoalHistory(second=1)),  # type: ignore[call-arg]  # the mistake
        "GoalHistory has no setting 'second': did you mean 'seconds'?",
    ),
    "a typo in a scheme": (
        code(lambda: connect("tpc://127.0.0.1:7400")),
        "no transport for tpc:// is installed: did you mean tcp://? Installed are",
    ),
    "with serve": (
        lambda: with_a_block(serve(ActionServer(COUNT, counted), "tcp://127.0.0.1:0")),
        f"`with` cannot open it: write `async with serve(...):`, {FUNCTION}",
    ),
    "with connect": (
        lambda: with_a_block(connect("tcp://127.0.0.1:1")),
        f"`with` cannot open it: write `async with connect(...) as client:`, {FUNCTION}",
    ),
    "with a goal": (
        client(with_a_block),
        f"`with` cannot open it: write `async with client.send_goal(...) as goal:`, {FUNCTION}",
    ),
    "for feedback": (
        client(lambda goal: list(goal.feedback)),
        f"`for` cannot read it: write `async for feedback in goal.feedback:`, {FUNCTION}",
    ),
    "for a goal": (
        client(list),
        f"`for` cannot read it: write `async for feedback in goal.feedback:`, {FUNCTION}",
    ),
    "for events": (
        iterates_over_events,
        f"`for` cannot read it: write `async for event in events:`, {FUNCTION}",
    ),
    "a server that does not listen": (
        looks_for_a_server,
        r"the action 'count' was not served within 0.1 s: no server listens at tcp://127.0.0.1:1",
    ),
    "an action that is not served": (
        looks_for_another_action,
        "the action 'any' was not served within 0.1 s: the action 'any' is not served at inproc://",
    ),
}


@pytest.mark.parametrize(("program", "sentence"), PROGRAMS.values(), ids=PROGRAMS)
async def test_a_wrong_program_is_told_what_is_wrong_and_what_to_write(
    program: Program, sentence: str
) -> None:
    with pytest.raises(Exception, match=pattern(sentence)) as found, anyio.fail_after(10):
        await program()

    assert "\n" not in str(found.value)


async def test_servers_that_open_one_file_are_told_to_share_a_store(tmp_path: Path) -> None:
    servers = [
        ActionServer(
            Action(name, goal=Named, feedback=int, result=str),
            counted,
            store=SqliteStore(tmp_path / "goals.db"),
        )
        for name in ("a", "b", "c")
    ]

    with pytest.raises(Exception, match="or give the servers of one process one SqliteStore"):
        async with serve(servers, InProcessTransport()):
            pass


def pattern(sentence: str) -> str:
    """Return the regular expression of a sentence; a `$` at its end is the end of the text."""
    end = "$" if sentence.endswith("$") else ""
    return re.escape(sentence.removesuffix("$")) + end
