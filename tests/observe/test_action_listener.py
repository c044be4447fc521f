"""Following of all actions: actions that appear, stop and cannot be used."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionInfo,
    ConnectionLost,
    GoalInfo,
    GoalStatus,
    ServerNotFound,
    TransportError,
)
from fibaction.client.events import GoalFeedback
from fibaction.observe import action_listener
from fibaction.observe.action_listener import (
    ActionListener,
    AnyClient,
    follow_action,
    follow_actions,
)
from tests.cli.served import Altered, Heard, Served, counter, look_often


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    look_often(monkeypatch)


class Recorder(ActionListener):
    def __init__(self) -> None:
        self.heard = Heard()

    def on_action_found(self, info: ActionInfo, client: AnyClient) -> None:
        self.heard("found", info.name)

    def on_event(self, action: str, event: GoalInfo | GoalFeedback[Any]) -> None:
        what = event.feedback if isinstance(event, GoalFeedback) else event.status
        self.heard("told", action, what)

    def on_action_lost(self, action: str, reason: str) -> None:
        self.heard("gone", action, reason)

    def on_actions(self, actions: list[ActionInfo] | None, reason: str) -> None:
        self.heard("reached", None if actions is None else len(actions), reason)


@asynccontextmanager
async def followed(served: Served, *, feedback: bool = True) -> AsyncGenerator[Heard, None]:
    recorder = Recorder()

    async def run() -> None:
        await follow_actions(served.connection, recorder, feedback=feedback)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(run)
        yield recorder.heard
        tasks.cancel_scope.cancel()


@pytest.mark.asyncio
async def test_every_action_is_followed_those_that_come_later_included() -> None:
    one, other = counter("one"), counter("other")
    async with one, other:
        served = Served(one)
        async with followed(served) as heard:
            await heard.until(lambda all: ("found", "one") in all)
            served.servers["other"] = other
            await heard.until(lambda all: ("found", "other") in all)
            await ActionClient(other, other.action).send_goal(1)
            await heard.until(lambda all: ("told", "other", 11) in all)

    assert ("reached", 1, "") in heard
    assert ("reached", 2, "") in heard
    assert heard.count(("found", "one")) == 1
    assert ("told", "other", GoalStatus.EXECUTING) in heard


@pytest.mark.asyncio
async def test_without_feedback_there_are_only_statuses() -> None:
    server = counter("one", [1, 2, "done"])
    async with server, followed(Served(server), feedback=False) as heard:
        await heard.until(lambda all: ("found", "one") in all)
        await ActionClient(server, server.action).call(1)
        await heard.until(lambda all: ("told", "one", GoalStatus.SUCCEEDED) in all)

    told = [one[2] for one in heard if one[0] == "told"]
    assert told == [GoalStatus.ACCEPTED, GoalStatus.EXECUTING, GoalStatus.SUCCEEDED]


@pytest.mark.asyncio
async def test_an_action_that_cannot_be_used_here_is_reported_once() -> None:
    one, other = counter("one"), counter("other")
    async with one, other:
        served = Served(one, other)
        served.unusable.add("one")
        async with followed(served) as heard:
            await heard.until(lambda all: all.count(("reached", 2, "")) > 3)

    assert heard.count(("gone", "one", "the type of one is not installed")) == 1
    assert ("found", "other") in heard


@pytest.mark.asyncio
async def test_a_server_that_does_not_answer_is_away_until_it_does() -> None:
    server = counter("one")
    async with server:
        served = Served(server)
        async with followed(served) as heard:
            await heard.until(lambda all: ("found", "one") in all)
            served.silent = True
            await heard.until(lambda all: ("reached", None, "it does not answer") in all)
            served.silent, served.error = False, ServerNotFound("nobody is there")
            await heard.until(lambda all: ("reached", None, "nobody is there") in all)
            served.error = None
            await heard.until(lambda all: all[-1] == ("reached", 1, ""))

    assert heard.count(("found", "one")) == 1


@pytest.mark.asyncio
async def test_a_server_that_stops_is_lost_and_found_again() -> None:
    first, second = counter("one"), counter("one")
    served = Served(first)
    recorder = Recorder()
    client = served.connection.client(first.action)
    async with anyio.create_task_group() as tasks:
        async with first:
            tasks.start_soon(lambda: follow_action(client, first.info, recorder, feedback=True))
            await recorder.heard.until(lambda all: ("found", "one") in all)
            client.endpoint = second
        await recorder.heard.until(lambda all: ("gone", "one", "its server has stopped") in all)
        async with second:
            await recorder.heard.until(lambda all: all.count(("found", "one")) == 2)
            tasks.cancel_scope.cancel()


@pytest.mark.asyncio
async def test_a_connection_that_is_lost_for_good_ends_it() -> None:
    async def lost() -> None:
        raise ConnectionLost("the line is dead")

    recorder = Recorder()
    server = Altered(counter("one"), status=lost, wait_for_server=lost)
    client = Served(server).connection.client(Action.untyped(server.info))
    with pytest.raises(ConnectionLost):
        await follow_action(client, server.info, recorder, feedback=True)
    assert recorder.heard == [("gone", "one", "the line is dead")]
    with pytest.RaisesGroup(ConnectionLost):
        await follow_actions(Served(server).connection, recorder, feedback=True)


@pytest.mark.asyncio
async def test_an_action_that_the_transport_cannot_follow_is_reported_once() -> None:
    async def refuse() -> None:
        raise TransportError("rosbridge cannot list the goals")

    one, other, recorder = Altered(counter("one"), status=refuse), counter("other"), Recorder()
    async with one, other:
        served = Served(one, other)
        with pytest.raises(TransportError, match="cannot list"):
            await follow_action(
                served.connection.client(Action.untyped(one.info)),
                one.info,
                recorder,
                feedback=True,
            )
        async with followed(served) as heard:
            await heard.until(lambda all: all.count(("reached", 2, "")) > 3)
    assert recorder.heard == []
    assert heard.count(("gone", "one", "rosbridge cannot list the goals")) == 1
    assert ("found", "other") in heard


@pytest.mark.asyncio
async def test_the_first_of_many_actions_are_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(action_listener, "MOST_ACTIONS", 1)
    one, two = counter("one"), counter("two")
    async with one, two, followed(Served(one, two)) as heard:
        await heard.until(lambda said: said.count(("reached", 2, "")) > 2)
        await heard.until(lambda said: ("found", "one") in said)

    lost = ("gone", "two", "it is not followed, because there are over 1 actions")
    assert heard.count(lost) == 1
    assert ("found", "two") not in heard
