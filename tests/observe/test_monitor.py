"""The state of all actions, gathered from events and from real servers."""

from __future__ import annotations

from typing import Any

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionInfo,
    CancelCode,
    ConnectionLost,
    GoalID,
    GoalInfo,
    GoalStatus,
    Parent,
)
from fibaction.client.events import GoalFeedback
from fibaction.observe import monitor as monitor_module
from fibaction.observe.monitor import (
    ActionSnapshot,
    AnyClient,
    GoalKey,
    GoalSnapshot,
    Monitor,
    Rate,
)
from tests.cli.served import Altered, Heard, Served, counter, look_often
from tests.support.matching import End

ID = GoalID(b"\x01" * 16)
OTHER = GoalID(b"\x02" * 16)
KEY = GoalKey("one", ID)
ONE = ActionInfo("one")


def info(status: int, *, goal_id: GoalID = ID, stamp: int = 1, count: int = 0) -> GoalInfo:
    return GoalInfo(goal_id, stamp, GoalStatus(status), count)


def feedback(number: int) -> GoalFeedback[int]:
    return GoalFeedback(ID, number, number * 10)


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(monitor_module, "PERIOD", 0.02)
    look_often(monkeypatch)


@pytest.fixture
def monitor() -> Monitor:
    """A monitor that knows an action, and whose clock advances a second at each snapshot."""
    seconds = iter(range(1000))
    monitor = Monitor(clock=lambda: next(seconds))
    monitor.on_actions([ONE], "")
    return monitor


def the_goal(monitor: Monitor) -> GoalSnapshot:
    (goal,) = monitor.snapshot().goals
    return goal


def the_action(monitor: Monitor) -> ActionSnapshot:
    (action,) = monitor.snapshot().actions
    return action


def test_goals_appear_change_and_are_forgotten(monitor: Monitor) -> None:
    monitor.on_event("one", info(1))
    monitor.on_event("one", info(2))
    assert the_goal(monitor).key == KEY
    assert the_goal(monitor).info.status is GoalStatus.EXECUTING
    monitor.on_event("one", info(0))
    monitor.on_event("one", info(0))

    assert not monitor.snapshot().goals
    assert monitor.goal(KEY) is None


def test_an_older_status_does_not_replace_a_newer_one(monitor: Monitor) -> None:
    monitor.on_event("one", GoalInfo(ID, 1, GoalStatus.SUCCEEDED, 5, "me"))
    monitor.on_event("one", info(2, count=3))

    assert the_goal(monitor).info == GoalInfo(ID, 1, GoalStatus.SUCCEEDED, 5, "me")


def waiting(place: int, length: int) -> GoalInfo:
    return GoalInfo(ID, 1, GoalStatus.ACCEPTED, 0, "me", place, length)


@pytest.mark.parametrize(
    ("events", "place"),
    [
        ([info(1), waiting(2, 5)], (2, 5)),
        ([waiting(2, 5), waiting(1, 4)], (1, 4)),
        ([waiting(2, 5), info(1)], (2, 5)),
        ([waiting(2, 5), info(2)], (0, 0)),
        ([info(2), waiting(2, 5)], (0, 0)),
        ([waiting(2, 5), info(3), waiting(1, 4)], (0, 0)),
    ],
)
def test_the_newest_place_counts_until_the_goal_waits_no_more(
    monitor: Monitor, events: list[GoalInfo], place: tuple[int, int]
) -> None:
    for event in events:
        monitor.on_event("one", event)

    found = the_goal(monitor).info
    assert (found.place, found.queue_length) == place


def test_times_and_the_reason_stay_once_they_are_known(monitor: Monitor) -> None:
    monitor.on_event("one", GoalInfo(ID, 1, GoalStatus.EXECUTING, began_at=2, reason="a suspect"))
    assert the_goal(monitor).info.reason == "a suspect"
    monitor.on_event("one", GoalInfo(ID, 1, GoalStatus.EXECUTING))
    assert the_goal(monitor).info.reason == ""
    monitor.on_event("one", GoalInfo(ID, 1, GoalStatus.ABORTED, ended_at=3, reason="stuck"))
    monitor.on_event("one", GoalInfo(ID, 1, GoalStatus.EXECUTING, 7))

    found = the_goal(monitor).info
    assert (found.began_at, found.ended_at, found.reason) == (2, 3, "stuck")


