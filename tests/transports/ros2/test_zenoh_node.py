"""A node over Zenoh: what a foreign, a full, a forgetful or a hostile peer does to it."""

from __future__ import annotations

import math
import uuid
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from functools import partial
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
import zenoh
from anyio import to_thread

from fibaction import (
    ActionServer,
    ConnectionLost,
    ProtocolError,
    ServerNotFound,
    TransportError,
    connect,
    serve,
)
from fibaction_transports.ros2.node import mailbox
from fibaction_transports.ros2.on_zenoh import ends, session
from fibaction_transports.ros2.on_zenoh.ends import QueryHeader, ZenohProvider
from fibaction_transports.ros2.on_zenoh.keys import SERVER, attachment, hash_of, key_of
from fibaction_transports.ros2.on_zenoh.node import ZenohAdapter, ZenohNode, ZenohSettings
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.settings import NodeSettings
from fibaction_transports.ros2.without_ros.descriptions.described_types import DescriptionResponse
from fibaction_transports.ros2.without_ros.messages.action_types import CANCEL_GOAL
from fibaction_transports.ros2.without_ros.messages.node_messages import PARAMETER, Parameter
from fibaction_transports.ros2.without_ros.own_node import TypeRegistry
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.fibonacci import FIBONACCI, Goal, Result, fibonacci
from tests.support.processes import PATIENCE
from tests.support.until import until

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("router")]

WORDS = bytes(16) + b"\x10" + bytes(16)
SHORT, LONG = EndQos(depth=10), EndQos(depth=1000)
WEAK = EndQos(reliability="best_effort")
LATCHED = EndQos(durability="transient_local", depth=5)


@asynccontextmanager
async def opened(name: str = "") -> AsyncGenerator[ZenohNode, None]:
    node = NodeSettings(name, f"/t{uuid.uuid4().hex}", None, [])
    with anyio.fail_after(PATIENCE):
        async with ZenohAdapter(node, ZenohSettings()).open() as found:
            yield found


class Cut(BaseException):
    """The cancellation of a task by asyncio itself, which no scope shields."""


