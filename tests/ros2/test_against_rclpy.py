"""A stock client of rclpy, in another process, uses a server of fibaction.

`test_rclpy_list` tells which of rclpy's own tests are covered here and in `test_rclpy_servers`.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import Any

import anyio
import pytest

from fibaction import ActionServer, GoalStatus, Schedule, serve
from fibaction_transports.ros2.on_rclpy import ends, rcl
from tests.ros2.stock import orders
from tests.ros2.stock.ours import TYPE, Behaviour
from tests.ros2.stock.process import Peer, peer
from tests.ros2.stock.waiting import eventually
from tests.ros2.zenoh_peer import middleware, url_of
from tests.support.article import article

pytestmark = pytest.mark.anyio

UNKNOWN, ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = map(int, GoalStatus)
NONE, REJECTED, UNKNOWN_ID, TERMINATED = range(4)
RESULT_TIMEOUT = 0.5


@pytest.fixture(scope="module", params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture(scope="module")
async def ours(anyio_backend: str, way: str) -> AsyncGenerator[Behaviour, None]:
    behaviour = Behaviour()
    servers = [
        behaviour.server("ours", result_timeout=60),
        behaviour.server("hasty", result_timeout=RESULT_TIMEOUT),
        behaviour.server("arm", schedule=Schedule(concurrency=1, when_full="preempt")),
        behaviour.server("line", schedule=Schedule(concurrency=1, queue=1)),
        ActionServer(article),
    ]
    async with serve(servers, url_of(way, "our_server")):
        yield behaviour


@pytest.fixture(scope="module")
async def stock(ours: Behaviour, way: str) -> AsyncGenerator[Peer, None]:
    async with peer("client", **middleware(way)) as found:
        assert await found.ask("ready", action="ours")
        yield found


async def send(stock: Peer, order: int, action: str = "ours", **rest: str) -> dict[str, Any]:
    answer: dict[str, Any] = await stock.ask("send", action=action, order=order, **rest)
    return answer


async def accepted(stock: Peer, order: int, action: str = "ours", **rest: str) -> str:
    answer = await send(stock, order, action, **rest)
    assert answer["accepted"]
    return str(answer["goal"])


async def result(stock: Peer, goal: str) -> tuple[int, list[int]]:
    answer = await stock.ask("result", goal=goal)
    return answer["status"], answer["sequence"]


async def raw_result(stock: Peer, goal: str, action: str = "ours") -> tuple[int, list[int]]:
    answer = await stock.ask("raw_result", action=action, goal=goal)
    return answer["status"], answer["sequence"]


async def statuses_of(stock: Peer, goal: str, action: str = "ours") -> list[int]:
    """Return the statuses of a goal on the status topic, without repetitions."""
    said: list[int] = []
    for one in await stock.ask("statuses", action=action):
        said += [status for of, status in one if of == goal and [status] != said[-1:]]
    return said


async def ended(stock: Peer, goal: str, status: int, action: str = "ours") -> None:
    """Wait until the status topic has this status last."""
    await eventually(lambda: statuses_of(stock, goal, action), lambda said: said[-1:] == [status])


async def feedback(stock: Peer, goal: str, sent: list[list[int]]) -> None:
    """Compare received feedback with sent feedback. The last messages may be missing: if rclpy's
    client takes a result before earlier feedback, it drops the feedback.
    """
    seen = await stock.ask("feedback", goal=goal)
    assert seen == sent[: len(seen)]


async def lives(stock: Peer) -> None:
    assert await result(stock, await accepted(stock, 4)) == (SUCCEEDED, [0, 1, 1, 2, 3])


async def test_a_stock_client_uses_a_function(stock: Peer) -> None:
    goal = await accepted(stock, 4, "article")
    assert await result(stock, goal) == (SUCCEEDED, [0, 1, 1, 2, 3])
    await feedback(stock, goal, [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3]])


async def end_all(stock: Peer, ours: Behaviour) -> None:
    """End all goals of a test."""
    await stock.ask("raw_cancel", action="ours")
    ours.released.notify()


# Accepting


async def test_a_goal_is_accepted_with_a_stamp(stock: Peer) -> None:
    answer = await send(stock, 3, goal_id="ab" * 16)

    assert answer["accepted"]
    assert answer["goal"] == "ab" * 16
    assert answer["stamp"] > 1.7e18
    assert await result(stock, answer["goal"]) == (SUCCEEDED, [0, 1, 1, 2])


@pytest.mark.promise("STATUS-6")
async def test_a_rejected_goal_is_unknown_afterwards(stock: Peer) -> None:
    answer = await send(stock, orders.REJECTED)

    assert not answer["accepted"]
    assert answer["stamp"] == 0
    await lives(stock)
    assert await statuses_of(stock, answer["goal"]) == []
    assert await raw_result(stock, answer["goal"]) == (UNKNOWN, [])
    cancel = await stock.ask("raw_cancel", action="ours", goal=answer["goal"])
    assert cancel == {"code": UNKNOWN_ID, "goals": []}


async def test_the_reason_of_a_rejection_is_in_the_log_of_ros(stock: Peer) -> None:
    goal = (await send(stock, orders.REJECTED))["goal"]

    async def lines() -> list[str]:
        return [text for _, text in await stock.ask("log") if goal in text]

    assert await eventually(lines, bool) == [
        f"ours: goal {goal} rejected: a sequence has no negative length"
    ]


@pytest.mark.promise("ACCEPT-4")
async def test_a_callback_that_raises_rejects_the_goal_and_the_server_goes_on(stock: Peer) -> None:
    assert not (await send(stock, orders.GOAL_RAISES))["accepted"]
    await lives(stock)


async def test_several_goals_at_once_all_succeed(stock: Peer) -> None:
    answers = await stock.ask("send_many", action="ours", orders=[3, 4, 5])

    assert [a["sequence"] for a in answers] == [[0, 1, 1, 2], [0, 1, 1, 2, 3], [0, 1, 1, 2, 3, 5]]


@pytest.mark.promise("ACCEPT-7")
async def test_an_id_in_use_is_rejected_while_the_goal_runs_and_while_it_is_remembered(
    stock: Peer, ours: Behaviour
) -> None:
    goal = await accepted(stock, orders.WAITS)
    assert not (await send(stock, 3, goal_id=goal))["accepted"]

    await end_all(stock, ours)
    await ended(stock, goal, CANCELED)
    assert not (await send(stock, 3, goal_id=goal))["accepted"]


# Executing


async def test_feedback_arrives_in_order_and_the_result_after_it(stock: Peer) -> None:
    goal = await accepted(stock, 5)

    assert await result(stock, goal) == (SUCCEEDED, [0, 1, 1, 2, 3, 5])
    sequence = [0, 1, 1, 2, 3, 5]
    await feedback(stock, goal, [sequence[:length] for length in (3, 4, 5, 6)])


async def test_every_status_is_published_accepted_before_executing(stock: Peer) -> None:
    goal = await accepted(stock, 3)

    await ended(stock, goal, SUCCEEDED)
    assert await statuses_of(stock, goal) == [ACCEPTED, EXECUTING, SUCCEEDED]
    seen = await eventually(lambda: stock.ask("handle_status", goal=goal), lambda s: s > EXECUTING)
    assert seen == SUCCEEDED


async def test_a_late_subscriber_gets_the_last_list_of_statuses(stock: Peer) -> None:
    goal = await accepted(stock, 3)
    await ended(stock, goal, SUCCEEDED)

    await stock.ask("watch_anew", action="ours")

    lists = await eventually(lambda: stock.ask("statuses", action="ours"), len)
    assert len(lists) == 1
    assert [goal, SUCCEEDED] in lists[0]


async def test_a_client_that_is_told_of_the_acceptance_after_the_statuses_gets_them_again(
    stock: Peer, ours: Behaviour, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise `ros2 action send_goal` would not cancel its goal at Ctrl-C: it cancels only goals
    that it knows to be active.
    """
    tries = iter([False, False])

    def has_answered(service: Any, response: Any, header: Any) -> bool:
        if type(response).__name__.endswith("SendGoal_Response"):
            for answer in tries:
                return answer
        return rcl.has_answered(service, response, header)

    monkeypatch.setattr(ends, "has_answered", has_answered)
    goal = await accepted(stock, orders.WAITS)

    await eventually(lambda: stock.ask("handle_status", goal=goal), lambda s: s == EXECUTING)
    await end_all(stock, ours)