def test_feedback_is_counted_by_its_numbers(monitor: Monitor) -> None:
    monitor.on_event("one", info(2))
    monitor.on_event("one", feedback(7))  # the first that arrives here
    monitor.snapshot()
    for number in (8, 10, 12):
        monitor.on_event("one", feedback(number))
    snapshot = monitor.snapshot()

    goal = snapshot.goals[0]
    assert goal == monitor.goal(KEY)
    assert goal.info.feedback_count == 12
    assert goal.feedback_rate == snapshot.actions[0].feedback_rate == 5.0
    assert goal.latest == 120
    monitor.on_event("one", GoalFeedback(OTHER, 1, 0))  # of an unknown goal


def test_feedback_is_summarized_once_per_snapshot() -> None:
    summarized: list[Any] = []

    def summarize(value: Any) -> str:
        summarized.append(value)
        return str(value)

    monitor = Monitor(summarize=summarize)
    monitor.on_actions([ONE], "")
    monitor.on_event("one", info(2))
    for number in (1, 2):
        monitor.on_event("one", feedback(number))

    assert the_goal(monitor).latest == the_goal(monitor).latest == "20"
    assert summarized == [20]


def test_feedback_of_goals_beyond_the_most_is_forgotten() -> None:
    monitor = Monitor()
    monitor.on_actions([ONE], "")
    monitor.on_event("one", info(2))
    monitor.on_event("one", feedback(1))

    assert monitor.snapshot(0).goals == []
    assert the_goal(monitor).latest is None
    monitor.on_event("one", feedback(2))
    assert the_goal(monitor).latest == 20


def test_the_latest_of_very_many_goals_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fibaction.observe.monitor.MOST_GOALS", 2)
    monitor = Monitor()
    monitor.on_actions([ONE], "")
    ids = [GoalID.random() for _ in range(3)]
    for goal_id in ids:
        monitor.on_event("one", msgspec.structs.replace(info(2), goal_id=goal_id))

    assert {goal.info.goal_id for goal in monitor.snapshot().goals} == set(ids[1:])


def test_the_feedback_of_another_attempt_is_counted_anew(monitor: Monitor) -> None:
    monitor.on_event("one", info(2))
    monitor.on_event("one", feedback(7))
    monitor.snapshot()
    for number, attempt in ((8, 1), (1, 2), (2, 2)):
        monitor.on_event("one", GoalFeedback(ID, number, 0, attempt))
    monitor.on_event("one", info(2, count=9))  # an answer that comes late
    goal = monitor.snapshot().goals[0]
    assert (goal.info.feedback_count, goal.info.attempt) == (2, 2)
    assert goal.feedback_rate == 3.0
    monitor.on_event("one", GoalInfo(ID, 1, GoalStatus.EXECUTING, 5, attempt=3))
    assert the_goal(monitor).info.feedback_count == 5


def test_a_rate_is_that_of_the_last_seconds() -> None:
    rate = Rate()
    assert rate.per_second == 0
    rate.sample(0)
    rate.sample(0)
    assert rate.per_second == 0
    rate.count = 1000
    for second in range(1, 20):
        rate.sample(second)
    assert rate.per_second == 0
    rate.count += 10
    rate.sample(20)
    assert rate.per_second == pytest.approx(2.0)


def test_active_goals_come_first_then_the_newest(monitor: Monitor) -> None:
    for number, (status, stamp) in enumerate([(4, 5), (2, 1), (6, 9), (2, 3)]):
        monitor.on_event("one", info(status, goal_id=GoalID(bytes([number] * 16)), stamp=stamp))

    assert [goal.info.stamp for goal in monitor.snapshot(3).goals] == [3, 1, 9]
    assert (the_action(monitor).active, the_action(monitor).ended) == (2, 2)


def test_goals_that_wait_come_behind_those_that_run_and_the_next_to_start_first() -> None:
    infos = [
        GoalInfo(ID, 4, GoalStatus.ACCEPTED, 0, "", 2, 2),
        GoalInfo(ID, 3, GoalStatus.ACCEPTED, 0, "", 1, 2),
        GoalInfo(ID, 2, GoalStatus.EXECUTING),
        GoalInfo(ID, 1, GoalStatus.EXECUTING),
        GoalInfo(ID, 5, GoalStatus.SUCCEEDED),
    ]
    infos.sort(key=monitor_module.newest_active_first)

    assert [info.stamp for info in infos] == [2, 1, 3, 4, 5]


def test_an_action_and_a_server_are_away_until_they_are_back(monitor: Monitor) -> None:
    client = Served(counter("one")).connection.client(counter("one").action)
    monitor.on_action_lost("one", "stopped")
    monitor.on_action_lost("unheard", "of")
    monitor.on_actions(None, "silent")
    assert (the_action(monitor).away, monitor.snapshot().away) == ("stopped", "silent")
    monitor.on_action_found(ONE, client)
    monitor.on_actions([], "")

    assert (the_action(monitor).away, monitor.snapshot().away) == ("", "")


