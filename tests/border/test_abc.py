from __future__ import annotations

import inspect
import math
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any

import anyio
import pytest

from fibaction import ActionClient, ActionServer, CancelCode
from fibaction._runtime.notify import Notifier
from fibaction.border import abc
from fibaction.border.abc import (
    Connection,
    Endpoint,
    FeedbackItem,
    ForwardingEndpoint,
    GoalRequest,
    GoalStream,
    GoalUpdate,
    Startable,
    StatusStream,
    Transport,
)
from fibaction.types.action import Action, ActionInfo
from fibaction.words.errors import (
    ActionError,
    StoreError,
    TransportError,
    UnknownGoal,
)
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction.words.goals import (
    UNKNOWN_OUTCOME,
    UNKNOWN_SENDER,
    ActionPeers,
    CancelAnswer,
    GoalID,
    GoalInfo,
    Outcome,
    Sender,
)
from fibaction.words.intake import FIXED_INTAKE, Intake, IntakeChange, IntakeMode
from fibaction.words.statuses import GoalStatus
from fibaction_transports.inprocess import InProcessTransport
from tests.support.fibonacci import FIBONACCI, Goal, Result, fibonacci

KNOWN = GoalID(bytes(range(16)))
OTHER = GoalID(bytes(range(1, 17)))


Event = GoalUpdate | Exception


class OneEnd(GoalStream):
    """A stream of a goal to which things happen when the test says so."""

    def __init__(self, end: Outcome[bytes] | Exception | None = None, *events: Event) -> None:
        self.closed = 0
        self.reads = True
        self.news = Notifier()
        self.end = end
        self.events: deque[Event] = deque(events)
        self.limits: list[int] = []

    def happen(self, *events: Event) -> None:
        """Things that can be taken from now on."""
        self.events.extend(events)
        self.news.notify()

    @property
    def status(self) -> GoalStatus:
        return GoalStatus.SUCCEEDED

    @property
    def dropped(self) -> int:
        return 0

    def take(self, limit: int = 1) -> list[GoalUpdate]:
        self.limits.append(limit)
        if not self.events:
            return []
        event = self.events.popleft()
        if isinstance(event, Exception):
            raise event
        return [event]

    def known_outcome(self) -> Outcome[bytes] | None:
        if isinstance(self.end, Exception):
            raise self.end
        return self.end

    def hold(self, wanted: bool) -> None:
        raise NotImplementedError

    def close(self) -> None:
        self.closed += 1

    def fail(self, error: ActionError) -> None:
        raise NotImplementedError


class OneGoal(Endpoint):
    """An endpoint that knows one goal, and can be sent it, or asked to follow it."""

    def __init__(self, stream: OneEnd) -> None:
        self.stream = stream
        self.sent: list[GoalRequest] = []

    @property
    def info(self) -> ActionInfo:
        return ActionInfo("one")

    async def offer_goal(self, request: GoalRequest) -> GoalStream:
        self.sent.append(request)
        return self.stream

    async def feedback(
        self, goal_id: GoalID, *, after: int | None = None, own: bool = False, attempt: int = 1
    ) -> GoalStream:
        assert not own, "asking for a result slows nothing down"
        if goal_id != KNOWN:
            raise UnknownGoal(goal_id)
        return self.stream

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        raise NotImplementedError

    async def status(self) -> StatusStream:
        raise NotImplementedError

    async def wait_for_server(self) -> None:
        raise NotImplementedError


class AtOnce(OneGoal):
    """An endpoint that decides on goals at once."""

    def offer_goal(self, request: GoalRequest) -> Any:
        self.sent.append(request)
        return self.stream


ONE, OTHER_ONE = FeedbackItem(1, b"1"), FeedbackItem(2, b"2")


async def next_update(stream: GoalStream) -> GoalUpdate:
    return await anext(aiter(stream))


each_way_to_read = pytest.mark.parametrize(
    "read", [next_update, GoalStream.receive], ids=["updates", "receive"]
)
Read = Callable[[GoalStream], Awaitable[GoalUpdate | None]]
END = UNKNOWN_OUTCOME


