"""`fibaction.blocking`: clients for plain code, threads and Ctrl-C."""

from __future__ import annotations

import io
import math
import signal
import socket
import sys
import threading
from collections.abc import AsyncGenerator, Callable, Generator, Iterator
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

import anyio
import pytest
from anyio.from_thread import start_blocking_portal

import fibaction.blocking
from fibaction import (
    Action,
    ActionServer,
    ConnectionLost,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalRejected,
    GoalStatus,
    Progress,
    Report,
    Retry,
    ServerNotFound,
    TransportError,
    action,
    serve,
)
from fibaction.blocking import BlockingClient, BlockingConnection, call, connect, track
from fibaction.blocking import serve as blocking_serve
from fibaction.blocking._interrupts import Interrupts
from fibaction.blocking._loop_thread import LoopThread
from tests.support.one_worker import WORKER, OneWorker

COUNT = Action("count", goal=int, feedback=int, result=str)
Client = BlockingClient[int, int, str]
Items = AsyncGenerator[int | str, None]

FOR_EVER = 10**9
THREAD = "fibaction.blocking"


class Counter:
    """An executor that counts, in turns of the event loop, and the statuses its goals ended in."""

    def __init__(self) -> None:
        self.running = 0
        self.ended_as: list[GoalStatus] = []

    async def __call__(self, goal: GoalHandle[int]) -> Items:
        self.running += 1
        try:
            for number in range(goal.request):
                yield number
                await anyio.lowlevel.checkpoint()
        finally:
            self.running -= 1
            self.ended_as.append(goal.status)
        if goal.request == 0:
            raise GoalAborted("nothing to count", result="0")
        yield f"counted to {goal.request}"


class Served:
    """A server in another thread."""

    def __init__(self, url: str, counter: Counter) -> None:
        self.url = url
        self.counter = counter


def check_number(number: int) -> None:
    if number < 0:
        raise GoalRejected("a number is 0 or more")


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    counter = Counter()
    server = ActionServer(COUNT, counter, on_goal=check_number, feedback_window=4)
    with start_blocking_portal() as portal:
        serving = serve(server, "tcp://127.0.0.1:0")
        with portal.wrap_async_context_manager(serving) as (url,):
            yield Served(url, counter)


@pytest.fixture
def client(served: Served) -> Iterator[Client]:
    with connect(served.url, COUNT) as client:
        yield client
    assert THREAD not in [thread.name for thread in threading.enumerate()]


def test_a_call_returns_the_result_and_calls_back_in_its_own_thread(client: Client) -> None:
    seen: list[int] = []
    threads: set[int] = set()

    def on_feedback(number: int) -> None:
        seen.append(number)
        threads.add(threading.get_ident())
        assert client.call(1) == "counted to 1"

    assert client.call(3, on_feedback=on_feedback) == "counted to 3"
    assert seen == [0, 1, 2]
    assert threads == {threading.get_ident()}
    assert client.call(2, timeout=10, retry=Retry()) == "counted to 2"
    assert repr(client) == "<BlockingClient of <Action 'count'>>"


def test_a_goal_is_followed_to_its_end(client: Client) -> None:
    with client.send_goal(3) as goal:
        assert list(goal) == [0, 1, 2]
        assert (goal.feedback.number, goal.feedback.attempt) == (3, 1)
        assert goal.stamp <= goal.feedback.at
        assert goal.result() == "counted to 3"
        assert goal.outcome().status is GoalStatus.SUCCEEDED
        assert (goal.feedback_dropped, goal.feedback.dropped, goal.attempt) == (0, 0, 1)
        assert goal.stamp > 0
        assert repr(goal.feedback) == "<BlockingFeedback number=3 dropped=0>"
        assert repr(goal) == f"<BlockingGoal {goal.goal_id} SUCCEEDED>"


def test_a_goal_without_a_block_continues_after_the_end_of_the_connection(served: Served) -> None:
    with connect(served.url, COUNT) as client, connect(served.url, COUNT) as other:
        with connect(served.url, COUNT) as short:
            detached, used, last = [short.send_goal(FOR_EVER) for _ in range(3)]
            with detached:
                detached.detach()
            with detached:
                next(used.feedback)
        for goal in (detached, used, last):
            with other.attach(goal.goal_id) as followed:
                followed.detach()
                assert next(followed.feedback) > 0
            assert client.cancel_goals(goal.goal_id).accepted
            assert client.attach(goal.goal_id).outcome().status is GoalStatus.CANCELED