@pytest.mark.parametrize("is_late", [False, True])
async def test_a_session_is_left_if_its_opening_in_a_thread_is_cut_short(
    is_late: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if the thread begins later."""
    calls: list[Callable[[], Any]] = []

    async def run_sync(function: Callable[..., Any], *args: Any) -> None:
        call = partial(function, *args)
        calls.append(call)
        if len(calls) == 1:
            if not is_late:
                call()
                assert session._OPEN
            raise Cut
        await to_thread.run_sync(call)

    monkeypatch.setattr(session, "to_thread", SimpleNamespace(run_sync=run_sync))
    with pytest.raises(Cut):
        async with opened():
            raise AssertionError  # pragma: no cover
    if is_late:
        await to_thread.run_sync(calls[0])
    assert not session._OPEN


async def test_nodes_that_tell_no_hashes_as_those_of_humble_are_reached_by_a_setting() -> None:
    humble = f"zenoh://?namespace=/t{uuid.uuid4().hex}&type_hashes=false"
    with anyio.fail_after(PATIENCE):
        async with serve(ActionServer(FIBONACCI, fibonacci), humble) as (url,):
            async with connect(url, FIBONACCI) as client:
                assert await client.call(Goal(3)) == Result([0, 1, 1, 2])
            usual = url.replace("&type_hashes=false", "&discovery_timeout=0.5")
            async with connect(usual, FIBONACCI) as client:
                with pytest.raises(ServerNotFound, match=r"Humble: append \?type_hashes=false"):
                    await client.call(Goal(1))


def ended(handler: Callable[[], object]) -> zenoh.handlers.Callback[zenoh.Reply]:
    return zenoh.handlers.Callback(lambda reply: None, handler, indirect=False)


async def test_a_late_subscription_gets_what_is_latched_and_knows_who_has_sent_it() -> None:
    heard: list[tuple[str, bytes]] = []

    def take(message: bytes, publisher: bytes) -> None:
        heard.append((PARAMETER.codec.decode(message).name, publisher))

    async with opened() as one, opened() as other:
        publisher = one.publisher("/latched", PARAMETER, LATCHED)
        publisher.publish(Parameter("a"))
        await until(lambda: other.count_publishers("/latched"), 1)
        subscription = other.subscription("/latched", PARAMETER, LATCHED, take)
        await until(lambda: len(heard), 1)
        assert heard == [("a", other.publishers("/latched")[0].gid)]
        assert subscription.publisher_count() == 1
        await until(publisher.reader_count, 1)
        await until(lambda: publisher.has_arrived(0), True)


async def test_a_message_without_the_words_of_ros_is_dropped(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    heard: list[bytes] = []
    async with opened() as node:
        topic = f"{node.namespace}/topic"
        node.subscription(topic, PARAMETER, SHORT, lambda message, _: heard.append(message))
        (end,) = node.graph.ends("MS", topic)
        node.session.session.put(end.key, b"a", attachment=b"short")
        node.session.session.put(end.key, b"b")
        node.session.session.put(end.key, b"c", attachment=attachment(1, bytes(16)))
        await until(lambda: heard, [b"c"])
    assert caplog.text.count("it has no attachment of ROS") == 2


async def test_what_is_missing_between_two_messages_is_counted(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As of a publisher of rclpy, which drops feedback when its queue is full."""
    monkeypatch.setattr(mailbox, "MOST_PUBLISHERS", 2)
    heard: list[bytes] = []
    async with opened() as node:
        topic = f"{node.namespace}/topic"
        node.subscription(topic, PARAMETER, SHORT, lambda message, _: heard.append(message))
        (end,) = node.graph.ends("MS", topic)
        sent = [(1, 7), (1, 8), (2, 7), (1, 9), (2, 8), (3, 1), (1, 12), (3, 5), (1, 14)]
        for publisher, number in sent:
            words = attachment(number, bytes([publisher]) * 16)
            node.session.session.put(end.key, b"a", attachment=words)
        await until(lambda: len(heard), len(sent))
    # 10 and 11 of the first one, which was forgotten for the third, are not missed; 13 is.
    told = [one.partition(":")[0] for one in caplog.messages if "was overloaded" in one]
    assert told == [f"a message on {topic} was dropped ({number} so far)" for number in (3, 4)]


@pytest.mark.parametrize(
    ("payload", "words", "problem"),
    [
        (b"\0\1\0\0" + bytes(24), None, "it does not name its client"),
        (b"\0\1\0\0" + bytes(24), b"short", "it does not name its client"),
        (None, WORDS, "it does not name its client"),
        (b"\0\1\0\0", WORDS, "it cannot be read"),
    ],
    ids=["none", "short", "empty", "unreadable"],
)
async def test_a_request_that_is_not_one_of_ros_gets_an_error_and_the_server_goes_on(
    payload: bytes | None, words: bytes | None, problem: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with opened() as node:
        service = f"{node.namespace}/cancel"

        def take(header: QueryHeader, request: Any) -> None:
            provider.answer(header, CANCEL_GOAL.Response(return_code=3))

        provider = node.provider(service, CANCEL_GOAL, LONG, take)
        (end,) = node.graph.ends(SERVER, service)
        errors: list[bool] = []
        node.session.session.get(
            end.key,
            lambda reply: errors.append(reply.err is not None),
            payload=payload,
            attachment=words,
        )
        await until(lambda: errors, [True])
        codes: list[int] = []
        caller = node.caller(
            service, CANCEL_GOAL, LONG, lambda _, one: codes.append(one.return_code)
        )
        caller.send(CANCEL_GOAL.Request())
        await until(lambda: codes, [3])
    assert problem in caplog.text


async def test_a_request_that_a_server_throws_away_is_sent_again() -> None:
    """As a server of rclpy does with the oldest of more than ten."""
    thrown: list[str] = []
    throw = ZenohProvider._receive

    def receive(provider: ZenohProvider, query: zenoh.Query) -> None:
        part = provider._key.split("/")[-3]
        if part in ("send_goal", "get_result") and thrown.count(part) < 2:
            thrown.append(part)
            query.drop()
        else:
            throw(provider, query)

    with anyio.fail_after(PATIENCE), pytest.MonkeyPatch.context() as patch:
        patch.setattr(ZenohProvider, "_receive", receive)
        where = f"zenoh://?namespace=/t{uuid.uuid4().hex}"
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), where) as (url,),
            connect(url, FIBONACCI) as client,
        ):
            assert await client.call(Goal(3)) == Result([0, 1, 1, 2])
    assert sorted(thrown) == ["get_result"] * 2 + ["send_goal"] * 2


async def test_a_server_that_forgets_a_request_is_nudged(monkeypatch: pytest.MonkeyPatch) -> None:
    """As released servers of rclpy do until anything else wakes them."""
    monkeypatch.setattr(ends, "NUDGES", 2)
    async with opened("forgetful") as server, opened() as client:
        service = f"{server.namespace}/cancel"
        waiting: list[QueryHeader] = []
        provider = server.provider(
            service, CANCEL_GOAL, SHORT, lambda header, request: waiting.append(header)
        )
        nudges: list[zenoh.Query] = []
        (waker,) = server.graph.ends(SERVER, f"{server.full_name}/get_parameter_types")
        server.session.keep(
            server.session.session.declare_queryable(
                waker.key, server.session.query_handler(nudges.append), complete=True
            )
        )
        answers: list[int] = []
        caller = client.caller(service, CANCEL_GOAL, LONG, lambda number, _: answers.append(number))
        await until(caller.is_available, True)
        number = caller.send(CANCEL_GOAL.Request())
        await until(lambda: len(nudges), 2)
        await until(lambda: caller._open[number].due, math.inf)  # no more for one that takes long
        provider.answer(waiting[0], CANCEL_GOAL.Response())
        await until(lambda: answers, [number])