@each_way_to_read
@pytest.mark.asyncio
async def test_a_reader_waits_as_long_as_there_is_nothing_and_goes_on_with_the_news(
    read: Read,
) -> None:
    stream = OneEnd()
    seen: list[GoalUpdate] = []

    async def read_all() -> None:
        while (event := await read(stream)) not in (None, END):
            assert event is not None
            seen.append(event)

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(read_all)
            for happens, expected in (([], []), ([ONE], [ONE]), ([OTHER_ONE], [ONE, OTHER_ONE])):
                await anyio.wait_all_tasks_blocked()
                stream.happen(*happens)
                await anyio.wait_all_tasks_blocked()
                assert seen == expected
            stream.happen(END)
    assert set(stream.limits) == {1}, "what is taken beyond the first would be lost"


@each_way_to_read
@pytest.mark.parametrize("late", [True, False], ids=["canceled after", "canceled before"])
@pytest.mark.asyncio
async def test_nothing_is_lost_if_the_wait_is_canceled(read: Read, late: bool) -> None:
    stream = OneEnd()
    seen: list[GoalUpdate | None] = []

    async def read_one() -> None:
        seen.append(await read(stream))

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(read_one)
            await anyio.wait_all_tasks_blocked()
            if not late:
                tasks.cancel_scope.cancel()
            stream.happen(ONE, OTHER_ONE)
            if late:
                tasks.cancel_scope.cancel()
        seen += [await read(stream) for _ in range(2 - len(seen))]
    assert seen == [ONE, OTHER_ONE]


@pytest.mark.asyncio
@pytest.mark.parametrize("feedback", [True, False])
async def test_a_goal_is_sent_by_offering_a_request_of_the_keywords(feedback: bool) -> None:
    stream, ann, meta = OneEnd(), Sender("ann"), {"traceparent": "00-1"}
    for endpoint in (OneGoal(stream), AtOnce(stream)):
        with anyio.fail_after(5):
            sent = await endpoint.send_goal(KNOWN, b"goal", feedback=feedback)
            assert sent is stream
            await endpoint.send_goal(KNOWN, b"goal", sender=ann, timeout=5, meta=meta)
        first, second = endpoint.sent
        assert first == GoalRequest(KNOWN, b"goal", feedback)
        assert (first.sender, first.deadline, first.meta) == (UNKNOWN_SENDER, math.inf, None)
        assert (second.feedback, second.sender, second.meta) == (True, ann, meta)
        assert second.deadline == pytest.approx(anyio.current_time() + 5, abs=1)


def test_an_endpoint_that_is_written_as_it_was_before_says_what_to_write() -> None:
    for base in (Endpoint, ForwardingEndpoint, OneGoal):
        with pytest.raises(
            TypeError, match=r"Old overrides send_goal.* write offer_goal\(self, req"
        ):
            type("Old", (base,), {"send_goal": lambda self, goal_id, goal: None})


class Nowhere(Connection):
    """A connection that knows as little as it may."""

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        raise NotImplementedError

    async def actions(self) -> list[ActionInfo]:
        raise NotImplementedError


@pytest.mark.asyncio
async def test_a_connection_and_a_transport_need_not_be_those_of_a_fleet_or_of_a_robot() -> None:
    connection, transport = Nowhere(), InProcessTransport()
    assert await connection.peers("fibonacci") == ActionPeers((), ())
    assert await connection.nodes() == set()
    assert await connection.workers() == []
    assert connection.release == ""
    assert await connection.given_up() == {}
    with pytest.raises(StoreError, match="only fleets keep such goals"):
        await connection.rerun("fibonacci", GoalID.random())
    with pytest.raises(TransportError, match=r"connect to the robot itself, at dds:// or ros2://"):
        await connection.interface_texts(FIBONACCI.info)
    async with transport.goal_store() as store:
        assert store is None
    assert transport.served_as("fibonacci") == "fibonacci"


