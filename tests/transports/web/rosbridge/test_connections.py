"""Connections of rosbridge clients: who is let in, what is wrong, and the end."""

from __future__ import annotations

import json
import logging
from collections.abc import AsyncGenerator
from typing import Any

import anyio
import pytest
from wsproto.events import TextMessage

from fibaction import ActionServer, GoalHandle, Limits, Peer, Permission, RejectionCode
from fibaction.border.abc import ForwardingEndpoint, GoalRequest, GoalStream
from fibaction.words.errors import ServerNotFound
from fibaction.words.goals import CancelAnswer, GoalID
from fibaction_transports.web.http import application
from fibaction_transports.web.rosbridge.server import translator
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.transports.hearing import Hearing, hearing
from tests.transports.web.rosbridge.clients import (
    AsgiClient,
    RosbridgeClient,
    Serving,
    SocketClient,
    over_asgi,
    over_sockets,
)
from tests.transports.web.rosbridge.robot import Robot, goal, result

pytestmark = pytest.mark.anyio

TOKENS = {"secret": "ada"}


async def works(client: RosbridgeClient) -> bool:
    await client.say(goal(1, feedback=False))
    answer: Any = await client.hear()
    return bool(answer == result({"sequence": [1]}))


# Tokens and permissions


async def test_a_token_comes_in_the_header_or_in_the_first_message(serving: Serving) -> None:
    async with serving(Robot().server, tokens=TOKENS) as served:
        async with served.connect(authorization="Bearer secret") as client:
            assert await works(client)
        async with served.connect() as client:
            await client.say(op="auth", mac="secret", client="", dest="", rand="", t=0)
            assert await works(client)


@pytest.mark.parametrize(
    ("authorization", "first", "reason"),
    [
        ("", goal(1), "the server asks for a token, and the client gave none"),
        ("", {"op": "subscribe", "topic": "/a"}, "the server asks for a token"),
        ("", {"op": "auth", "mac": "guess"}, "the server rejected the client's token"),
        ("", {"op": "auth", "mac": "x" * 5000}, "bytes exceeds the limit of 4096 bytes"),
        ("Bearer guess", None, "the server rejected the client's token"),
        ("Basic secret", goal(1), "the server asks for a token"),
    ],
)
async def test_without_a_valid_token_nothing_is_answered(
    authorization: str, first: Any, reason: str, serving: Serving
) -> None:
    robot = Robot()
    with hearing() as wire:
        async with serving(robot.server, tokens=TOKENS) as served:
            async with served.connect(authorization=authorization) as client:
                if first is not None:
                    await client.say(first)
                code, said = await client.end()
        assert code in (1008, 1002, 1009)
        assert reason in said
        assert len(wire.warnings) == 1
    assert robot.runs == 0


async def test_a_token_is_not_waited_for(serving: Serving) -> None:
    settings: Any = {"tokens": TOKENS, "limits": Limits(handshake=0.05)}
    async with serving(Robot().server, **settings) as served, served.connect() as client:
        code, reason = await client.end()
        assert (code, "has not said hello" in reason) == (1013, True)


async def test_permissions_are_those_of_all_clients(serving: Serving, log: Hearing) -> None:
    forbidden = {Permission.CANCEL}

    def authorize(peer: Peer, action: str, permission: Permission) -> bool:
        return peer.name == "ada" and permission not in forbidden

    robot = Robot()
    settings: Any = {"tokens": TOKENS, "authorize": authorize}
    async with serving(robot.server, **settings) as served:
        async with served.connect(authorization="bearer secret") as client:
            await client.say(goal(50, feedback=False))
            await client.say(op="cancel_action_goal", id="g1", action="/fibonacci")
            service = "/fibonacci/_action/cancel_goal"
            await client.say(op="call_service", service=service)
            assert (await client.hear())["values"].startswith("this client may not cancel")
            await log.until("is not canceled: this client may not cancel")
            robot.go_on.set()
            assert (await client.hear())["status"] == 4
            forbidden.add(Permission.SEND)
            await client.say(goal(1))
            answer = await client.hear()
            assert answer["values"].startswith("this client may not send")
            assert (answer["result"], answer["status"]) == (False, 0)


# What is wrong