@pytest.mark.promise("EXECUTE-7", "RESULT-1")
async def test_an_abort_comes_with_the_part_that_is_done(stock: Peer) -> None:
    goal = await accepted(stock, orders.ABORTS)

    assert await result(stock, goal) == (ABORTED, orders.PART)
    await ended(stock, goal, ABORTED)
    assert await statuses_of(stock, goal) == [ACCEPTED, EXECUTING, ABORTED]


@pytest.mark.promise("EXECUTE-5")
@pytest.mark.parametrize("order", [orders.RAISES, orders.FORGETS])
async def test_an_executor_that_goes_wrong_is_aborted_with_an_empty_result(
    stock: Peer, order: int
) -> None:
    waiting = await accepted(stock, orders.WAITS)

    assert await result(stock, await accepted(stock, order)) == (ABORTED, [])

    await lives(stock)
    assert (await stock.ask("cancel", goal=waiting))["goals"] == [waiting]  # it still runs


# Canceling


@pytest.mark.promise("CANCEL-9")
async def test_a_cancel_is_accepted_and_the_goal_ends_as_canceled(stock: Peer) -> None:
    goal = await accepted(stock, orders.WAITS)
    await eventually(lambda: stock.ask("feedback", goal=goal), len)

    assert await stock.ask("cancel", goal=goal) == {"code": NONE, "goals": [goal]}

    assert await result(stock, goal) == (CANCELED, [])
    await ended(stock, goal, CANCELED)
    assert await statuses_of(stock, goal) == [ACCEPTED, EXECUTING, CANCELING, CANCELED]


