"""Goals, cancels, results and logs of a fleet, at whichever worker they are."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from typing import Any

import anyio
import pytest
from msgspec.structs import replace

from fibaction import (
    Action,
    ActionPeers,
    CancelCode,
    ConnectionLost,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    InvalidMessage,
    Parent,
    Schedule,
    ServerNotFound,
    StoreError,
    TransportError,
    UnknownGoal,
)
from fibaction.border.abc import Endpoint, ForwardingEndpoint, GoalRequest, LogLine
from fibaction.words.goals import CancelAnswer, digest_of
from fibaction.words.intake import IntakeChange, IntakeMode
from fibaction_transports.nats.broker.broker import BrokerAway
from fibaction_transports.nats.client.free_workers import OFFER_LIFE
from tests.support.matching import End
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.fake_fleet import (
    COUNT,
    ENDED,
    GOAL_ID,
    MINUS_THREE,
    NAMES,
    THREE,
    FakeFleet,
    FakeWorker,
    client_of,
    server,
)
from tests.wire.memory import Running

pytestmark = [pytest.mark.anyio, in_virtual_time()]


@pytest.fixture
def fleet() -> FakeFleet:
    return FakeFleet()


class _Mute(ForwardingEndpoint):
    """An endpoint that never answers a goal."""

    def __init__(self, inner: Endpoint) -> None:
        super().__init__(inner)
        self.asked = anyio.Event()

    async def offer_goal(self, request: GoalRequest) -> Any:
        self.asked.set()
        await anyio.sleep_forever()


class _Answering(ForwardingEndpoint):
    """An endpoint that answers each cancel with a code."""

    def __init__(self, inner: Endpoint, code: CancelCode) -> None:
        super().__init__(inner)
        self._code = code

    async def cancel_goals(
        self, _goal_id: GoalID | None = None, _stamp: int | None = None
    ) -> CancelAnswer:
        return CancelAnswer(self._code)


# To send a goal


async def test_goals_are_run_by_all_workers_in_turn(fleet: FakeFleet) -> None:
    async with fleet.serving("a", "b"), fleet.connect() as connection:
        client = client_of(connection)
        assert client.endpoint.info == COUNT.info
        for _ in range(4):
            assert await client.call(3) == "3"
            await anyio.sleep(OFFER_LIFE)  # until then, its place is for the next one
        assert sorted(fleet.lines.dialed) == ["a", "b"]  # once each


async def test_a_fleet_is_absent_while_its_brokers_are_away(fleet: FakeFleet) -> None:
    async with fleet.connect() as connection:
        endpoint = connection.endpoint(COUNT)
        assert endpoint.absence is None
        fleet.broker.is_away = True
        absence = endpoint.absence
        assert absence is not None
        assert endpoint.absence == absence  # since the same time
        fleet.broker.is_away = False
        assert endpoint.absence is None


async def test_a_goal_larger_than_a_record_is_not_sent(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        with pytest.raises(InvalidMessage, match="the goal has 1048576 bytes, and 1044480 are"):
            await connection.endpoint(COUNT).send_goal(GOAL_ID, bytes(2**20))
        with pytest.raises(InvalidMessage, match="the goal has 1044490 bytes, and 1044480 are"):
            meta = {"trace": "12345"}
            await connection.endpoint(COUNT).send_goal(GOAL_ID, bytes(1044480), meta=meta)
        assert not a.asked


async def test_a_worker_that_is_busy_by_now_is_left_for_another(fleet: FakeFleet) -> None:
    async with (
        fleet.worker("a").serve(server(schedule=Schedule(concurrency=1))),
        fleet.worker("b").serve(server(schedule=Schedule(concurrency=1))),
        fleet.connect() as connection,
    ):
        client = client_of(connection)
        await client.send_goal(-1)
        assert [await client.call(3) for _ in range(4)] == ["3"] * 4
        await client.send_goal(-1)
        with pytest.raises(GoalRejected, match="busy: 1 of 1 running"):
            await client.call(3)


async def test_a_worker_whose_server_has_stopped_is_left_for_another(fleet: FakeFleet) -> None:
    stopping = server()
    async with fleet.worker("a").serve(stopping), fleet.connect() as connection:
        await stopping.stop()
        with pytest.raises(ServerNotFound, match="is not running"):
            await client_of(connection).call(3)
        async with fleet.worker("b").serve(server()):
            assert [await client_of(connection).call(3) for _ in range(2)] == ["3", "3"]


async def test_an_action_that_no_worker_serves_is_not_found(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()), fleet.connect() as connection:
        endpoint = connection.endpoint(Action("fly", goal=int, feedback=int, result=str))
        text = "the action 'fly' is not served in this fleet: there is 'count'"
        for ask in (
            lambda: endpoint.send_goal(GOAL_ID, THREE),
            lambda: endpoint.feedback(GOAL_ID),
            endpoint.cancel_goals,
            endpoint.status,
        ):
            with pytest.raises(ServerNotFound, match=text):
                await ask()


@pytest.mark.parametrize("is_frozen", [False, True])
async def test_a_goal_goes_elsewhere_if_its_worker_is_lost_before_the_answer(
    fleet: FakeFleet, is_frozen: bool
) -> None:
    mute = _Mute(server())
    async with fleet.worker("a").serve(mute) as a, fleet.connect() as connection:
        async with Running(lambda: client_of(connection).call(3)) as calling:
            await mute.asked.wait()
            async with fleet.worker("b").serve(server()):
                a.deafen()
                if is_frozen:
                    a.end_lease()  # its line is open
                else:
                    a.hang_up()  # its lease goes on for a while
                assert await calling.answer() == "3"


async def test_a_goal_whose_answer_is_lost_is_found_at_the_worker_that_has_it(
    fleet: FakeFleet,
) -> None:
    mute = _Mute(server())
    async with fleet.worker("a").serve(mute) as a, fleet.connect() as connection:
        endpoint = connection.endpoint(COUNT)
        async with Running(lambda: endpoint.send_goal(GOAL_ID, THREE)) as sending:
            await mute.asked.wait()
            async with fleet.worker("b").serve(server()) as b:
                b.deafen()
                b.own(GOAL_ID)
                b.take_over("count", GOAL_ID)
                a.die()
                goal = await sending.answer()
                assert (goal.stamp, fleet.lines.dialed[-1]) == (7, "b")


async def test_a_goal_that_was_sent_before_has_the_same_answer(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        endpoint = connection.endpoint(COUNT)
        first = await endpoint.send_goal(GOAL_ID, THREE)
        assert await first.outcome() == End(GoalStatus.SUCCEEDED, COUNT.result.encode("3"))
        a.deafen()  # a question is not needed for it
        again = await endpoint.send_goal(GOAL_ID, THREE)
        assert (again.stamp, await again.outcome()) == (first.stamp, await first.outcome())
        with pytest.raises(GoalRejected, match="its ID is in use by another goal"):
            await endpoint.send_goal(GOAL_ID, MINUS_THREE)


async def test_a_goal_that_has_ended_is_answered_without_its_worker(fleet: FakeFleet) -> None:
    gone = FakeWorker(fleet.broker, "gone")
    gone.own(GOAL_ID, **ENDED, meta={"parent": "07" * 16, "step": "count"})
    async with fleet.connect() as connection:
        endpoint = connection.endpoint(COUNT)
        again = await endpoint.send_goal(GOAL_ID, THREE)
        assert await again.outcome() == End(GoalStatus.SUCCEEDED, COUNT.result.encode("3"))
        with pytest.raises(GoalRejected, match="its ID is in use by another goal"):
            await endpoint.send_goal(GOAL_ID, MINUS_THREE)
        followed = await endpoint.feedback(GOAL_ID, after=-1)
        assert (followed.stamp, followed.cursor, followed.dropped) == (7, 3, 0)
        assert followed.info.parent == Parent(GoalID(b"\7" * 16), "count")
        assert (await endpoint.get_result(GOAL_ID)).status is GoalStatus.SUCCEEDED
        answer = await endpoint.cancel_goals(GOAL_ID)
        assert answer == CancelAnswer(CancelCode.GOAL_TERMINATED)


# To follow a goal


async def test_a_goal_whose_owner_is_gone_is_found_at_the_next_one(fleet: FakeFleet) -> None:
    gone = FakeWorker(fleet.broker, "gone")
    gone.own(GOAL_ID, goal=MINUS_THREE, digest=digest_of(MINUS_THREE), attempt=0)
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        endpoint = connection.endpoint(COUNT)
        async with (
            Running(lambda: endpoint.feedback(GOAL_ID)) as asking,
            Running(lambda: endpoint.cancel_goals(GOAL_ID)) as canceling,
        ):
            await anyio.sleep(3)
            a.take_over("count", GOAL_ID)
            assert (await asking.answer()).stamp == 7
            assert (await canceling.answer()).accepted


@pytest.mark.parametrize(
    ("owner", "former"), [("gone", "'gone', which had it, is gone"), ("", "it was released")]
)
async def test_a_goal_whose_owner_is_gone_is_lost_after_a_while(
    fleet: FakeFleet, owner: str, former: str
) -> None:
    FakeWorker(fleet.broker, owner).own(GOAL_ID)
    async with (
        fleet.worker("a").serve(server()),
        fleet.connect(reconnect_timeout=8) as connection,
    ):
        endpoint = connection.endpoint(COUNT)
        for ask in (endpoint.feedback, endpoint.cancel_goals):
            began = anyio.current_time()
            with pytest.raises(ConnectionLost) as caught:
                await ask(GOAL_ID)
            assert str(caught.value) == (
                f"goal {GOAL_ID} has no worker: {former}, and no other one has"
                f" taken it over; start a worker that has room, and whose version can read the goal"
            )
            assert anyio.current_time() - began == pytest.approx(8)


async def test_an_end_that_its_owner_has_forgotten_is_unknown(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        a.own(GOAL_ID, **ENDED)
        outcome = await connection.endpoint(COUNT).get_result(GOAL_ID)
        assert outcome.status is GoalStatus.UNKNOWN
        a.own(GOAL_ID, **{**ENDED, "goal": THREE})
        outcome = await connection.endpoint(COUNT).get_result(GOAL_ID)
        assert outcome.status is GoalStatus.SUCCEEDED, "one that was given up is kept for longer"


async def test_goals_of_a_gateway_are_followed_there(fleet: FakeFleet) -> None:
    async with (
        fleet.worker("a").serve(server()),
        fleet.worker("b", is_kept=False).serve(server()) as b,
        fleet.worker("c", is_kept=False).serve(server()) as c,
        fleet.connect() as one,
        fleet.connect() as other,
    ):
        fleet.workers["a"].deafen()
        b.deafen()
        goal = await client_of(one).send_goal(-3)
        followed = await client_of(other).attach(goal.goal_id, after=0)
        assert await anext(followed.feedback) == 0
        assert (await client_of(other).cancel_goals(goal.goal_id)).accepted
        with pytest.raises(UnknownGoal):
            await client_of(other).attach(GOAL_ID)
        c.hang_up()
        with pytest.raises(ConnectionLost, match="worker 'c' is not there"):
            await client_of(other).attach(GOAL_ID)


async def test_a_goal_of_a_gateway_does_not_move(fleet: FakeFleet) -> None:
    async with (
        fleet.worker("b", is_kept=False).serve(server()) as b,
        fleet.connect() as connection,
    ):
        goal = await client_of(connection).send_goal(-3)
        b.die()
        with pytest.raises(ConnectionLost, match="worker 'b' is gone"):
            await goal.outcome()


# To cancel goals


async def test_all_goals_are_canceled_at_all_workers(fleet: FakeFleet) -> None:
    async with AsyncExitStack() as stack:
        for name in ("a", "b", "c"):
            await stack.enter_async_context(fleet.worker(name).serve(server()))
        connection = await stack.enter_async_context(fleet.connect())
        client = client_of(connection)
        goals = [await client.send_goal(-3) for _ in range(6)]
        by_stamp = await client.cancel_goals(before=goals[1].stamp)
        assert {info.goal_id for info in by_stamp.goals_canceling} == {
            goal.goal_id for goal in goals if goal.stamp <= goals[1].stamp
        }
        by_both = await client.cancel_goals(goals[5].goal_id, before=goals[1].stamp)
        assert goals[5].goal_id in {info.goal_id for info in by_both.goals_canceling}
        answer = await client.cancel_goals()
        assert {info.goal_id for info in answer.goals_canceling} >= {
            goal.goal_id for goal in goals[2:5]
        }
        for goal in goals:
            assert (await goal.outcome()).status is GoalStatus.CANCELED


async def test_a_cancel_of_all_goals_asks_each_worker_once(fleet: FakeFleet) -> None:
    asked: list[GoalID] = []

    def refuse(goal: GoalHandle[int]) -> bool:
        asked.append(goal.goal_id)
        return False

    async with fleet.worker("a").serve(server(on_cancel=refuse)), fleet.connect() as connection:
        goal = await client_of(connection).send_goal(-3)
        answer = await client_of(connection).cancel_goals()
        assert (answer.return_code, answer.goals_canceling) == (CancelCode.REJECTED, ())
        assert asked == [goal.goal_id]


async def test_a_cancel_of_all_goals_waits_for_those_that_no_worker_has(fleet: FakeFleet) -> None:
    gone = fleet.worker("c")
    old, new, canceling, ended = (GoalID(bytes([number]) * 16) for number in (1, 2, 3, 4))
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        client = client_of(connection)
        mine = await client.send_goal(-3)
        gone.own(old, goal=MINUS_THREE)
        gone.own(new, goal=MINUS_THREE, stamp=2**62)
        gone.own(canceling, status=GoalStatus.CANCELING)
        gone.own(ended, status=GoalStatus.SUCCEEDED, ended_at=8)
        fleet.broker.store(NAMES.goal("count", GOAL_ID), b"of another version")
        async with Running(lambda: client.cancel_goals(before=mine.stamp)) as canceling_some:
            await anyio.sleep(1)
            assert mine.status is GoalStatus.CANCELED
            a.take_over("count", old)
            some = await canceling_some.answer()
        assert {info.goal_id for info in some.goals_canceling} == {mine.goal_id, old}
        async with Running(client.cancel_goals) as canceling_all:
            await anyio.sleep(1)
            a.take_over("count", new)
            assert [one.goal_id for one in (await canceling_all.answer()).goals_canceling] == [new]


async def test_a_goal_that_nobody_takes_over_is_an_error_of_a_cancel_of_all(
    fleet: FakeFleet,
) -> None:
    async with fleet.worker("a").serve(server()), fleet.connect() as connection:
        mine = await client_of(connection).send_goal(-3)
        fleet.worker("c").own(GOAL_ID)
        with pytest.raises(ConnectionLost, match="has no worker: 'c', which had it, is gone"):
            await client_of(connection).cancel_goals()
        assert (await mine.outcome()).status is GoalStatus.CANCELED
        fleet.broker.before = _away
        with pytest.raises(ConnectionLost, match="the goals of the fleet cannot be listed"):
            await client_of(connection).cancel_goals()


async def _away(call: str, _: str) -> None:
    if call == "watch":
        raise BrokerAway("on purpose")


async def test_a_cancel_of_all_goals_leaves_out_a_worker_that_is_gone(fleet: FakeFleet) -> None:
    async with fleet.serving("a", "b") as (_, b), fleet.connect() as connection:
        client = client_of(connection)
        assert (await client.cancel_goals()).return_code is CancelCode.NONE
        b.hang_up()
        async with Running(client.cancel_goals) as canceling:
            await anyio.sleep(3)
            b.end_lease()
            assert (await canceling.answer()).return_code is CancelCode.NONE


# Gateways and owners that leave in the middle


async def test_a_gateway_that_leaves_during_a_cancel_of_all_goals_is_an_error(
    fleet: FakeFleet,
) -> None:
    async with (
        fleet.worker("a").serve(server()),
        fleet.worker("g", is_kept=False).serve(server()) as g,
        fleet.connect() as connection,
    ):
        client = client_of(connection)
        assert (await client.cancel_goals()).return_code is CancelCode.NONE
        g.hang_up()  # no record tells which goals it has
        with pytest.raises(ConnectionLost, match="worker 'g' is not there"):
            await client.cancel_goals()


async def test_a_goal_that_a_gateway_may_have_is_not_sent_to_another_worker(
    fleet: FakeFleet,
) -> None:
    mute = _Mute(server())
    async with (
        fleet.worker("g", is_kept=False).serve(mute) as g,
        fleet.connect() as connection,
    ):
        async with Running(lambda: client_of(connection).call(3)) as calling:
            await mute.asked.wait()
            async with fleet.worker("a").serve(server()) as a:
                g.hang_up()
                with pytest.raises(ConnectionLost, match="worker 'g' is not there"):
                    await calling.answer()
                assert not a.asked


async def test_a_goal_that_has_ended_is_told_by_its_record_when_its_owner_is_gone(
    fleet: FakeFleet,
) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        a.own(GOAL_ID, **ENDED)
        a.hang_up()  # its lease goes on for a while
        async with Running(lambda: connection.endpoint(COUNT).get_result(GOAL_ID)) as asking:
            await anyio.sleep(3)
            assert not asking.is_done
            a.end_lease()
            assert (await asking.answer()).status is GoalStatus.SUCCEEDED


async def test_the_record_of_a_goal_that_was_given_up_tells_its_checkpoint(
    fleet: FakeFleet,
) -> None:
    given_up = {"status": GoalStatus.ABORTED, "ended_at": 1, "checkpoint": b"\x04"}
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        a.own(GOAL_ID, **given_up)
        a.hang_up()
        a.end_lease()
        stream = await connection.endpoint(COUNT).feedback(GOAL_ID)
        assert stream.checkpoint == b"\x04"
        assert stream.goal is not None


# Goals that move between the look at their records and the question


def _cancel(endpoint: Endpoint) -> Awaitable[Any]:
    return endpoint.cancel_goals(GOAL_ID)


def _attach(endpoint: Endpoint) -> Awaitable[Any]:
    return endpoint.feedback(GOAL_ID, after=0)


def _result(endpoint: Endpoint) -> Awaitable[Any]:
    return endpoint.get_result(GOAL_ID)


@pytest.mark.promise("FLEET-15")
@pytest.mark.parametrize("ask", [_cancel, _attach, _result])
async def test_a_goal_that_moves_after_its_record_was_read_is_asked_about_again(
    fleet: FakeFleet, ask: Callable[[Endpoint], Awaitable[Any]]
) -> None:
    subject = NAMES.goal("count", GOAL_ID)
    async with fleet.serving("a", "b") as (a, b), fleet.connect() as connection:
        endpoint = connection.endpoint(COUNT)
        a.own(GOAL_ID, goal=MINUS_THREE, digest=digest_of(MINUS_THREE))
        before = fleet.broker.shared.newest(subject)
        assert before is not None
        b.own(GOAL_ID, goal=MINUS_THREE, digest=digest_of(MINUS_THREE))
        fleet.broker.old[subject] = [before]  # the first look; the goal has moved when `a` is asked
        async with Running(lambda: ask(endpoint)) as asking:
            await anyio.sleep(3)  # `b` has written its name, and does not serve the goal yet
            assert not asking.is_done
            b.take_over("count", GOAL_ID)
            if ask is _result:
                assert (await client_of(connection).cancel_goals(GOAL_ID)).accepted
            answer = await asking.answer()
        if ask is _cancel:
            assert [info.goal_id for info in answer.goals_canceling] == [GOAL_ID]
        if ask is _result:
            assert answer.status is GoalStatus.CANCELED


@pytest.mark.promise("FLEET-15")
async def test_a_cancel_during_the_release_of_a_goal_goes_to_its_next_worker(
    fleet: FakeFleet,
) -> None:
    async with (
        fleet.worker("a").serve(_Answering(server(), CancelCode.GOAL_TERMINATED)) as a,
        fleet.worker("b").serve(server()) as b,
        fleet.connect() as connection,
    ):
        a.own(GOAL_ID, goal=MINUS_THREE, digest=digest_of(MINUS_THREE))
        async with Running(lambda: connection.endpoint(COUNT).cancel_goals(GOAL_ID)) as canceling:
            await anyio.sleep(1)
            assert not canceling.is_done, "its end is not in the record"
            b.take_over("count", GOAL_ID)
            assert (await canceling.answer()).accepted


async def test_a_cancel_of_a_goal_whose_worker_does_not_come_to_know_it_is_an_error(
    fleet: FakeFleet,
) -> None:
    async with (
        fleet.worker("a").serve(server()) as a,
        fleet.connect(reconnect_timeout=8) as connection,
    ):
        a.own(GOAL_ID)
        began = anyio.current_time()
        with pytest.raises(ConnectionLost, match="'a', which has it by its record, has not begun"):
            await connection.endpoint(COUNT).cancel_goals(GOAL_ID)
        assert anyio.current_time() - began == pytest.approx(8)


async def test_a_cancel_of_a_goal_that_has_ended_is_told_so_when_its_owner_has_forgotten_it(
    fleet: FakeFleet,
) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        a.own(GOAL_ID, **ENDED)
        answer = await connection.endpoint(COUNT).cancel_goals(GOAL_ID)
        assert answer.return_code is CancelCode.GOAL_TERMINATED


async def test_workers_that_are_gone_meanwhile_cannot_be_paused(
    fleet: FakeFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def nobody(*_: object) -> list[object]:
        return []

    pause = IntakeChange(IntakeMode.HOLD)
    async with fleet.worker("a").serve(server()), fleet.connect() as connection:
        endpoint = connection.endpoint(COUNT)
        assert (await endpoint.change_intake(pause)).mode is IntakeMode.HOLD
        assert (await endpoint.intake()).mode is IntakeMode.HOLD
        for worker, error in (("z", "no worker 'z'"), ("a", "about all workers")):
            with pytest.raises(TransportError, match=error):
                await endpoint.change_intake(replace(pause, worker=worker))
        drain = IntakeChange(IntakeMode.DRAIN, worker="a")
        assert (await endpoint.change_intake(drain)).mode is IntakeMode.DRAIN
        monkeypatch.setattr(endpoint, "of_all", nobody)
        with pytest.raises(ServerNotFound):
            await endpoint.change_intake(pause)


class Logging(ForwardingEndpoint):
    """A server with log lines of all goals."""

    def __init__(self, inner: Endpoint, *times: int) -> None:
        super().__init__(inner)
        self._lines = [LogLine(time, "INFO", "arm", "moves") for time in times]

    async def log_lines(self, goal_id: GoalID) -> list[LogLine] | None:
        return self._lines


async def test_the_log_lines_of_all_attempts_are_told_in_order_by_the_workers_that_are_reached(
    fleet: FakeFleet,
) -> None:
    async with (
        fleet.worker("a").serve(Logging(server(), 1, 4)) as a,
        fleet.worker("b").serve(Logging(server(), 2)) as b,
        fleet.worker("c").serve(server()),
        fleet.connect(reconnect_timeout=2) as connection,
    ):

        async def times() -> list[int]:
            return [one.at for one in await connection.endpoint(COUNT).log_lines(GOAL_ID) or ()]

        assert await times() == [1, 2, 4]
        b.hang_up()  # its lease goes on
        assert await times() == [1, 4]
        a.hang_up()
        with pytest.raises(ConnectionLost, match="is not there"):
            await times()
        a.end_lease()
        b.end_lease()
        assert await connection.endpoint(COUNT).log_lines(GOAL_ID) is None, "the third keeps none"


# What a client is told of a fleet as a whole


async def test_actions_workers_and_peers_are_those_of_all_workers(fleet: FakeFleet) -> None:
    async with fleet.serving("a", "b"), fleet.connect() as connection:
        assert await connection.actions() == [COUNT.info]
        assert [worker.name for worker in await connection.workers()] == ["a", "b"]
        assert connection.endpoint(COUNT.info).info == COUNT.info
        await client_of(connection).call(3)
        assert await connection.peers("count") == ActionPeers(("a", "b"), ("client",))
        with pytest.raises(ServerNotFound):
            await connection.peers("fly")


async def test_goals_that_were_given_up_are_those_of_the_fleet(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        a.own(GOAL_ID, **{**ENDED, "goal": THREE})
        (goal,) = (await connection.given_up())["count"]
        assert goal.goal_id == GOAL_ID
        with pytest.raises(StoreError, match="was not given up"):
            await connection.rerun("fly", GOAL_ID)


async def test_a_connection_that_was_left_is_of_no_use(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()):
        async with fleet.connect() as connection:
            client = client_of(connection)
            await client.call(3)
        for ask in (
            lambda: client.call(3),
            connection.actions,
            connection.workers,
            client.goals,
            client.cancel_goals,
            lambda: client.wait_for_server(),
        ):
            with pytest.raises(ConnectionLost, match="was closed here"):
                await ask()