async def test_operations_that_are_not_served_are_ignored_and_logged_once(
    serving: Serving, log: Hearing
) -> None:
    async with serving(Robot().server) as served, served.connect() as client:
        for _ in range(3):
            await client.say(op="set_level", level="info")
            await client.say(op="subscribe", id="s", topic="/chatter")
            await client.say([1])
            await client.say(op=5)
            await client.say(op=None, id={})
            await client.say(op=["auth"])
        assert await works(client)
        for number in range(100):
            await client.say(op=f"op{number}")
        assert await works(client)
    ignored = [one.getMessage() for one in log.records if "is not served" in one.getMessage()]
    assert len(ignored) == translator.MOST_NOTES
    assert "'set_level'" in ignored[0]


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ({"op": "send_action_goal", "id": "a"}, {"action": "", "id": "a"}),
        ({"op": "send_action_goal", "id": 1, "action": 5}, {"action": "", "id": 1}),
        ({"op": "send_action_goal", "id": True, "action": "/a"}, {"action": "/a"}),
        ({"op": "send_action_goal", "id": "x" * 1001, "action": "/a"}, {"action": "/a"}),
        ({"op": "send_action_goal", "id": 2**63, "action": "/a"}, {"action": "/a"}),
        (goal(1, feedback="yes"), {"action": "/fibonacci", "id": "g1"}),
        (goal(1, fragment_size=0), {"action": "/fibonacci", "id": "g1"}),
        (goal(1, meta={"traceparent": 1}), {"action": "/fibonacci", "id": "g1"}),
        (goal(float("nan")), {"action": "/fibonacci", "id": "g1"}),
        ({"op": "call_service", "service": [], "id": 3}, {"service": "", "id": 3}),
        ({"op": "call_service", "service": "/a", "args": 3}, {"service": "/a"}),
        (
            '{"op":"send_action_goal","id":"\\ud800","action":"\\ud800"}',
            {"action": "?", "id": "?"},
        ),
    ],
)
async def test_a_wrong_field_is_answered(message: Any, expected: Any, serving: Serving) -> None:
    async with serving(Robot().server) as served, served.connect() as client:
        await client.say(message)
        answer = await client.hear()
        assert answer.pop("result") is False
        assert answer.pop("status", 0) == 0
        assert answer.pop("values")
        is_goal = "action" in expected
        assert answer.pop("code", None) == (RejectionCode.UNREADABLE if is_goal else None)
        op = "action_result" if is_goal else "service_response"
        assert answer == {"op": op} | expected
        assert await works(client)


async def test_a_wrong_cancel_is_logged(serving: Serving, log: Hearing) -> None:
    async with serving(Robot().server) as served, served.connect() as client:
        await client.say(op="cancel_action_goal", id="g1")
        await client.say(op="cancel_action_goal", id="g9", action="/fibonacci")
        assert await works(client)
    await log.until("'cancel_action_goal' of rosbridge is wrong")
    await log.until("canceled a goal that it has not sent")


@pytest.mark.parametrize(
    ("message", "code", "reason"),
    [
        ("hello", 1007, "it sent a message that is not JSON"),
        ('{"op":"auth","mac":' + "[" * 10_000 + "]" * 10_000 + "}", 1007, "not JSON"),
        ("[" * 300_000, 1007, "not JSON"),
        (b"\x16\0\0\0\2op\0", 1003, "binary message"),
        ("x" * (2**20 + 1), 1009, "exceeds the limit of 1048576 bytes"),
        ("é" * (2**19 + 1), 1009, "exceeds the limit of 1048576 bytes"),
        ('{"op":"fragment","id":1,"data":"","num":1,"total":1}', 1007, "number that cannot be"),
    ],
)
async def test_what_cannot_be_read_ends_the_connection_with_a_code(
    message: str | bytes, code: int, reason: str, serving: Serving
) -> None:
    robot = Robot()
    with hearing() as wire:
        async with serving(robot.server) as served, served.connect() as other:
            async with served.connect() as client:
                await client.say(goal(50, feedback=False))
                await client.say(message)
                heard_code, heard = await client.end()
            assert (heard_code, reason in heard) == (code, True)
            assert await works(other)
            assert len(wire.warnings) == 1
            robot.go_on.set()


async def test_a_message_without_end_is_refused_after_its_first_megabyte() -> None:
    piece = TextMessage(data="x" * 2**20, message_finished=False)
    with hearing() as wire:
        async with over_sockets(Robot().server) as served, served.connect() as other:
            async with served.connect() as client:
                for _ in range(2):
                    await client.send_events(piece)
                assert (await client.end())[0] == 1009
            assert await works(other)
    assert len(wire.warnings) == 1
    assert "exceeds the limit" in wire.warnings[0]


async def test_a_client_that_reads_no_errors_is_ended(serving: Serving) -> None:
    limits = Limits(queue=50_000, connections=2)
    async with serving(Robot().server, limits=limits) as served:
        async with served.connect() as other, served.connect() as client:
            wrong = json.dumps({"op": "call_service", "service": "/a" + "\\" * 400})
            if isinstance(client, AsgiClient):
                client.call.stuck = anyio.Event()
                for _ in range(300):
                    await client.say(wrong)
                await client.call.until_returned()
                return
            assert isinstance(client, SocketClient)
            with pytest.raises((anyio.BrokenResourceError, TimeoutError)), anyio.fail_after(9):
                while True:
                    await client.say(wrong)
            assert await works(other)