@pytest.mark.promise("CANCEL-3")
@pytest.mark.parametrize("order", [orders.STUBBORN, orders.CANCEL_RAISES])
async def test_a_rejected_cancel_says_so_and_the_goal_goes_on(
    stock: Peer, ours: Behaviour, order: int
) -> None:
    goal = await accepted(stock, order)
    await eventually(lambda: stock.ask("feedback", goal=goal), len)

    assert await stock.ask("cancel", goal=goal) == {"code": REJECTED, "goals": []}

    assert (await statuses_of(stock, goal))[-1] == EXECUTING
    ours.released.notify()
    assert await result(stock, goal) == (SUCCEEDED, orders.PART)


@pytest.mark.promise("CANCEL-17")
async def test_canceling_all_names_those_that_end_and_no_other(
    stock: Peer, ours: Behaviour
) -> None:
    willing = [await accepted(stock, orders.WAITS) for _ in range(3)]
    stubborn = [await accepted(stock, orders.STUBBORN) for _ in range(3)]
    for goal in (*willing, *stubborn):
        await eventually(lambda goal=goal: stock.ask("feedback", goal=goal), len)  # type: ignore[misc]

    answer = await stock.ask("raw_cancel", action="ours")

    assert answer == {"code": NONE, "goals": sorted(willing)}
    assert [(await result(stock, goal))[0] for goal in willing] == [CANCELED] * 3
    ours.released.notify()
    assert [(await result(stock, goal))[0] for goal in stubborn] == [SUCCEEDED] * 3


@pytest.mark.parametrize(("stamp", "by_id", "canceled"), [(1, None, {0, 1}), (0, 2, {0, 2})])
async def test_canceling_by_time_includes_that_very_stamp_and_a_goal_that_is_named(
    stock: Peer, ours: Behaviour, stamp: int, by_id: int | None, canceled: set[int]
) -> None:
    answers = [await send(stock, orders.WAITS) for _ in range(3)]
    goals = [answer["goal"] for answer in answers]
    named = {} if by_id is None else {"goal": goals[by_id]}

    answer = await stock.ask("raw_cancel", action="ours", stamp=answers[stamp]["stamp"], **named)

    assert answer == {"code": NONE, "goals": sorted(goals[index] for index in canceled)}
    await end_all(stock, ours)


@pytest.mark.promise("CANCEL-16")
async def test_a_cancel_of_nothing_has_the_code_of_rcl(stock: Peer) -> None:
    over = await accepted(stock, 3)
    await result(stock, over)

    async def code(**what: Any) -> int:
        answer = await stock.ask("raw_cancel", action="ours", **what)
        assert answer["goals"] == []
        return int(answer["code"])

    assert await code() == NONE
    assert await code(stamp=1) == NONE
    assert await code(goal="cd" * 16) == UNKNOWN_ID
    assert await code(goal="cd" * 16, stamp=1) == NONE
    assert await code(goal=over) == TERMINATED


# Results


async def test_a_result_can_be_asked_for_late_and_again(stock: Peer) -> None:
    goal = await accepted(stock, 3)
    await ended(stock, goal, SUCCEEDED)

    assert await raw_result(stock, goal) == (SUCCEEDED, [0, 1, 1, 2])
    assert await raw_result(stock, goal) == (SUCCEEDED, [0, 1, 1, 2])