def test_a_block_that_begins_later_cancels_its_goal(served: Served, client: Client) -> None:
    with connect(served.url, COUNT) as short:
        first = short.send_goal(FOR_EVER)
        assert first.attempt == 1
        short.goals()
        with first:
            next(first.feedback)
        assert client.attach(first.goal_id).outcome().status is GoalStatus.CANCELED
        in_a_thread: list[Any] = []
        thread = threading.Thread(target=lambda: in_a_thread.append(short.send_goal(FOR_EVER)))
        thread.start()
        thread.join()
    assert client.cancel_goals(in_a_thread[0].goal_id).accepted  # it has continued


@action("say_nothing")
async def say_nothing() -> None:
    await anyio.sleep_forever()


def test_two_threads_cannot_read_the_feedback_of_a_goal_at_once() -> None:
    with (
        blocking_serve(say_nothing, "tcp://127.0.0.1:0") as (url,),
        connect(url, say_nothing) as client,
        client.send_goal() as goal,
    ):
        errors: list[str] = []
        both_tried = threading.Event()

        def read() -> None:
            try:
                next(goal.feedback)
            except RuntimeError as error:
                errors.append(str(error))
                both_tried.set()
            except StopIteration:
                pass

        threads = [threading.Thread(target=read) for _ in range(2)]
        for thread in threads:
            thread.start()
        assert both_tried.wait(5)
        goal.cancel()
        for thread in threads:
            thread.join()
    [text] = errors
    assert text.startswith("another task or thread waits for the feedback of goal ")


def test_without_an_action_it_gives_a_connection(served: Served) -> None:
    with connect(served.url) as connection:
        assert isinstance(connection, BlockingConnection)
        assert repr(connection) == f"<BlockingConnection of <ClientConnection to {served.url}>>"
        assert connection.actions() == [COUNT.info]
        assert connection.peers("count").servers == (served.url,)
        client = connection.client(COUNT)
        client.wait_for_server(10)
        assert client.action is COUNT
        assert client.call(1) == "counted to 1"


def test_several_threads_use_one_client(client: Client) -> None:
    results: list[str] = []

    def use(number: int) -> None:
        with client.send_goal(number) as goal:
            assert list(goal.feedback) == list(range(number))
            results.append(goal.result())

    threads = [threading.Thread(target=use, args=(number,)) for number in range(1, 9)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(results) == [f"counted to {number}" for number in range(1, 9)]


def test_the_end_of_the_block_ends_the_calls_of_other_threads(served: Served) -> None:
    begun, end, go_on = threading.Event(), threading.Event(), threading.Event()
    errors: list[str] = []

    def call(client: Client, callback: Callable[[int], object]) -> None:
        with pytest.raises((ConnectionLost, GoalCanceled)) as caught:
            client.call(FOR_EVER, on_feedback=callback)
        errors.append(type(caught.value).__name__)

    def waits(number: int) -> None:
        begun.set()
        go_on.wait()

    with connect(served.url, COUNT) as client:
        threads = [
            threading.Thread(target=call, args=(client, waits)),
            threading.Thread(target=call, args=(client, lambda _: end.set())),
        ]
        for thread in threads:
            thread.start()
        begun.wait()
        end.wait()
    go_on.set()
    for thread in threads:
        thread.join()
    assert len(errors) == 2
    with pytest.raises(ConnectionLost, match="inside the block of connect"):
        client.call(1)


def test_inside_an_event_loop_one_sentence_says_what_to_use() -> None:
    async def use() -> None:
        with connect("tcp://127.0.0.1:1", COUNT):
            raise AssertionError("the block must not run")

    with pytest.raises(RuntimeError) as caught:
        anyio.run(use)
    assert str(caught.value) == (
        "fibaction.blocking would block the event loop that runs in this thread: use"
        " `async with fibaction.connect(...)`, or `await` it, instead"
    )


def test_what_cannot_work_is_told_before_the_block() -> None:
    wrong: Any = "count"
    with pytest.raises(TypeError, match="'count' is not an Action"):
        connect("tcp://127.0.0.1:1", wrong)
    with pytest.raises(TransportError, match="whose servers and clients share an event loop"):
        connect("inproc://robot", COUNT)
    forgotten: Any = connect("tcp://127.0.0.1:1", COUNT)
    with pytest.raises(AttributeError, match="has no attribute 'call': it is a block, so write"):
        forgotten.call(1)


def test_a_server_that_is_not_there_leaves_no_thread() -> None:
    with pytest.raises(ServerNotFound):
        with connect("tcp://127.0.0.1:1", COUNT, reconnect=False):
            raise AssertionError("the block must not run")
    assert THREAD not in [thread.name for thread in threading.enumerate()]


def test_a_connection_that_ends_itself_ends_its_block() -> None:
    class Ends(Exception):
        """The error of a transport."""

    class Manager:
        async def __aenter__(self) -> str:
            return "opened"

        async def __aexit__(self, *_: object) -> None:
            raise Ends

    loop = LoopThread(Interrupts(enter=CODE, leave=CODE))
    loop.stop()  # it was not started
    loop.start()
    manager: Any = Manager()
    assert loop.enter(manager) == "opened"
    with pytest.raises(Ends):
        loop.stop()
    assert THREAD not in [thread.name for thread in threading.enumerate()]


# Ctrl-C


def interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


def interrupt_soon(thread: threading.Thread) -> None:
    """Send Ctrl-C from another thread to the main thread, which waits."""
    signal.pthread_kill(thread.ident or 0, signal.SIGINT)


CODE = interrupt.__code__


def test_ctrl_c_during_a_call_cancels_the_goal(served: Served, client: Client) -> None:
    main = threading.main_thread()
    seen: list[int] = []

    def on_feedback(number: int) -> None:
        seen.append(number)
        if number == 3:
            interrupt()

    with pytest.raises(KeyboardInterrupt):
        client.call(FOR_EVER, on_feedback=on_feedback)
    assert seen == [0, 1, 2, 3]
    with client.send_goal(FOR_EVER) as goal:
        threading.Timer(0.05, interrupt_soon, [main]).start()
        with pytest.raises(KeyboardInterrupt):
            goal.outcome()
    assert client.attach(goal.goal_id).outcome().status is GoalStatus.CANCELED


def test_a_handler_that_does_not_raise_is_called_and_the_wait_goes_on(
    served: Served, client: Client
) -> None:
    calls: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: calls.append(number))
    try:
        with connect(served.url, COUNT) as inner:
            mine = signal.getsignal(signal.SIGINT)
            assert inner.call(3, on_feedback=lambda _: interrupt()) == "counted to 3"
            interrupt()
        assert mine != signal.getsignal(signal.SIGINT)
        with connect(served.url, COUNT):
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # the program's own decision stays
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        with connect(served.url, COUNT) as inner:
            assert inner.call(1) == "counted to 1"
    finally:
        signal.signal(signal.SIGINT, before)
    assert calls == [signal.SIGINT] * 4


