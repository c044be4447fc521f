"""What goes on when a connection is lost: goals and their owners at the server's end, calls at the
client's, and both together.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # its clock can be put forward
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from contextlib import AsyncExitStack
from functools import partial
from typing import Any, Literal

import anyio
import pytest

from fibaction import ActionServer
from fibaction.border.abc import Connection
from fibaction.testing import ScriptedServer
from fibaction.wire.auth import Permission
from fibaction.wire.link import HIGH_WATER, OVERFULL
from fibaction.wire.messages import (
    VERSION,
    AwaitServer,
    Close,
    Done,
    Ended,
    Failed,
    Feedback,
    Follow,
    Following,
    GoalChanged,
    Goodbye,
    ListActions,
    Received,
    Rejected,
    SendGoal,
    StatusChanged,
    Watching,
    WatchStatus,
    Welcome,
    Why,
    encode,
)
from fibaction.wire.server.ownership import EndOnly
from fibaction.wire.settings import ClientSettings, Limits, WireSettings
from fibaction.words.errors import AuthenticationFailed, ConnectionLost, ServerNotFound
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalStatus
from tests.support import fibonacci as fib
from tests.support.fibonacci import FIBONACCI
from tests.support.slices import let_slices_last
from tests.support.virtual_time import in_virtual_time
from tests.wire.ends import (
    ANN,
    ANY,
    AWAY,
    BOB,
    CALLS,
    EXECUTING,
    GOAL,
    GOAL_ID,
    SUCCEEDED,
    WHERE,
    WINDOW,
    A,
    Network,
    Server,
    asked_again,
    endpoint_of,
    feedback,
    follow,
    following,
    goal_of,
    held,
    is_used,
    kinds,
    numbers_of,
    observed,
    outcome_of,
    reached,
    running,
    send,
    serving,
    talking,
    update_of,
    watched,
)
from tests.wire.memory import LONG, MemoryChannel, Running, logged, settled

pytestmark = pytest.mark.anyio

forgotten_or_not = pytest.mark.parametrize("result_timeout", [10, 0])
"""Whether the server still knows a goal that has ended, or only its owner's session does."""
every_call = pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)


# At the server: an end, and the feedback before it, until their client has heard of them


async def test_an_end_that_was_lost_is_told_though_its_id_is_used_by_another_client() -> None:
    async def executor(goal: Any) -> AsyncGenerator[fib.Feedback | fib.Result, None]:
        if goal.request.order == 99:
            await anyio.sleep_forever()
        yield fib.Result([])

    server = ActionServer(FIBONACCI, executor, result_timeout=0)
    async with serving(server) as served:
        ann = await served.greet(ANN)
        mine = await ann.ask(send(1), Following)
        await ann.hear_all()
        ann.channel.cut()
        bob = await served.greet(BOB)
        other = SendGoal(1, "fibonacci", A, FIBONACCI.goal.encode(fib.Goal(99)), ANY)
        assert (await bob.ask(other, Following)).stamp != mine.stamp
        ann = await served.greet(ANN)
        assert (await ann.ask(follow(0), Following)).stamp == mine.stamp
        assert [type(told) for told in await ann.hear_all()] == [Ended]
        assert (await ann.ask(follow(0, request=3, own=False), Following)).stamp != mine.stamp


async def test_an_end_that_was_lost_is_told_to_its_own_client_only() -> None:
    async with serving(running(fib.Result([]), result_timeout=0)) as served:
        client = await served.greet(ANN)
        await client.say(send(1))
        await client.hear_all()
        client.channel.cut()
        for session in (BOB, b""):
            other = await served.greet(session)
            assert (await other.ask(follow(0), Failed)).why == Why.UNKNOWN_GOAL
        ann = await served.greet(ANN)
        assert (await ann.ask(follow(0, own=False), Failed)).why == Why.UNKNOWN_GOAL
        # And as often as that client follows its goal.
        await ann.say(follow(0, request=2), follow(0, request=3))
        heard = await ann.hear_by_id()
        assert [kinds(heard[request]) for request in (2, 3)] == [[Following, Ended]] * 2


