"""What happens at all actions: who comes, who goes, and how the looking ends."""

from __future__ import annotations

import signal
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import anyio.lowlevel
import pytest

from fibaction import ActionClient, ActionInfo, ConnectionLost, GoalInfo, GoalStatus, ServerNotFound
from fibaction.cli import observing
from fibaction.cli.goal_list import AnyClient
from fibaction.cli.observing import (
    Observer,
    follow_action,
    observe,
    still_possible,
    until_interrupted,
)
from fibaction.events import GoalFeedback
from tests.cli.served import Heard, Served, counter
from tests.virtual_time import in_virtual_time


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observing, "LOOK", 0.02)


class Recorder(Observer):
    def __init__(self) -> None:
        self.heard = Heard()

    def found(self, info: ActionInfo, client: AnyClient) -> None:
        self.heard("found", info.name)

    def told(self, action: str, event: GoalInfo | GoalFeedback[Any]) -> None:
        what = event.feedback if isinstance(event, GoalFeedback) else event.status
        self.heard("told", action, what)

    def gone(self, action: str, why: str) -> None:
        self.heard("gone", action, why)

    def reached(self, actions: list[ActionInfo] | None, why: str) -> None:
        self.heard("reached", None if actions is None else len(actions), why)


@asynccontextmanager
async def observed(served: Served, *, feedback: bool = True) -> AsyncGenerator[Heard, None]:
    recorder = Recorder()

    async def run() -> None:
        await observe(served.connection, recorder, feedback=feedback)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(run)
        yield recorder.heard
        tasks.cancel_scope.cancel()


@pytest.mark.asyncio
async def test_every_action_is_followed_those_that_come_later_included() -> None:
    one, other = counter("one"), counter("other")
    async with one, other:
        served = Served(one)
        async with observed(served) as heard:
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
async def test_without_feedback_only_statuses_are_told() -> None:
    server = counter("one", [1, 2, "done"])
    async with server, observed(Served(server), feedback=False) as heard:
        await heard.until(lambda all: ("found", "one") in all)
        await ActionClient(server, server.action).call(1)
        await heard.until(lambda all: ("told", "one", GoalStatus.SUCCEEDED) in all)

    told = [one[2] for one in heard if one[0] == "told"]
    assert told == [GoalStatus.ACCEPTED, GoalStatus.EXECUTING, GoalStatus.SUCCEEDED]


@pytest.mark.asyncio
async def test_an_action_that_cannot_be_used_here_is_told_of_once() -> None:
    one, other = counter("one"), counter("other")
    async with one, other:
        served = Served(one, other)
        served.unusable.add("one")
        async with observed(served) as heard:
            await heard.until(lambda all: all.count(("reached", 2, "")) > 3)

    assert heard.count(("gone", "one", "the type of one is not installed")) == 1
    assert ("found", "other") in heard


@pytest.mark.asyncio
async def test_a_server_that_does_not_answer_is_away_until_it_does() -> None:
    server = counter("one")
    async with server:
        served = Served(server)
        async with observed(served) as heard:
            await heard.until(lambda all: ("found", "one") in all)
            served.silent = True
            await heard.until(lambda all: ("reached", None, "it does not answer") in all)
            served.silent, served.error = False, ServerNotFound("nobody is there")
            await heard.until(lambda all: ("reached", None, "nobody is there") in all)
            served.error = None
            await heard.until(lambda all: all[-1] == ("reached", 1, ""))

    assert heard.count(("found", "one")) == 1


@pytest.mark.asyncio
async def test_a_server_that_stops_is_gone_and_found_again() -> None:
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
async def test_a_connection_that_is_lost_for_good_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    server, recorder = counter("one"), Recorder()
    client = Served(server).connection.client(server.action)

    async def lost(*_: object) -> None:
        raise ConnectionLost("the line is dead")

    monkeypatch.setattr(server, "status", lost)
    monkeypatch.setattr(server, "wait_for_server", lost)
    with pytest.raises(ConnectionLost):
        await follow_action(client, server.info, recorder, feedback=True)
    assert recorder.heard == [("gone", "one", "the line is dead")]
    with pytest.raises(ConnectionLost):
        await still_possible([client])


@pytest.mark.anyio
@in_virtual_time()
async def test_waiting_for_what_may_come_back_takes_a_moment() -> None:
    server = counter("one")
    client = Served(server).connection.client(server.action)

    async def seconds(clients: list[AnyClient]) -> float:
        start = anyio.current_time()
        await still_possible(clients)
        return anyio.current_time() - start

    assert await seconds([client]) == pytest.approx(observing.LOOK)  # it has not been started
    assert await seconds([]) == pytest.approx(observing.LOOK)
    async with server:
        assert await seconds([client]) == 0


@pytest.mark.asyncio
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_a_signal_ends_what_would_go_on_for_ever(number: signal.Signals) -> None:
    async def body() -> None:
        signal.raise_signal(number)
        await anyio.sleep_forever()

    with anyio.fail_after(5):
        assert await until_interrupted(body)


@pytest.mark.asyncio
async def test_what_ends_by_itself_was_not_interrupted() -> None:
    assert not await until_interrupted(lambda: anyio.lowlevel.checkpoint())
