"""`send_goal`: every way in which a goal can end, its output and its exit code."""

from __future__ import annotations

import json
import math
import signal
import socket
import uuid
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import (
    ActionServer,
    AuthenticationFailed,
    CancelAnswer,
    CancelCode,
    GoalHandle,
    GoalID,
    GoalStatus,
    InvalidMessage,
    Schedule,
    Sender,
    ServerNotFound,
    TransportError,
    Watcher,
    connect,
    serve,
)
from fibaction.border.abc import Endpoint, ForwardingEndpoint, GoalRequest, GoalStream, Meta
from fibaction.cli.output.render import TextPrinter
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import send_goal
from fibaction.cli.verbs.send_goal import SendOptions, SendTimes, send
from fibaction.server.admission.callbacks import GoalCallbacks
from fibaction.server.settings import ActionServerSettings
from fibaction.testing import ScriptedServer
from fibaction.types.action import Action
from tests.cli.conftest import Invoke, Open, Robot, Run, Start, interrupt
from tests.cli.robot import WAIT, Progress, Wait, Waited, wait
from tests.cli.served import Altered, counter
from tests.support.processes import ended, lines_until

# As processes


def test_a_goal_with_feedback_prints_what_ros_prints(here: Run, url: str) -> None:
    code, out, err = here("send_goal", "fibonacci", "order: 3", "-f", url=url)

    assert (code, err) == (0, "")
    goal_id = out.split("ID: ")[1].split()[0]
    assert len(goal_id) == 32
    assert out.splitlines() == [
        "Sending goal:",
        "    order: 3",
        "",
        f"Goal accepted with ID: {goal_id}",
        "",
        "Feedback:",
        "    partial_sequence:",
        *("    - 0", "    - 1", "    - 1"),
        "",
        "Feedback:",
        "    partial_sequence:",
        *("    - 0", "    - 1", "    - 1", "    - 2"),
        "",
        "Result:",
        "    sequence:",
        *("    - 0", "    - 1", "    - 1", "    - 2"),
        "",
        "Goal finished with status: SUCCEEDED",
    ]


def test_ctrl_c_cancels_waits_and_says_how_it_ended(started: Start, tcp: str) -> None:
    process = started("send_goal", "wait", "--json", url=tcp)
    lines_until("EXECUTING", process)
    interrupt(process)
    code, out, err = ended(process)

    assert code == ExitCode.CANCELED
    assert err == "Canceling goal... (Ctrl-C again leaves it running)\n"
    events = [json.loads(line) for line in out.splitlines()]
    assert [event["status"] for event in events] == ["CANCELING", "CANCELED"]
    assert events[-1]["reason"] == "asked to stop"
    assert events[-1]["result"]["seconds"] > 0


def test_a_server_that_dies_is_a_lost_connection(
    started: Start, start_robot: Callable[[], Robot]
) -> None:
    robot = start_robot()
    process = started("send_goal", "wait", "--json", url=f"{robot.tcp}?reconnect_timeout=0.5")
    accepted = json.loads(lines_until("EXECUTING", process)[0])
    robot.process.kill()
    code, _, err = ended(process)

    assert code == ExitCode.UNREACHABLE
    assert err.splitlines()[0].startswith("fibaction: tcp://")  # from the log, at once
    assert f"The goal {accepted['goal_id']} was accepted, and it is not known whether" in err
    assert err.splitlines()[-1].startswith("Error: ")
    assert "Traceback" not in err


def test_who_reads_no_more_cancels_the_goal(started: Start, here: Run, tcp: str) -> None:
    process = started("send_goal", "wait", "{seconds: 60, steps: 600}", "-f", "--json", url=tcp)
    accepted = json.loads(lines_until("accepted", process)[0])
    assert process.stdout is not None
    process.stdout.close()
    assert process.wait(30) == 1
    assert here("attach", accepted["goal_id"], "wait", url=tcp).code == ExitCode.CANCELED


def test_utf_8_is_shown_as_it_is_or_as_numbers(fibaction: Run, tcp: str) -> None:
    plain = fibaction("send_goal", "words", "{words: füñf 鳥}", "-f", url=tcp)
    latin = fibaction(
        *("send_goal", "words", "{words: 鳥}"), url=tcp, env={"PYTHONIOENCODING": "latin-1"}
    )

    assert plain.out.count("füñf 鳥") == 3
    assert latin.code == 0
    assert "echoed: \\u9ce5" in latin.out


# In a terminal