class ReportingMonitor(Monitor):
    """A monitor that reports each event and each refresh to a test."""

    def __init__(self) -> None:
        super().__init__()
        self.heard = Heard()

    def on_action_found(self, info: ActionInfo, client: AnyClient) -> None:
        super().on_action_found(info, client)
        self.heard(info.name)

    def on_event(self, action: str, event: GoalInfo | GoalFeedback[Any]) -> None:
        super().on_event(action, event)
        self.heard(type(event).__name__)

    async def _refresh_goals(self, action: str, client: AnyClient) -> None:
        await super()._refresh_goals(action, client)
        self.heard("refreshed")


@pytest.mark.asyncio
async def test_it_follows_real_servers_and_forgets_what_they_have_forgotten() -> None:
    monitor, server = ReportingMonitor(), counter("one")
    served = Served(server, counter("not_started"))
    async with server, anyio.create_task_group() as tasks:
        tasks.start_soon(monitor.run, served.connection)
        await monitor.heard.until(lambda all: "one" in all)
        await served.connection.client(server.action).send_goal(1, goal_id=ID)
        await monitor.heard.until(lambda all: "GoalFeedback" in all)
        monitor.on_event("one", info(2, goal_id=OTHER))  # of a server before a restart
        monitor.on_actions([ONE, ActionInfo("unfollowed")], "")
        monitor.heard.clear()
        await monitor.heard.until(lambda all: all.count("refreshed") > 1)
        answer = await monitor.cancel(KEY)

        with anyio.fail_after(30):
            outcome = await monitor.outcome(KEY)
        tasks.cancel_scope.cancel()

    assert answer.return_code is CancelCode.NONE
    assert outcome.status is GoalStatus.CANCELED
    assert the_goal(monitor).key == KEY


@pytest.mark.asyncio
async def test_the_outcome_of_a_goal_has_its_result(monitor: Monitor) -> None:
    server = counter("one", ["done"])
    async with server:
        client = Served(server).connection.client(server.action)
        monitor.on_action_found(ONE, client)
        monitor.on_event("one", info(4))
        await (await client.send_goal(1, goal_id=ID)).outcome()
        assert await monitor.outcome(KEY) == End(GoalStatus.SUCCEEDED, "done")


@pytest.mark.asyncio
async def test_a_server_that_cannot_be_asked_keeps_its_goals(monitor: Monitor) -> None:
    asked = anyio.Event()

    async def lost() -> None:
        asked.set()
        raise ConnectionLost("the line is dead")

    server = Altered(counter("one"), status=lost)
    monitor.on_action_found(ONE, Served(server).connection.client(Action.untyped(server.info)))
    monitor.on_event("one", info(2))
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(monitor._refresh)
        with anyio.fail_after(30):
            await asked.wait()
            await anyio.wait_all_tasks_blocked()
        tasks.cancel_scope.cancel()

    assert the_goal(monitor).key == KEY


def test_goals_that_match_come_in_the_order_that_was_asked_for(monitor: Monitor) -> None:
    for number in range(4):
        monitor.on_event("one", info(2, goal_id=GoalID(bytes([number] * 16)), stamp=number))

    found = monitor.snapshot(
        2, matches=lambda goal: goal.info.stamp != 1, order=lambda goal: goal.info.stamp
    )
    assert [goal.info.stamp for goal in found.goals] == [0, 2]
    assert found.matching == 3


@pytest.mark.asyncio
async def test_the_goal_itself_is_told_while_the_server_remembers_it(monitor: Monitor) -> None:
    server = counter("one", ["done"], [anyio.Event()])
    client = Served(server).connection.client(server.action)
    monitor.on_action_found(ONE, client)
    async with server:
        await (await client.send_goal(7, goal_id=OTHER)).outcome()
        await client.send_goal(8, goal_id=ID)

        assert await monitor.request(GoalKey("one", ID)) == 8
        assert await monitor.request(GoalKey("one", OTHER)) == 7


def test_a_goal_is_found_by_its_id_and_has_its_children_in_their_order(monitor: Monitor) -> None:
    for number in (3, 2):
        child = GoalID(bytes([number] * 16))
        told = info(2, goal_id=child, stamp=number)
        monitor.on_event("one", msgspec.structs.replace(told, parent=Parent(ID, "lift")))
        monitor.on_event("one", told)  # a change over a line that does not tell parents
    monitor.on_event("one", info(2))

    assert [goal.info.stamp for goal in monitor.children(ID)] == [2, 3]
    assert monitor.children(OTHER) == []
    found = monitor.find(ID)
    assert found is not None
    assert found.key == KEY
    assert monitor.find(GoalID(bytes(16))) is None