async def test_an_end_is_not_told_again_after_a_goodbye() -> None:
    async with serving(running(fib.Result([]), result_timeout=0)) as served:
        client = await served.greet()
        await client.say(send(1))
        await client.hear_all()
        await client.say(Goodbye("I know enough"))
        await client.hear_the_end()
        again = await served.greet()
        assert (await again.ask(follow(0), Failed)).why == Why.UNKNOWN_GOAL


@in_virtual_time()
@forgotten_or_not
@pytest.mark.parametrize("then", ["keep", "cancel"])
async def test_an_end_is_kept_as_long_as_its_client_has_to_come_back(
    result_timeout: float, then: Literal["keep", "cancel"]
) -> None:
    server = running(*feedback(1), fib.Result([]), result_timeout=result_timeout)
    async with serving(server, grace=50, then=then) as served:
        client = await served.greet()
        await client.send(1)
        await client.hear_all()
        with logged() as lines:
            for _ in range(2):  # each loss has the whole time
                client.channel.cut()
                await anyio.sleep(49)
                client = await served.greet()
                assert (await client.ask(follow(1), Following)).status == SUCCEEDED
                assert kinds(await client.hear_all()) == [Ended]
            await anyio.sleep(200)  # a client that is here has any time
            client.channel.cut()
            await anyio.sleep(51)
        assert not any("canceling" in line.getMessage() for line in lines)
        late = await served.greet()
        assert (await late.ask(follow(1), Failed)).why == Why.UNKNOWN_GOAL


@in_virtual_time()
async def test_over_a_limit_the_ends_that_were_lost_first_are_given_up_first() -> None:
    server = running(fib.Result([]), result_timeout=0)
    limits = Limits(heartbeat=LONG, lost=3)
    async with serving(server, limits=limits, grace=50) as served:
        names = [bytes([number]) * 16 for number in range(1, 5)]
        for name in names:
            client = await served.greet(name)
            await client.send(1, name)
            await client.hear_all()
            client.channel.cut()
            await settled()
        answers: list[type] = []
        for name in names:
            client = await served.greet(name)
            await client.say(Follow(1, "fibonacci", name, None, own=True, credit=0))
            answers += kinds(await client.hear_all())[:1]
        assert answers == [Failed, Following, Following, Following]


# At the server: a goal that goes on


async def status_of(server: Server) -> GoalStatus:
    stream = await server.feedback(GOAL_ID)
    await settled()
    return stream.status


async def test_a_goal_that_is_kept_does_not_wait_after_a_goodbye() -> None:
    server = talking()
    async with serving(server) as served:
        client = await served.greet()
        await client.send(1, credit=1)
        await client.say(Goodbye("done"))
        await client.hear_all()
        assert await status_of(server) is SUCCEEDED


@in_virtual_time()
async def test_a_goal_whose_client_does_not_come_back_is_canceled_after_the_grace() -> None:
    server = held()
    async with serving(server, then="cancel", grace=10) as served:
        client = await served.greet()
        await client.send(1)
        with logged() as lines:
            client.channel.cut()
            await anyio.sleep(9.9)
            assert await status_of(server) is EXECUTING
            await anyio.sleep(0.2)
            assert await status_of(server) is GoalStatus.CANCELED
        assert [line.getMessage() for line in lines[1:]] == [
            "canceling the goals of a client that has not come back: 1"
        ]


@in_virtual_time()
async def test_a_client_that_comes_back_while_its_goal_is_being_canceled_is_told_the_end() -> None:
    asked, go = anyio.Event(), anyio.Event()

    async def decide(goal: Any) -> None:
        asked.set()
        await go.wait()

    server = running(anyio.Event(), on_cancel=decide)
    async with serving(server, then="cancel", grace=10) as served:
        client = await served.greet()
        await client.send(1)
        client.channel.cut()
        await asked.wait()
        client = await served.greet()
        assert (await client.ask(follow(None), Following)).status == EXECUTING
        go.set()
        ended = [message for message in await client.hear_all() if type(message) is Ended]
        assert [message.status for message in ended] == [GoalStatus.CANCELED]


@in_virtual_time()
async def test_a_client_that_came_back_is_not_waited_for_any_longer() -> None:
    async with serving(held(), grace=1e9) as served:
        client = await served.greet()
        await client.send(1)
        counts = set()
        for _ in range(3):
            await settled()
            counts.add(len(anyio.get_running_tasks()))
            client.channel.cut()
            await settled()
            client = await served.greet()
            await client.ask(follow(0), Following)
        assert len(counts) == 1