@pytest.mark.asyncio
async def test_a_transport_without_discovery_is_diagnosed_by_its_actions() -> None:
    transport = InProcessTransport()
    async with transport.serve():
        nothing = await transport.diagnose(1.0)
    async with transport.serve(ActionServer(FIBONACCI, fibonacci)):
        all_of_it = await transport.diagnose(1.0)
        one = await transport.diagnose(1.0, "/fibonacci")
        other = await transport.diagnose(1.0, "dance")

    assert (nothing.is_found, nothing.advice) == (
        False,
        ("the server answers, and serves no action",),
    )
    assert (all_of_it.is_found, all_of_it.advice) == (True, ())
    assert all_of_it.facts == {"actions": [{"name": "fibonacci", "type": FIBONACCI.type_name}]}
    assert (one.is_found, one.advice) == (True, ())
    assert (other.is_found, other.advice) == (
        False,
        ("the server answers, and does not serve 'dance'",),
    )


def test_a_stream_is_closed_at_the_end_of_its_block_and_lets_errors_pass() -> None:
    stream = OneEnd(UNKNOWN_OUTCOME)
    with pytest.raises(LookupError), stream as entered:
        assert entered is stream
        assert stream.closed == 0
        raise LookupError
    assert stream.closed == 1


@pytest.mark.parametrize(
    ("interface", "to_write"),
    [
        (GoalStream, {"status", "dropped", "take", "known_outcome", "hold", "close", "fail"}),
        (StatusStream, {"dropped", "receive", "close", "fail"}),
        (
            Endpoint,
            {"info", "offer_goal", "feedback", "cancel_goals", "status", "wait_for_server"},
        ),
        (Connection, {"endpoint", "actions"}),
        (Transport, {"from_url", "serve", "connect"}),
    ],
)
def test_the_author_of_a_transport_writes_these_methods_and_no_others(
    interface: type[Any], to_write: set[str]
) -> None:
    assert interface.__abstractmethods__ == to_write
    with pytest.raises(TypeError, match="abstract"):
        interface()


def test_everything_that_the_author_of_a_transport_reads_has_a_docstring() -> None:
    interfaces = [
        value for name, value in vars(abc).items() if inspect.isclass(value) and name in abc.__all__
    ]
    assert len(interfaces) == 18
    for interface in interfaces:
        assert inspect.getdoc(interface)
        for name, member in vars(interface).items():
            if name[0] != "_" and (callable(member) or isinstance(member, property)):
                assert inspect.getdoc(member), f"{interface.__name__}.{name}"


class SomeGoals(StatusStream):
    """Tells of goals, and then that the server has stopped."""

    def __init__(self, known: int, *stamps: int) -> None:
        self.known = known
        self._infos = deque(GoalInfo(KNOWN, stamp, GoalStatus.EXECUTING) for stamp in stamps)

    @property
    def dropped(self) -> int:
        return 0

    def fail(self, error: ActionError) -> None:
        raise NotImplementedError

    async def receive(self) -> GoalInfo | None:
        return self._infos.popleft() if self._infos else None

    def close(self) -> None:
        raise NotImplementedError


@pytest.mark.asyncio
@pytest.mark.parametrize(("known", "listed"), [(0, []), (2, [1, 2]), (9, [1, 2, 3])])
async def test_the_goals_that_there_were_are_the_first_that_come(
    known: int, listed: list[int]
) -> None:
    statuses = SomeGoals(known, 1, 2, 3)
    assert [info.stamp for info in await statuses.listed()] == listed