@pytest.mark.parametrize("columns", [80, 160])
def test_on_a_terminal_there_is_a_bar_and_it_is_gone_in_the_end(
    terminal: Open, tcp: str, columns: int
) -> None:
    shown = terminal(
        *("send_goal", "wait", "{seconds: 2, steps: 4}", "-f"), url=tcp, columns=columns
    )
    shown.until("50%  step: step 2")
    assert shown.ends() == 0

    assert "━" not in shown.text
    assert "Goal finished with status: SUCCEEDED" in shown.text
    assert not shown.cursor_hidden


def test_a_terminal_that_cannot_redraw_gets_lines(terminal: Open, tcp: str) -> None:
    shown = terminal(
        "send_goal", "arm/pick", "object_name: cup", "-f", url=tcp, env={"TERM": "dumb"}
    )
    assert shown.ends() == 0

    assert shown.text.count("Feedback:") == 4


# In this process


def test_the_goal_comes_from_one_place(invoke: Invoke, tcp: str, tmp_path: Path) -> None:
    file = tmp_path / "goal.yaml"
    file.write_text("\ufefforder: 1\n", encoding="utf-8")

    for result in (
        invoke("send_goal", "fibonacci", "order: 1", url=tcp),
        invoke("send_goal", "fibonacci", "--goal-file", str(file), url=tcp),
        invoke("send_goal", "fibonacci", "--stdin", input="order: 1\n", url=tcp),
    ):
        assert result.exit_code == 0
        assert "Goal finished with status: SUCCEEDED" in result.output


def test_a_file_that_is_no_text_is_one_sentence(invoke: Invoke, tcp: str, tmp_path: Path) -> None:
    file = tmp_path / "goal.yaml"
    file.write_bytes(b"\xff")

    by_file = invoke("send_goal", "fibonacci", "--goal-file", str(file), url=tcp)
    by_stdin = invoke("send_goal", "fibonacci", "--stdin", input=b"\xff", url=tcp)

    assert by_file.stderr.startswith(f"Error: {file} is not UTF-8 text: ")
    assert by_stdin.stderr.startswith("Error: stdin is not UTF-8 text: ")
    assert by_file.exit_code == by_stdin.exit_code == ExitCode.USAGE


def test_a_type_that_the_server_does_not_say_is_not_checked(invoke: Invoke, tcp: str) -> None:
    result = invoke("send_goal", "words", "a/action/B", url=tcp)

    assert result.exit_code == 0
    assert result.stderr == "the server of /words does not say its type, so it is not checked\n"


@pytest.mark.parametrize(
    "words",
    [
        ["order: 3"],
        ["order:", "3"],
        ["order=3"],
        ["order:=3"],
        ["arduinobot_msgs/Fibonacci", "order=3"],
    ],
    ids=" ".join,
)
def test_a_goal_may_be_yaml_or_pairs_of_fields_and_values(
    invoke: Invoke, tcp: str, words: list[str]
) -> None:
    result = invoke("send_goal", "fibonacci", *words, url=tcp)

    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout.startswith("Sending goal:\n    order: 3\n")


def test_a_rejected_goal_says_why(invoke: Invoke, tcp: str) -> None:
    words = invoke("send_goal", "arm/pick", "object_name: sun", url=tcp)
    events = invoke("send_goal", "arm/pick", "object_name: sun", "--json", url=tcp)

    assert words.exit_code == events.exit_code == ExitCode.REJECTED
    assert words.output.endswith("Goal was rejected: the sun is too hot\n")
    assert json.loads(events.output)["reason"] == "the sun is too hot"


@pytest.mark.parametrize(
    ("goal", "code", "told"),
    [
        (["arm/pick", "object_name: ghost"], ExitCode.ABORTED, "ABORTED (there is no ghost)"),
        (["wait", "-t", "0.3"], ExitCode.TIMED_OUT, "CANCELED (asked to stop)"),
    ],
)
def test_an_end_says_why(
    invoke: Invoke, tcp: str, goal: list[str], code: ExitCode, told: str
) -> None:
    result = invoke("send_goal", *goal, url=tcp)

    assert result.exit_code == code
    assert result.stdout.endswith(f"Goal finished with status: {told}\n")
    late = "The goal has not ended within 0.3 s. Canceling goal...\n"
    assert result.stderr == (late if code is ExitCode.TIMED_OUT else "")