async def test_the_goal_of_a_client_that_leaves_is_canceled_at_once() -> None:
    async with serving(held(), then="cancel") as served:
        client, other = await served.greet(ANN), await served.greet(BOB)
        await client.send(1)
        await other.ask(follow(None, own=False), Following)
        await client.say(Goodbye("done"))
        assert [message.status for message in await other.hear_all()] == [3, 5]


async def test_a_client_that_may_only_send_may_follow_its_own_goals_again() -> None:
    access = WireSettings(authorize=lambda _, __, verb: verb is Permission.SEND)
    async with serving(held(), access=access) as served:
        client = await served.greet(ANN)
        await client.send(1)
        client.channel.cut()
        for session in (BOB, b""):
            other = await served.greet(session)
            assert (await other.ask(follow(0), Failed)).why == Why.FORBIDDEN
        ann = await served.greet(ANN)
        assert (await ann.ask(follow(0), Following)).status == EXECUTING


@pytest.mark.parametrize("error", [ConnectionLost("the gateway is away"), ValueError("a bug")])
async def test_a_goal_that_cannot_be_canceled_is_logged_and_harms_no_other(
    error: Exception,
) -> None:
    class Failing(ScriptedServer[fib.Goal, fib.Feedback, fib.Result]):
        async def cancel_goals(self, *args: Any, **kwargs: Any) -> Any:
            raise error

    async with serving(Failing(FIBONACCI, [anyio.Event()]), then="cancel") as served:
        client, other = await served.greet(ANN), await served.greet(BOB)
        await client.send(1)
        with logged() as lines:
            await client.say(Goodbye("done"))
            await client.hear_the_end()
            await settled()
        told = [line.getMessage() for line in lines]  # that the connection ends comes as well
        assert f"goal {GOAL_ID} could not be canceled: {error}" in told
        assert await other.is_served()


# At the server: a goal that was sent twice


@pytest.mark.parametrize("again", [[follow(0, request=1), send(2)], [send(1), send(2)]])
@pytest.mark.parametrize("is_told", [False, True])
async def test_each_copy_of_a_goal_that_was_sent_twice_is_told_the_end_that_was_lost(
    again: list[Any], is_told: bool
) -> None:
    """The server has forgotten the goal, and has heard of the second copy, or not."""
    server = running(*feedback(1), fib.Result([]), result_timeout=0)
    async with serving(server) as served:
        client = await served.greet()
        first = await client.send(1)
        if is_told:
            await client.say(send(2))
        await client.hear_all()
        client.channel.cut()
        client = await served.greet()
        await client.say(*again)
        heard = await client.hear_by_id()
        for request in (1, 2):
            begin, *_, end = heard[request]
            assert (begin.stamp, end.status, end.place) == (first.stamp, SUCCEEDED, 1)


async def test_a_goal_that_is_sent_again_before_its_end_was_confirmed_runs_once() -> None:
    server = running(*feedback(1), fib.Result([]), result_timeout=0)
    async with serving(server) as served:
        client = await served.greet()
        first = await client.send(1)
        await client.hear_all()
        again = await client.ask(send(2), Following)
        assert (again.stamp, again.place) == (first.stamp, 0)
        assert (await client.ask(Close(2), Ended)).place == 1
        other = SendGoal(3, "fibonacci", A, FIBONACCI.goal.encode(fib.Goal(4)), ANY)
        assert kinds(await client.ask_all(other)) == [Rejected]