@pytest.mark.asyncio
async def test_a_forwarding_endpoint_passes_every_call_on() -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    wrapper = ForwardingEndpoint(ForwardingEndpoint(server))
    assert wrapper.absence is None
    assert isinstance(wrapper, Startable)
    assert wrapper.info == server.info
    assert not wrapper.is_running
    with anyio.fail_after(5):
        async with wrapper:
            assert server.is_running
            assert wrapper.is_running
            await wrapper.wait_for_server()
            client = ActionClient(wrapper, FIBONACCI)
            assert await client.call(Goal(2)) == Result([0, 1, 1])
            (known,) = await client.goals()
            assert (await client.attach(known.goal_id)).status is GoalStatus.SUCCEEDED
            # The goal has one feedback, and none of it is of another attempt.
            for attempt, place in ((1, 1), (2, 0)):
                stream = await wrapper.feedback(known.goal_id, after=1, attempt=attempt)
                assert (stream.attempt, stream.cursor) == (1, place)
            sender = Sender(owner=b"ann")
            goal = FIBONACCI.goal.encode(Goal(1))
            await wrapper.send_goal(OTHER, goal, sender=sender)
            assert wrapper.owner_of(OTHER) == b"ann"
            answer = await client.cancel_goals(known.goal_id)
            assert answer.return_code is CancelCode.GOAL_TERMINATED
            await wrapper.stop()
            assert not server.is_running


@pytest.mark.asyncio
async def test_around_an_endpoint_without_a_life_of_its_own_there_is_nothing_to_start() -> None:
    wrapper = ForwardingEndpoint(OneGoal(OneEnd()))
    assert wrapper.is_running
    assert wrapper.owner_of(KNOWN) == b""
    async with wrapper as entered:
        assert entered is wrapper
        await wrapper.stop()


def test_a_stream_does_not_know_the_goal_itself_unless_it_says_so() -> None:
    assert OneEnd().goal is None
    end = OneEnd()
    end.goal_id, end.stamp = GoalID(bytes(16)), 7
    assert end.info == GoalInfo(end.goal_id, end.stamp, end.status)


class Held(OneEnd):
    """A stream that remembers whether the executor is to wait for it."""

    wanted = True

    def hold(self, wanted: bool) -> None:
        self.wanted = wanted


def test_a_stream_that_cannot_limit_the_time_does_not_make_the_executor_wait() -> None:
    stream = Held()
    stream.hold_briefly()
    assert not stream.wanted


class Rich(OneGoal):
    """An endpoint with a history, levers, a log, and goals that can be run again."""

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        return [GoalInfo(KNOWN, page.limit, GoalStatus.SUCCEEDED)]

    async def change_intake(self, change: IntakeChange) -> Intake:
        return Intake(change.mode)

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        return goal_id

    async def log_lines(self, goal_id: GoalID) -> list[abc.LogLine] | None:
        return [abc.LogLine(1, "INFO", "arm", str(goal_id))]


@pytest.mark.asyncio
async def test_an_endpoint_has_what_it_says_only_and_a_wrapper_what_is_inside() -> None:
    plain, wrapper = OneGoal(OneEnd()), ForwardingEndpoint(Rich(OneEnd()))
    assert await plain.past_goals(PastPage()) == []
    assert [info.stamp for info in await wrapper.past_goals(PastPage(limit=5))] == [5]
    read: list[GoalInfo] = []
    await wrapper.read_past(GoalQuery(), read.extend)
    assert len(read) == 1
    with pytest.raises(TransportError, match="cannot be paused or drained from here"):
        await plain.change_intake(IntakeChange(IntakeMode.HOLD))
    paused = await wrapper.change_intake(IntakeChange(IntakeMode.HOLD))
    assert paused == Intake(IntakeMode.HOLD)
    assert await wrapper.intake() is FIXED_INTAKE
    with pytest.raises(TransportError, match="cannot be run again from here"):
        await plain.rerun(KNOWN)
    assert await wrapper.rerun(KNOWN) == KNOWN
    assert await plain.log_lines(KNOWN) is None
    assert [line.text for line in await wrapper.log_lines(KNOWN) or ()] == [str(KNOWN)]


@pytest.mark.asyncio
async def test_a_wrapper_with_a_history_of_its_own_has_it_read_as_a_whole() -> None:
    class Past(ForwardingEndpoint):
        async def past_goals(self, page: PastPage) -> list[GoalInfo]:
            return [GoalInfo(KNOWN, 7, GoalStatus.SUCCEEDED)]

    read: list[GoalInfo] = []
    await Past(OneGoal(OneEnd(Outcome(GoalStatus.SUCCEEDED)))).read_past(GoalQuery(), read.extend)
    assert [info.stamp for info in read] == [7]