def test_a_server_that_is_silent_is_not_waited_for(invoke: Invoke) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        result = invoke("send_goal", "wait", "-t", "0.5", url=f"tcp://127.0.0.1:{port}")

    assert result.exit_code == ExitCode.TIMED_OUT
    assert result.stderr == "The server has not answered within 0.5 s.\n"


# The keys and the clock, with a server that does as it is told


def deciding() -> tuple[ScriptedServer[Wait, Progress, Waited], anyio.Event, anyio.Event]:
    """A server that thinks about a goal until the second event; the first says that it does."""
    asked, decide = anyio.Event(), anyio.Event()
    server = ScriptedServer(WAIT, [Waited(1.0)])

    async def think(_: Wait) -> None:
        asked.set()
        await decide.wait()

    server._callbacks = GoalCallbacks("wait", ActionServerSettings(on_goal=think))
    return server, asked, decide


def waiting(**settings: Any) -> ActionServer[Wait, Progress, Waited]:
    """A server whose goals take longer than a test."""
    return ActionServer(WAIT, wait, **settings)


async def send_here(*, timeout: float | None = None, **times: float) -> int:
    """Send a goal to the server of a test, with other times than usual."""
    options = SendOptions(timeout=timeout)
    with anyio.fail_after(20):
        return await send("inproc://keys", "wait", "", "", options, SendTimes(**times))


@asynccontextmanager
async def sent_here(**times: float) -> AsyncGenerator[list[int], None]:
    """Sends a goal to the server of a test, and at the end of the block waits until the command has
    ended; its exit code is then in the list.
    """
    codes: list[int] = []

    async def run() -> None:
        codes.append(await send_here(**times))

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(run)
        yield codes


@asynccontextmanager
async def executing(server: Endpoint, **times: float) -> AsyncGenerator[list[int], None]:
    """As `sent_here`, with the server as well; the block begins when it executes the goal."""
    async with serve(server, "inproc://keys"), sent_here(**times) as codes:
        await until(server, GoalStatus.EXECUTING)
        yield codes


async def until(server: Endpoint, status: GoalStatus) -> None:
    """Wait until a goal of the server has this status."""
    with await server.status() as statuses, anyio.fail_after(20):
        while (info := await statuses.receive()) and info.status is not status:
            pass
    assert info is not None