async def test_goals_of_lost_connections_are_released_a_few_at_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """So that losing a client with thousands of goals does not stop the others."""
    let_slices_last(monkeypatch, 0)
    ids = [bytes([number] * 16) for number in range(1, 51)]
    server = running(*feedback(*range(100)), fib.Result([]), feedback_window=4)
    turns: list[int] = []

    async def watch() -> None:
        while True:
            await anyio.lowlevel.checkpoint()
            streams = [await server.feedback(GoalID(goal_id)) for goal_id in ids]
            ended = sum(stream.status.is_terminal for stream in streams)
            turns.append(ended)

    async with serving(server) as served, anyio.create_task_group() as tasks:
        client = await served.greet()
        await client.say(*(send(number, goal_id, 1) for number, goal_id in enumerate(ids)))
        await client.hear_all()
        tasks.start_soon(watch)
        await client.say(Goodbye("done"))
        with anyio.fail_after(5):
            while not turns or turns[-1] < len(ids):
                await anyio.lowlevel.checkpoint()
        tasks.cancel_scope.cancel()
    assert len(set(turns)) > 10


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_all_goals_are_let_go_if_the_task_that_closes_the_server_is_canceled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    let_slices_last(monkeypatch, 0)
    ids = [bytes([number] * 16) for number in range(1, 21)]
    server = running(*feedback(*range(100)), fib.Result([]), feedback_window=4)
    async with serving(server) as served:
        client = await served.greet()
        await client.say(*(send(number, goal_id, 1) for number, goal_id in enumerate(ids)))
        await client.hear_all()
        closing = asyncio.create_task(served.wire._owners.aclose())
        for _ in range(3):
            await anyio.lowlevel.checkpoint()
        closing.cancel()
        await asyncio.wait([closing])
        assert closing.cancelled()
        streams = [await server.feedback(GoalID(goal_id)) for goal_id in ids]
        await settled()
        assert all(stream.status is SUCCEEDED for stream in streams)


async def test_the_end_of_a_goal_can_be_told_once_more_without_its_feedback() -> None:
    async with running(*feedback(1, 2), fib.Result([])) as server:
        stream = await server.send_goal(GOAL_ID, GOAL)
        outcome = await stream.outcome()
        assert len(stream.take(2) or stream.take(2)) == 1
        stream.seek(2)
        end = EndOnly(stream)
        for cursor, place, dropped in ((0, 0, 2), (9, 2, 0)):
            end.seek(cursor)
            assert (end.cursor, end.dropped) == (place, dropped)
        end.hold(True)
        end.close()
        end.fail(ConnectionLost("it is over anyway"))
        assert (end.take(), end.known_outcome(), end.cursor) == ((outcome,), outcome, 2)
        assert (end.goal_id, end.stamp, end.status) == (GOAL_ID, stream.stamp, SUCCEEDED)
        assert end.info == stream.info


# At the client: calls


@in_virtual_time()
@pytest.mark.parametrize(
    ("timeout", "sent"),
    [
        (None, [None, None, None]),
        (1.5, [1.5, 0.5, 0.001]),  # 0 is not a timeout
        (2e9, [None, None, None]),  # more than a message can contain
    ],
)
async def test_a_goal_is_sent_again_with_the_time_that_is_left(
    timeout: float | None, sent: list[float | None]
) -> None:
    network = Network()
    async with reached(network) as (connection, server):
        sending = Running(lambda: endpoint_of(connection).send_goal(GOAL_ID, b"", timeout=timeout))
        async with sending:
            message = await server.hear(SendGoal)
            for seconds in sent:
                assert message.timeout == (
                    None if seconds is None else pytest.approx(seconds, 0.05)
                )
                await anyio.sleep(1)
                server, message = await asked_again(network, server, SendGoal)


async def test_a_server_that_lets_the_client_in_no_more_is_left_for_good() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with Running(connection.actions) as asking:
            await server.hear(ListActions)
            await server.say(Goodbye("the token has expired", Why.FORBIDDEN))
            with pytest.raises(AuthenticationFailed, match="the token has expired"):
                await asking.answer()
        with pytest.raises(AuthenticationFailed) as caught:
            await connection.actions()
        assert str(caught.value) == f"{WHERE}: the token has expired"
    assert network.dialed == 1