# Fragments


async def test_messages_come_in_fragments_in_any_order(serving: Serving) -> None:
    text = json.dumps(goal(1, feedback=False))
    pieces = [text[start : start + 30] for start in range(0, len(text), 30)]
    async with serving(Robot().server) as served, served.connect() as client:
        for num in reversed(range(len(pieces))):
            assert client.closed is None
            fragment = {"op": "fragment", "id": 0, "data": pieces[num], "num": num}
            await client.say(fragment | {"total": len(pieces)})
        assert await client.hear() == result({"sequence": [1]})


@pytest.mark.parametrize(
    "fragments",
    [
        [(0, 2), (0, 2)],
        [(2, 2)],
        [(0, 3), (1, 2)],
        [(0, 3), (2, 3), (1, 2)],
        [(4, 5), (0, 2)],
    ],
)
async def test_fragments_that_do_not_belong_together_end_the_connection(
    fragments: list[tuple[int, int]], serving: Serving
) -> None:
    async with serving(Robot().server) as served, served.connect() as client:
        for num, total in fragments:
            await client.say(op="fragment", id="a", data="{}", num=num, total=total)
        assert (await client.end())[0] == 1007


async def test_a_fragment_of_fragments_ends_the_connection(serving: Serving) -> None:
    inner = json.dumps({"op": "fragment", "id": 1, "data": "", "num": 0, "total": 1})
    async with serving(Robot().server) as served, served.connect() as client:
        await client.say(op="fragment", id=1, data=inner, num=0, total=1)
        assert "fragment within fragments" in (await client.end())[1]


async def test_large_messages_that_are_not_complete_share_the_memory_of_the_server() -> None:
    limits = Limits(total_memory=3 * 2**18)
    async with over_sockets(Robot().server, limits=limits) as served:
        async with served.connect() as first, served.connect() as second:
            piece = TextMessage(data="x" * 2**19, message_finished=False)
            for client in (first, second):
                await client.send_events(piece)
                await client.is_heard()
            await first.send_events(TextMessage(data="x"))
            code, reason = await first.end()
            assert (code, "it has no room for a large message" in reason) == (1013, True)