def test_ctrl_c_while_connecting_leaves_no_thread() -> None:
    main = threading.main_thread()
    with socket.create_server(("127.0.0.1", 0)) as silent:
        threading.Timer(0.05, interrupt_soon, [main]).start()
        with pytest.raises(KeyboardInterrupt):
            with connect(f"tcp://127.0.0.1:{silent.getsockname()[1]}", COUNT):
                raise AssertionError("the block must not run")
    assert THREAD not in [thread.name for thread in threading.enumerate()]


def begins() -> None:
    interrupt()


def leaves() -> None:
    interrupt()


def test_a_signal_is_put_off_while_a_call_does_not_wait() -> None:
    before = signal.getsignal(signal.SIGINT)
    interrupts = Interrupts(enter=begins.__code__, leave=leaves.__code__)
    steps: list[str] = []
    interrupts.install()
    with pytest.raises(KeyboardInterrupt), interrupts.held():
        interrupt()
        steps.append("the rest of the call")
    with interrupts.held():
        with pytest.raises(KeyboardInterrupt), interrupts.allowed():
            interrupt()
            steps.append("never")
        with pytest.raises(KeyboardInterrupt):
            interrupt()
            with interrupts.allowed():
                steps.append("never")
    with pytest.raises(KeyboardInterrupt):
        begins()
    leaves()  # put off: what follows is a clean-up
    interrupts.hold()
    interrupt()
    steps.append("clean-up")
    with pytest.raises(KeyboardInterrupt):
        interrupts.restore()
    assert steps == ["the rest of the call", "clean-up"]
    assert signal.getsignal(signal.SIGINT) is before


BLOCKING = str(Path(fibaction.blocking.__file__).parent)


class At:
    """A trace function that sends Ctrl-C at the n-th line of `fibaction.blocking`."""

    def __init__(self, number: float, *, opcodes: bool = False) -> None:
        self.count = 0
        self._number = number
        self._opcodes = opcodes

    def __call__(self, frame: FrameType, event: str, argument: object) -> Any:
        if not frame.f_code.co_filename.startswith(BLOCKING):
            return None
        frame.f_trace_opcodes = self._opcodes
        if event in ("line", "opcode", "call"):
            self.count += 1
            if self.count == self._number:
                interrupt()
        return self

    def run(self, function: Callable[[], object]) -> None:
        before = sys.gettrace()
        sys.settrace(self)
        try:
            next(apart(function))
        finally:
            sys.settrace(before)


def apart(function: Callable[[], object]) -> Generator[None, None, None]:
    """Call a function in a generator, which has a stack of handled exceptions of its own.

    Python 3.11 can leave one there if a trace function raises between two instructions, and every
    later test would find itself handling it.
    """
    function()
    yield


def fails(number: int) -> None:
    raise KeyError(number)