async def test_the_first_of_several_answers_counts_and_an_error_is_no_answer(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    codes: list[int] = []
    unreadable: list[Exception] = []

    def take(number: int, response: Any) -> None:
        codes.append(response.return_code)

    async with opened() as server, opened() as client:

        async def ask(name: str, look: Callable[[], object], *payloads: bytes) -> int:
            """Ask a server that answers with all of these, until something is seen; return the
            number of requests.
            """
            service = f"{server.namespace}/{name}"
            key = key_of(client._domain, service, CANCEL_GOAL.name, hash_of(CANCEL_GOAL))

            def answer(query: zenoh.Query) -> None:
                for payload in payloads:
                    query.reply(key, payload)
                query.reply_err("no")
                query.drop()

            handler = server.session.query_handler(answer)
            server.session.keep(
                server.session.session.declare_queryable(key, handler, complete=True)
            )
            take_unreadable = unreadable.append if name == "told" else None
            caller = client.caller(service, CANCEL_GOAL, LONG, take, take_unreadable)
            while not look():
                caller.send(CANCEL_GOAL.Request())
                await anyio.sleep(0.05)
            return caller._number

        answers = [CANCEL_GOAL.Response(return_code=code) for code in (2, 3)]
        await ask("good", lambda: codes, *map(CANCEL_GOAL.Response.codec.encode, answers))
        asked = await ask("told", lambda: unreadable, *[b"\0\1\0\0"] * 1_000)
        assert len(unreadable) <= asked
        caplog.clear()
        await ask("untold", lambda: "an answer of" in caplog.text, b"\0\1\0\0")
        await ask("failed", lambda: "a request failed at the server" in caplog.text)
    assert set(codes) == {2}
    assert isinstance(unreadable[0], ProtocolError)


async def test_the_oldest_of_too_many_open_requests_is_forgotten(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ends, "OPEN_REQUESTS", 1)
    async with opened() as node:
        service = f"{node.namespace}/cancel"
        waiting: list[QueryHeader] = []
        provider = node.provider(
            service, CANCEL_GOAL, LONG, lambda header, request: waiting.append(header)
        )
        answers: list[int] = []
        caller = node.caller(service, CANCEL_GOAL, LONG, lambda number, _: answers.append(number))
        numbers = [caller.send(CANCEL_GOAL.Request()) for _ in range(3)]
        await until(lambda: len(waiting), 3)
        caller.forget(numbers[1])
        for header in waiting:
            provider.answer(header, CANCEL_GOAL.Response())
        await until(lambda: answers, numbers[2:])


async def test_what_is_too_much_is_dropped_and_counted(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    heard: list[bytes] = []
    async with opened() as node:
        topic, service = f"{node.namespace}/topic", f"{node.namespace}/cancel"
        node.subscription(topic, PARAMETER, SHORT, lambda message, _: heard.append(message))
        publisher = node.publisher(topic, PARAMETER, WEAK)
        node.provider(service, CANCEL_GOAL, LONG, lambda header, request: None)
        lost: list[int] = []
        caller = node.caller(
            service, CANCEL_GOAL, LONG, lambda *_: None, take_unanswered=lost.append
        )
        monkeypatch.setattr(session, "MOST_BYTES", 0)
        for _ in range(3):
            publisher.publish(Parameter())
        assert node.session.sender.held.drops.count == 3
        (end,) = node.graph.ends("MS", topic)
        node.session.session.put(end.key, b"a", attachment=attachment(1, bytes(16)))
        number = caller.send(CANCEL_GOAL.Request())
        await until(lambda: lost, [number])
        assert node.session.inbox.drops.count == 2
        monkeypatch.undo()
        publisher.publish(Parameter())
        await until(lambda: len(heard), 1)
    assert caplog.text.count("the network is too slow for what is sent") == 2


async def test_a_closed_session_is_told(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    async with opened() as node:
        caller = node.caller("/cancel", CANCEL_GOAL, LONG, lambda *_: None)
        publisher = node.publisher("/topic", PARAMETER, SHORT)
        await anyio.to_thread.run_sync(node.session.session.close)
        node.session.is_closed = True
        with pytest.raises(ConnectionLost, match="the session of Zenoh is closed"):
            caller.send(CANCEL_GOAL.Request())
        with pytest.raises(TransportError, match=r"Zenoh does not allow it: .*session closed"):
            node.publisher("/other", PARAMETER, LATCHED)
        publisher.publish(Parameter())
    assert "something could not be sent" in caplog.text


async def test_a_server_that_does_not_describe_its_services_is_asked_for_the_feedback(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    answer = TypeRegistry.answer

    def answered(registry: TypeRegistry, request: Any) -> Any:
        if request.type_name.endswith("_FeedbackMessage"):
            return answer(registry, request)
        return DescriptionResponse(failure_reason="not told")

    monkeypatch.setattr(TypeRegistry, "answer", answered)
    where = f"zenoh://?namespace=/t{uuid.uuid4().hex}"
    with anyio.fail_after(PATIENCE):
        async with serve(ActionServer(FIBONACCI, fibonacci), where) as (url,):
            monkeypatch.delenv("FIBACTION_SEARCH")
            async with connect(url) as connection:
                (info,) = [one for one in await connection.actions() if one.name == "fibonacci"]
    assert info.feedback
    assert not info.goal
    assert "tells of arduinobot_msgs/action/Fibonacci: not told" in caplog.text