@pytest.mark.parametrize("size", [1, 2000])
async def test_answers_are_fragmented_where_it_is_asked_for(size: int, serving: Serving) -> None:
    async def long(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        yield Feedback([1])
        yield Result(list(range(1000)))

    server = ActionServer(FIBONACCI, long)
    async with serving(server) as served, served.connect() as client:
        await client.say(goal(1, fragment_size=size))
        assert (await client.hear())["op"] == "action_feedback"
        fragments = [await client.hear()]
        while len(fragments) < fragments[0]["total"]:
            fragments.append(await client.hear())
        text = "".join(fragment.pop("data") for fragment in fragments)
        total = -(-len(text) // max(size, 1024))
        assert fragments == [
            {"op": "fragment", "id": "g1", "num": num, "total": total} for num in range(total)
        ]
        assert json.loads(text) == result({"sequence": list(range(1000))})
        service = {"op": "call_service", "service": "/" + "x" * 1500, "fragment_size": size}
        await client.say(service)
        assert (await client.hear())["op"] == ("fragment" if size == 1 else "service_response")


# Load, loss and the end


async def test_a_client_that_reads_nothing_slows_nothing_and_gets_every_result(
    serving: Serving, log: Hearing
) -> None:
    count, text = 3000, list(range(2000))
    done = anyio.Event()

    async def busy(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        if goal.request.order == 1:
            for _ in range(count):
                yield Feedback(text)
            done.set()
        yield Result([goal.request.order])

    server = ActionServer(FIBONACCI, busy)
    async with serving(server) as served, served.connect() as other, served.connect() as slow:
        if isinstance(slow, AsgiClient):
            slow.call.stuck = anyio.Event()
        await slow.say(goal(1))
        with anyio.fail_after(20):
            await done.wait()
        await other.say(goal(2))
        assert (await other.hear())["values"] == {"sequence": [2]}
        if isinstance(slow, AsgiClient):
            assert slow.call.stuck is not None
            slow.call.stuck.set()
            slow.call.stuck = None
        heard = await slow.hear_until("action_result")
        assert heard[-1] == result({"sequence": [1]})
        missed = count - len(heard) + 1
        assert 0 < missed < count
        await log.until(f"it reads slowly: {missed} of {count} feedback messages of goal")


async def test_the_end_of_the_server_says_goodbye(serving: Serving) -> None:
    with hearing() as wire:
        async with anyio.create_task_group() as tasks:
            heard: list[Any] = []

            async def listen(client: RosbridgeClient) -> None:
                heard.append(await client.hear())
                await client.end()

            async with serving(Robot().server) as served, served.connect() as client:
                await client.say(goal(50, feedback=False))
                await client.say(goal(0, id="last", feedback=False))
                assert (await client.hear())["id"] == "last"
                tasks.start_soon(listen, client)
                await anyio.wait_all_tasks_blocked()
                await served.stop()
                with anyio.fail_after(30):
                    while client.closed is None:
                        await anyio.lowlevel.checkpoint()
            assert heard[0]["status"] == 6
            assert client.closed == (1001, "the server is closing the connection")
        assert wire.warnings == []


@pytest.mark.parametrize("orphans", ["keep", "cancel"])
async def test_a_goal_of_a_lost_tab_ends_if_so_set(orphans: str, serving: Serving) -> None:
    robot = Robot()
    settings: Any = {"grace": 0.05, "orphans": orphans}
    async with serving(robot.server, **settings) as served:
        async with served.connect() as client:
            await client.say(goal(50))
            await client.hear()
        with anyio.fail_after(30):
            if orphans == "cancel":
                await robot.ended.wait()
            else:
                await anyio.sleep(0.2)  # it is the time after which nothing must have happened
                assert not robot.ended.is_set()
                robot.go_on.set()


@pytest.mark.parametrize("orphans", ["keep", "cancel"])
async def test_a_goal_that_is_bound_to_its_tab_is_canceled_at_once(
    orphans: str, serving: Serving, log: Hearing
) -> None:
    robot = Robot()
    settings: Any = {"grace": 3600.0, "orphans": orphans}
    async with serving(robot.server, **settings) as served:
        async with served.connect() as client:
            await client.say(goal(50, cancel_on_disconnect=True))
            await client.hear()
        with anyio.fail_after(30):
            await log.until("canceling its goals with cancel_on_disconnect: 1")
            await robot.ended.wait()


class Uncancelable(ForwardingEndpoint):
    """An endpoint whose server goes away."""

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        raise ServerNotFound("it is gone")


async def test_a_goal_that_cannot_be_canceled_is_logged(serving: Serving, log: Hearing) -> None:
    robot = Robot()
    async with serving(Uncancelable(robot.server), grace=0) as served:
        async with served.connect() as client:
            await client.say(goal(50, cancel_on_disconnect=True))
            await client.hear()
        await log.until("could not be canceled: it is gone")
        robot.go_on.set()


class Broken(ForwardingEndpoint):
    """An endpoint whose goals fail on the way."""

    async def offer_goal(self, request: GoalRequest) -> GoalStream:
        stream = await super().offer_goal(request)
        stream.fail(ServerNotFound("the robot is off"))
        return stream


async def test_a_goal_that_fails_on_the_way_is_told(serving: Serving) -> None:
    robot = Robot()
    async with serving(Broken(robot.server)) as served, served.connect() as client:
        await client.say(goal(50, feedback=False))
        assert await client.hear() == result("the robot is off", 0, ok=False)
        robot.go_on.set()


async def test_a_client_without_pongs_is_dead(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(translator, "CLIENT_HEARTBEAT", 0.05)
    with hearing() as wire:
        async with over_sockets(Robot().server, heartbeat=0.05) as served:
            async with served.connect() as alive, served.connect() as dead:
                dead.answers_pings = False
                while alive.pings < 20:
                    await alive.is_heard()
                assert await works(alive)
                record = await wire.until("has been silent for")
                assert record.levelno == logging.INFO
                assert "is dead" not in record.getMessage()


async def test_an_asgi_server_watches_the_line_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(translator, "CLIENT_HEARTBEAT", 0.02)
    async with over_asgi(Robot().server, heartbeat=0.02) as served, served.connect() as client:
        await anyio.sleep(0.2)  # it is the time that must not count
        assert await works(client)


async def test_a_client_that_takes_nothing_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(application, "LEAVE", 0.05)
    with hearing() as wire:
        async with over_asgi(Robot().server, heartbeat=0.05) as served:
            async with served.connect() as client:
                client.call.stuck = anyio.Event()
                await client.say(goal(1))
                await client.call.until_returned()
        await wire.until("has read nothing for")
        assert wire.warnings == []


@pytest.mark.parametrize("error", [OSError("gone"), RuntimeError("closed")])
async def test_an_asgi_server_that_breaks_while_writing_has_lost_its_client(
    error: Exception,
) -> None:
    with hearing() as wire:
        async with over_asgi(Robot().server) as served, served.connect() as client:
            client.call.broken = error
            await client.say(goal(1))
            await wire.until("broke")
            await client.call.until_returned()
        assert wire.warnings == []