def use_all(url: str) -> None:
    with connect(url, COUNT) as client:
        with client.send_goal(FOR_EVER) as goal:
            for _ in goal.feedback:
                break
        with suppress(KeyError):
            client.call(FOR_EVER, on_feedback=fails)


def interrupted_at(number: float, served: Served, *, opcodes: bool = False) -> int:
    """Send Ctrl-C at one moment of a program, check that nothing is left, and count its moments."""
    before = signal.getsignal(signal.SIGINT)
    at = At(number, opcodes=opcodes)
    try:
        at.run(lambda: use_all(served.url))
    except KeyboardInterrupt:
        was_interrupted = True
    else:
        was_interrupted = False
    assert was_interrupted == (at.count >= number), number
    assert signal.getsignal(signal.SIGINT) is before, number
    assert THREAD not in [thread.name for thread in threading.enumerate()], number
    with connect(served.url, COUNT) as client:
        while client.goals()[-1].status.is_active:
            pass
        assert not any(info.status.is_active for info in client.goals()), number
    return at.count


# Of asyncio in Python 3.11: it forgets a socket if it is canceled as the connection is made.
@pytest.mark.filterwarnings("ignore:unclosed <socket:ResourceWarning")
def test_ctrl_c_at_any_line_cancels_the_goals_and_leaves_no_thread(served: Served) -> None:
    lines = interrupted_at(math.inf, served)
    for number in range(1, lines, 7):
        interrupted_at(number, served)


@action("press")
def press(times: int, report: Report[int]) -> str:
    done = 0
    try:
        for done in range(1, times + 1):
            report(done)
    except GoalCanceled:
        raise GoalCanceled(result=f"pressed {done} times") from None
    return f"pressed {done} times"


@action("home")
def home() -> str:
    return "at home"


def test_a_plain_function_is_served_and_called_without_an_event_loop() -> None:
    found: list[int] = []
    with blocking_serve([press, home], "tcp://127.0.0.1:0") as (url,):
        assert call(url, press, 3, on_feedback=found.append, timeout=5) == "pressed 3 times"
        assert call(url, home, labels={"order": "17"}) == "at home"
        with connect(url, home) as at_home:
            assert [info.labels for info in at_home.goals()] == [{"order": "17"}]
        with connect(url, press) as client, client.send_goal(FOR_EVER) as goal:
            for number in goal.feedback:
                if number == 3:
                    goal.cancel()
            outcome = goal.outcome()
    assert found == [1, 2, 3]
    assert outcome.status is GoalStatus.CANCELED
    assert str(outcome.result).startswith("pressed ")
    assert THREAD not in [thread.name for thread in threading.enumerate()]


class Pressed:
    """An event for which a program waits until Ctrl-C."""

    def wait(self) -> None:
        interrupt()
        raise AssertionError("Ctrl-C must end the wait")


def test_ctrl_c_ends_a_server_that_serves_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr("fibaction.blocking._open_block.Event", Pressed)
    blocking_serve(press, "tcp://127.0.0.1:0").forever()
    assert signal.getsignal(signal.SIGINT) is before
    assert THREAD not in [thread.name for thread in threading.enumerate()]


def test_a_server_that_cannot_begin_leaves_no_thread() -> None:
    with pytest.raises(TransportError, match="cannot serve at inproc://, whose clients share"):
        blocking_serve(press, "inproc://press")
    with pytest.raises(TypeError, match=r"serve\(\) needs at least one address"):
        with blocking_serve(press):
            raise AssertionError("the block must not run")
    assert THREAD not in [thread.name for thread in threading.enumerate()]


@pytest.mark.asyncio
async def test_a_server_does_not_block_an_event_loop() -> None:
    with pytest.raises(RuntimeError, match="would block the event loop"):
        blocking_serve(press, "tcp://127.0.0.1:0").forever()


@action("copy")
def copy(files: int, report: Report[Progress]) -> str:
    report(Progress(2, 3))
    if files == 0:
        raise GoalAborted("the disk is full")
    return f"{files} files"


def test_track_has_the_bar_of_fibaction_and_returns_the_result(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for module in ("tqdm.auto", "rich.console"):
        monkeypatch.setitem(sys.modules, module, None)
    with blocking_serve(copy, "tcp://127.0.0.1:0") as (url,), connect(url, copy) as client:
        written = io.StringIO()
        with client.send_goal(3) as goal:
            assert track(goal, "copying", file=written) == "3 files"
        assert written.getvalue() == "copying 60 %\ncopying 100 %\n"
        written = io.StringIO()
        with client.send_goal(0) as goal, pytest.raises(GoalAborted, match="the disk is full"):
            track(goal, "copying", file=written)
        assert written.getvalue() == "copying 60 %\n"


def test_a_connection_knows_the_workers_of_a_fleet() -> None:
    with connect(OneWorker()) as connection:
        assert connection.workers() == [WORKER]