async def test_calls_to_be_made_again_may_be_more_than_the_queue_of_a_connection_takes() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        network.refusal = AWAY
        server.channel.cut()
        await settled()
        async with AsyncExitStack() as stack:
            for number in range(5 * OVERFULL):
                goal_id = GoalID(bytes([number] * 16))
                call = partial(endpoint_of(connection).send_goal, goal_id, bytes(HIGH_WATER // 2))
                await stack.enter_async_context(Running(call))
            network.refusal = None
            server = await network.accept()
            numbers = [(await server.hear(SendGoal)).goal_id[0] for _ in range(5 * OVERFULL)]
            assert numbers == list(range(5 * OVERFULL))


@pytest.mark.parametrize("is_lost", [True, False])
async def test_a_call_that_waits_for_room_is_sent_once_if_it_is_not_given_up(
    is_lost: bool,
) -> None:
    network = Network()
    async with reached(network) as (connection, server):
        server.channel.stop_reading()
        send_goal = endpoint_of(connection).send_goal
        async with Running(lambda: send_goal(GOAL_ID, bytes(HIGH_WATER))):
            async with Running(lambda: send_goal(GoalID(bytes([2] * 16)), b"given up")):
                pass
            async with Running(lambda: send_goal(GoalID(bytes([3] * 16)), b"small")):
                if is_lost:
                    server.channel.cut()
                    server = await network.accept()
                else:
                    server.channel.go_on_reading()
                heard = await server.hear_all()
                sent = [len(one.goal) for one in heard if isinstance(one, SendGoal)]
                assert sent == [HIGH_WATER, 5]


# At the client: goals and statuses


async def test_an_observer_stays_one() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        kept, kept_id = await observed(connection, server, place=5)
        left, left_id = await observed(connection, server, place=5)
        left.close()
        assert await server.hear(Close) == Close(left_id)
        del left
        assert await server.hear(Received) == Received(left_id)
        server.channel.cut()
        server = await network.accept()
        (again,) = await server.hear_all()
        assert again == Follow(kept_id, "fibonacci", GOAL_ID, 5, False, WINDOW)
        ended = Ended(kept_id, SUCCEEDED, b"result", "", 5)
        await server.say(following(again, place=5), ended)
        assert (await outcome_of(kept)).result == b"result"
        assert await server.hear_all() == [Received(kept_id)]


@pytest.mark.parametrize("stamp", [None, 8], ids=["forgotten", "another of its ID"])
async def test_a_goal_that_the_server_does_not_have_any_more_is_unknown(stamp: int | None) -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            await server.say(Feedback(call_id, 1, b""))
            await settled()
            server, asked = await asked_again(network, server, Follow)
            if stamp is None:
                await server.say(Failed(call_id, Why.UNKNOWN_GOAL, "unknown"))
            else:
                await server.say(following(asked, stamp=stamp))
                assert await server.hear(Close) == Close(call_id)
            assert (await outcome_of(goal)).status is GoalStatus.UNKNOWN
            assert await numbers_of(goal) == [1]  # what has come, has come


async def test_a_status_that_changed_between_two_connections_is_told_once() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with goal_of(connection, server, status=GoalStatus.ACCEPTED) as (goal, call_id):
            for status in (GoalStatus.ACCEPTED, EXECUTING, EXECUTING):
                server, asked = await asked_again(network, server, Follow)
                await server.say(following(asked, status=status))
            await server.say(StatusChanged(call_id, EXECUTING), Feedback(call_id, 1, b""))
            assert await update_of(goal) is EXECUTING
            assert await numbers_of(goal, 1) == [1]
            server, asked = await asked_again(network, server, Follow)
            # It has ended meanwhile, and what came before that is told behind it.
            await server.say(following(asked, status=GoalStatus.CANCELED, place=1))
            await server.say(StatusChanged(call_id, GoalStatus.CANCELING))
            await server.say(Feedback(call_id, 2, b""))
            assert (await update_of(goal)).number == 2
            assert goal.status is GoalStatus.CANCELED


def changes(call_id: int, *stamps: int, dropped: int = 0) -> Sequence[GoalChanged]:
    return [
        GoalChanged(call_id, bytes([stamp] * 16), stamp, EXECUTING, dropped) for stamp in stamps
    ]


async def test_statuses_are_watched_again_behind_what_has_come_before() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        statuses, call_id = await watched(connection, server)
        await server.say(*changes(call_id, 1, 2, dropped=3))
        await settled()
        assert (await statuses.receive()).stamp == 1
        server, asked = await asked_again(network, server, WatchStatus)
        assert asked == WatchStatus(call_id, "fibonacci", WINDOW)
        await server.say(Watching(call_id, 2), *changes(call_id, 3, 4, 5, dropped=1))
        await settled()
        assert (statuses.dropped, statuses.known) == (4, 4)
        for _ in range(3):
            server, asked = await asked_again(network, server, WatchStatus)
        await server.say(Watching(call_id, 0))
        assert [(await statuses.receive()).stamp for _ in range(4)] == [2, 3, 4, 5]


# At the client: for how long


@in_virtual_time()
@every_call
async def test_a_call_waits_for_the_next_connection_so_long_and_no_longer(
    call: Callable[[Connection], Awaitable[Any]],
) -> None:
    network = Network()
    async with reached(network) as (connection, server):
        network.refusal = ServerNotFound("the line is dead")
        server.channel.cut()
        await settled()
        async with Running(lambda: call(connection)) as calling:
            await anyio.sleep(29)
            assert not calling.is_done
            # There was a server, so this is not `ServerNotFound`.
            with pytest.raises(ConnectionLost, match=r"^the line is dead$"):
                await calling.answer()
        with anyio.fail_after(0.1), pytest.raises(ServerNotFound):
            await call(connection)
        network.refusal = None
        server = await network.accept()
        await settled()
        await is_used(connection, server)


@in_virtual_time()
@pytest.mark.parametrize("hangs", ["dial", "welcome"])
async def test_a_call_does_not_wait_for_an_attempt_that_hangs(hangs: str) -> None:
    network = Network()
    settings = ClientSettings(heartbeat=LONG, reconnect_timeout=6)
    async with reached(network, settings) as (connection, server):
        network.hangs = hangs == "dial"
        server.channel.cut()
        await settled()
        async with Running(connection.actions) as asking:
            await anyio.sleep(5.9)
            assert not asking.is_done
            with pytest.raises(ConnectionLost):
                await asking.answer(within=0.2)
        network.hangs = False
        server = await network.accept()
        await settled()
        await is_used(connection, server)


class Late(MemoryChannel):
    """A connection whose first message comes at a certain time."""

    at: float | None = None

    async def receive(self) -> list[bytes]:
        if self.at is not None:
            await anyio.sleep_until(self.at)
            self.at = None
            return [encode(Welcome(VERSION, LONG))]
        return await super().receive()


class LateNetwork(Network):
    """A network whose next connection comes at a certain time."""

    at: float | None = None

    async def dial(self) -> MemoryChannel:
        channel = await super().dial()
        if self.at is not None:
            channel.__class__ = Late
            vars(channel)["at"] = self.at
        return channel


@pytest.mark.parametrize("anyio_backend", ["asyncio"])  # where both have their turn
@pytest.mark.parametrize("is_early", [True, False])
async def test_a_connection_that_comes_back_in_the_last_moment_is_used(
    is_early: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    network, loop, passed = LateNetwork(), asyncio.get_running_loop(), [0.0]
    time = loop.time
    monkeypatch.setattr(loop, "time", lambda: time() + passed[0])
    async with reached(network) as (connection, server):
        async with (
            Running(endpoint_of(connection).wait_for_server) as waiting,
            Running(connection.actions) as asking,
        ):
            network.at = anyio.current_time() + 30 + (-1 if is_early else 1)
            server.channel.cut()
            server, _ = await network.reached()
            await settled()
            passed[0] = (
                60.0  # so that the connection, and the end of the wait for it, come together
            )
            await settled()
            assert asking.is_done is not is_early
            for message in await server.hear_all():
                await server.say(Done(message.id))
            await waiting.answer()


@pytest.mark.parametrize("reconnects", [True, False])
async def test_a_wait_for_an_action_that_is_not_served_goes_on_at_the_next_server(
    reconnects: bool,
) -> None:
    network = Network()
    settings = ClientSettings(heartbeat=LONG, reconnect=reconnects)
    async with reached(network, settings) as (connection, server):
        async with Running(endpoint_of(connection).wait_for_server) as waiting:
            failed = Failed((await server.hear(AwaitServer)).id, Why.SERVER_NOT_FOUND, "no such")
            await server.say(failed)
            await settled()
            assert not waiting.is_done
            server.channel.cut()
            if reconnects:
                server = await network.accept()
                await server.say(Done((await server.hear(AwaitServer)).id))
                await waiting.answer()
            else:
                with pytest.raises(ConnectionLost, match="closed its side"):
                    await waiting.answer()