class Noting(Watcher):
    """A watcher that notes the meta of each goal."""

    def __init__(self) -> None:
        self.metas: list[dict[str, str]] = []

    def offered(
        self, action: str, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> None:
        self.metas.append(dict(meta))


@pytest.mark.asyncio
async def test_labels_go_with_the_goal_and_the_trace_of_the_environment_as_far_as_it_fits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    noting, url = Noting(), "inproc://labels"
    trace = {"traceparent": "00-1", "baggage": "b=2"}
    for name, value in trace.items():
        monkeypatch.setenv(name.upper(), value)
    server = counter("count", *(["there"] for _ in range(4)))
    server.watch_by([noting])
    many = tuple((f"label{number}", "") for number in range(8))
    async with serve(server, url):
        for detach, labels in ((False, ()), (True, ()), (False, (("order", "17"),)), (False, many)):
            options = SendOptions(detach=detach, as_json=True, labels=labels)
            assert await send(url, "count", "", "3", options) == ExitCode.SUCCEEDED
        too_many = SendOptions(as_json=True, labels=(*many, ("order", "17")))
        with pytest.raises(InvalidMessage, match="9 keys, and 8 are the limit"):
            await send(url, "count", "", "3", too_many)

    assert noting.metas == [
        trace,
        {"detached": "1", **trace},
        {"order": "17", **trace},
        dict(many),
    ]


class Errand(msgspec.Struct):
    """A goal of which the client knows one field."""

    stops: list[Wait] = msgspec.field(default_factory=lambda: [Wait(2.0)])
    id: uuid.UUID = msgspec.field(default_factory=uuid.uuid4)


@pytest.mark.asyncio
async def test_all_that_the_server_gets_is_printed_and_what_it_fills_in_is_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    got: list[Errand] = []

    async def run(goal: GoalHandle[Errand]) -> AsyncGenerator[int | str, None]:
        got.append(goal.request)
        yield "done"

    action = Action("errand", goal=Errand, feedback=int, result=str)
    async with serve(ActionServer(action, run), "inproc://keys"):
        options = SendOptions(False, None, False, as_json=False, full=False)
        assert await send("inproc://keys", "errand", "", "", options) == ExitCode.SUCCEEDED

    assert got[0].stops == [Wait(2.0)]
    printed = capsys.readouterr()
    assert printed.out.splitlines()[:4] == [
        "Sending goal:",
        "    stops:",
        "    - seconds: 2.0",
        "      steps: 1",
    ]
    assert printed.err == "The server fills in: id\n"


@pytest.mark.asyncio
async def test_a_goal_that_waits_in_a_queue_tells_its_place(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    told = anyio.Event()

    def note(text: str) -> None:
        print(text)
        told.set()

    monkeypatch.setattr(send_goal, "note", note)
    server = waiting(schedule=Schedule(concurrency=1, queue=5))
    async with executing(server, queue=0) as first:
        async with connect("inproc://keys", WAIT) as client:
            other = await client.send_goal(Wait())
            async with sent_here(queue=0) as second:
                with anyio.fail_after(20):
                    await told.wait()
                assert first == second == []
                await other.cancel()
                await client.cancel_goals()

    assert first == second == [ExitCode.CANCELED]
    assert "\nThe goal waits, 2nd of 2.\n" in capsys.readouterr().out


@pytest.mark.asyncio
async def test_a_goal_of_a_client_that_may_not_observe_goes_on_without_its_place() -> None:
    asked = anyio.Event()

    async def forbidden() -> Any:
        asked.set()
        raise AuthenticationFailed("this client may not observe")

    server = Altered(waiting(), status=forbidden)
    async with serve(server, "inproc://keys"), sent_here(queue=0) as codes:
        with anyio.fail_after(20):
            await asked.wait()
        await server.cancel_goals()

    assert codes == [ExitCode.CANCELED]


@pytest.mark.asyncio
@pytest.mark.parametrize("presses", [1, 2])
async def test_ctrl_c_before_the_answer_withdraws_the_goal(
    presses: int, capsys: pytest.CaptureFixture[str]
) -> None:
    server, asked, decide = deciding()
    withdrawn = anyio.Event()

    async def cancel(goal_id: GoalID | None, stamp: int | None) -> CancelAnswer:
        withdrawn.set()
        return await server.cancel_goals(goal_id, stamp)  # which waits for the decision

    async with serve(Altered(server, cancel_goals=cancel), "inproc://keys"):
        async with sent_here(same_signal=0) as codes:
            await asked.wait()
            signal.raise_signal(signal.SIGINT)
            await withdrawn.wait()
            if presses == 1:
                decide.set()
            else:
                signal.raise_signal(signal.SIGINT)
        decide.set()

    assert codes == [ExitCode.CANCELED]
    assert "canceled before the server had accepted it" in capsys.readouterr().err


@pytest.mark.asyncio
async def test_ctrl_c_twice_leaves_a_goal_whose_cancel_is_not_answered(
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked = anyio.Event()

    async def ask(*_: object) -> None:
        asked.set()
        await anyio.sleep_forever()

    async with executing(Altered(waiting(), cancel_goals=ask), same_signal=0) as codes:
        signal.raise_signal(signal.SIGINT)
        await asked.wait()
        signal.raise_signal(signal.SIGINT)

    assert codes == [ExitCode.INTERRUPTED]
    asking, left = capsys.readouterr().err.splitlines()
    assert asking.startswith("Canceling goal...")
    assert left.endswith("was left, and may continue.")


@pytest.mark.asyncio
async def test_ctrl_c_twice_within_a_moment_is_once_and_cancels(
    capsys: pytest.CaptureFixture[str],
) -> None:
    server = waiting()

    async def cancel(goal_id: GoalID | None, stamp: int | None) -> CancelAnswer:
        await anyio.wait_all_tasks_blocked()  # so that the second signal comes first
        return await server.cancel_goals(goal_id, stamp)

    async with executing(Altered(server, cancel_goals=cancel), same_signal=math.inf) as codes:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.raise_signal(number)

    assert codes == [ExitCode.CANCELED]
    assert "was left" not in capsys.readouterr().err


@pytest.mark.asyncio
async def test_a_goal_that_is_not_answered_in_time_is_withdrawn(
    capsys: pytest.CaptureFixture[str],
) -> None:
    server, _, decide = deciding()

    async with serve(server, "inproc://keys"):
        code = await send_here(timeout=0.1, cancel=0.05)
        decide.set()

    assert code == ExitCode.TIMED_OUT
    assert "The server has not accepted the goal within 0.1 s." in capsys.readouterr().err


@pytest.mark.asyncio
@pytest.mark.parametrize("timeout", [50.0, None])
async def test_the_executor_knows_the_timeout(timeout: float | None) -> None:
    left: list[float] = []

    async def executor(goal: GoalHandle[Wait]) -> AsyncGenerator[Progress | Waited, None]:
        left.append(goal.deadline - anyio.current_time())
        yield Waited(0)

    async with serve(ActionServer(WAIT, executor), "inproc://keys"):
        assert await send_here(timeout=timeout) == ExitCode.SUCCEEDED

    assert 20 < left[0] <= (timeout or math.inf)


@pytest.mark.asyncio
async def test_ctrl_c_before_anything_was_sent_ends_as_shells_expect(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = anyio.Event()

    async def never(*_: object) -> None:
        asked.set()
        await anyio.sleep_forever()

    monkeypatch.setattr(send_goal, "find_action", never)

    async with sent_here() as codes:
        await asked.wait()
        signal.raise_signal(signal.SIGTERM)

    assert codes == [ExitCode.INTERRUPTED]


async def silent(*_: object) -> None:
    await anyio.sleep_forever()


def refused(reason: str = "") -> Callable[..., Any]:
    async def refuse(*_: object) -> CancelAnswer:
        return CancelAnswer(CancelCode.REJECTED, reason=reason)

    return refuse


async def lost(*_: object, **__: object) -> None:
    raise ServerNotFound(
        "no server listens: start the server, or wait for it with wait_for_server()"
    )


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("calls", "text"),
    [
        ({}, "was left, and may continue.\n"),  # the goal does not end
        ({"cancel_goals": silent}, "was left, and may continue.\n"),
        ({"cancel_goals": refused()}, "The server does not cancel it: it does not say why\n"),
        ({"cancel_goals": refused("too late")}, "The server does not cancel it: too late\n"),
        ({"cancel_goals": lost}, "It could not be canceled: no server listens: start the server\n"),
    ],
)
async def test_a_goal_that_cannot_be_canceled_is_left_when_its_time_is_up(
    capsys: pytest.CaptureFixture[str],
    calls: dict[str, Callable[..., Any]],
    text: str,
) -> None:
    server = waiting(interrupt_on_cancel=False, shutdown_timeout=0)

    async with serve(Altered(server, **calls), "inproc://keys"):
        code = await send_here(timeout=0.1, cancel=0.05)

    assert code == ExitCode.TIMED_OUT
    said = capsys.readouterr().err
    assert text in said
    assert said.endswith("was left, and may continue.\n")


@pytest.mark.asyncio
async def test_what_became_of_an_accepted_goal_is_said_when_its_server_is_lost(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(send_goal, "print_goal", lost)
    async with serve(waiting(), "inproc://keys"):
        with pytest.raises(ServerNotFound):
            await send_here()
    assert "was accepted, and it is not known whether it goes on" in capsys.readouterr().err


class OtherVersion(ForwardingEndpoint):
    """An endpoint to which no goal can be sent."""

    async def offer_goal(self, request: GoalRequest) -> GoalStream:
        raise TransportError("its server has another version of the types")


@pytest.mark.asyncio
async def test_a_goal_is_said_to_be_sent_only_if_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    async with serve(OtherVersion(waiting()), "inproc://keys"):
        with pytest.raises(TransportError):
            await send_here()
    assert capsys.readouterr().out == ""


@pytest.mark.asyncio
async def test_a_goal_that_its_server_thinks_about_is_said_to_be_sent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    server, asked, decide = deciding()
    said: list[str] = []

    def say(_: object, goal: object) -> None:
        said.append(f"sending {goal}")
        decide.set()

    monkeypatch.setattr(TextPrinter, "sending", say)
    async with serve(server, "inproc://keys"), sent_here(announce=0.0) as codes:
        await asked.wait()

    assert len(codes) == len(said) == 1


async def closed(*_: object, **__: object) -> None:
    raise BrokenPipeError


@pytest.mark.asyncio
async def test_an_output_that_is_closed_does_not_wait_for_a_server_that_is_silent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(send_goal, "print_goal", closed)

    async with serve(Altered(waiting(), cancel_goals=silent), "inproc://keys"):
        with pytest.raises(BrokenPipeError):
            await send_here(cancel=0.05)


def test_a_goal_for_an_action_without_schemas_is_sent_as_it_is() -> None:
    info = Action("any", goal=object, feedback=int, result=str).info

    assert send_goal.goal_for(info, "", "{a: 1}") == {"a": 1}