async def test_a_result_expires_and_then_the_id_is_free_again(stock: Peer) -> None:
    goals = [await accepted(stock, order, "hasty") for order in (2, 3)]
    assert await result(stock, goals[0]) == (SUCCEEDED, [0, 1, 1])
    kept = await accepted(stock, orders.WAITS, "hasty")

    async def listed() -> list[str]:
        lists = await stock.ask("statuses", action="hasty")
        return [goal for goal, _ in lists[-1]] if lists else []

    assert await eventually(listed, lambda seen: len(seen) == 1) == [kept]
    assert [await raw_result(stock, goal, "hasty") for goal in goals] == [(UNKNOWN, [])] * 2
    canceled = await stock.ask("raw_cancel", action="hasty", goal=goals[0])
    assert canceled["code"] == UNKNOWN_ID
    again = await accepted(stock, 4, "hasty", goal_id=goals[0])
    assert await result(stock, again) == (SUCCEEDED, [0, 1, 1, 2, 3])
    await stock.ask("raw_cancel", action="hasty")


# What others in the graph see


async def test_the_graph_shows_the_action_its_server_and_its_client(stock: Peer) -> None:
    expected = [["/hasty", [TYPE]], ["/ours", [TYPE]]]

    async def of(do: str, **arguments: str) -> list[Any]:
        found: list[Any] = await stock.ask(do, **arguments)
        return sorted(one for one in found if one in expected)

    async def seen() -> list[list[Any]]:
        return [
            await of("graph"),
            await of("servers_of", node="our_server"),
            await of("clients_of", node="our_server"),
            await of("servers_of", node="stock_client"),
        ]

    await eventually(seen, lambda all_of: all_of == [expected, expected, [], []])


async def test_the_topics_are_offered_as_rcl_action_offers_them(stock: Peer) -> None:
    async def profiles(topic: str) -> Any:
        return await stock.ask("profiles", topic=f"/ours/_action/{topic}")

    assert await profiles("feedback") == [["RELIABLE", "VOLATILE"]]
    assert await profiles("status") == [["RELIABLE", "TRANSIENT_LOCAL"]]


async def test_services_publish_no_events_of_introspection(stock: Peer) -> None:
    await lives(stock)

    topics = await stock.ask("topics")

    assert "/ours/_action/status" in topics
    assert not [topic for topic in topics if "_service_event" in topic]


# Clients that do wrong


async def test_a_client_of_another_type_does_not_affect_others(stock: Peer, way: str) -> None:
    async with peer("client", **middleware(way)) as other:
        await other.ask("send_other_type", action="ours")
        await lives(stock)
        assert not await other.ask("send_other_type", action="ours")  # it finds no server
    await lives(stock)


async def test_a_client_that_is_killed_does_not_affect_others(
    stock: Peer, ours: Behaviour, way: str
) -> None:
    async with peer("client", **middleware(way)) as other:
        goal = await accepted(other, orders.WAITS)
        other.process.kill()

    with anyio.fail_after(10):
        await lives(stock)
        answer = await stock.ask("raw_cancel", action="ours", goal=goal)
        assert answer == {"code": NONE, "goals": [goal]}
        await ended(stock, goal, CANCELED)
    assert await raw_result(stock, goal) == (CANCELED, [])
    await lives(stock)


# Schedules


@pytest.mark.promise("SCHEDULE-5")
async def test_a_preempted_goal_ends_as_aborted_and_the_new_one_runs(stock: Peer) -> None:
    old = await accepted(stock, orders.WAITS, "arm")
    await ended(stock, old, EXECUTING, "arm")
    new = await accepted(stock, 4, "arm")

    assert (await result(stock, old))[0] == ABORTED
    assert await result(stock, new) == (SUCCEEDED, [0, 1, 1, 2, 3])
    # The subscription is as young as the first goal, so it may have missed the first status.
    assert (await statuses_of(stock, old, "arm"))[-2:] == [EXECUTING, ABORTED]


@pytest.mark.promise("SCHEDULE-2", "SCHEDULE-4")
async def test_a_goal_waits_as_accepted_and_one_without_a_place_is_rejected(stock: Peer) -> None:
    running = await accepted(stock, orders.WAITS, "line")
    waiting = await accepted(stock, 4, "line")

    assert not (await send(stock, 3, "line"))["accepted"]
    await eventually(lambda: statuses_of(stock, waiting, "line"), lambda said: said == [ACCEPTED])
    assert (await stock.ask("cancel", goal=running))["code"] == NONE
    assert await result(stock, waiting) == (SUCCEEDED, [0, 1, 1, 2, 3])
    assert (await result(stock, running))[0] == CANCELED
