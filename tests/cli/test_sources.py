"""The servers of a bridge or a console, in this process: actions that come and go, and topics."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import aclosing, asynccontextmanager
from typing import Any, NoReturn

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionInfo,
    ActionServer,
    ConnectionLost,
    ServerNotFound,
    TransportError,
    __version__,
    connect,
    serve,
)
from fibaction._runtime.notify import Notifier
from fibaction.border.abc import Connection, Endpoint, ForwardingEndpoint
from fibaction.cli.arguments.names import ROOT, Namespace
from fibaction.cli.bridge import sources
from fibaction.cli.bridge.ends import AS_THEY_ARE, BridgeEnd, Renames, open_end
from fibaction.cli.bridge.sources import LOOKS, BridgedActions, BridgedSources
from fibaction.observe.sources import ListedServer
from fibaction_transports.ros2 import Node, open_node
from tests.support.fibonacci import FIBONACCI, fibonacci
from tests.support.ports import free_port
from tests.support.ros_domain import own_domain
from tests.support.zenoh_router import own_router

pytestmark = pytest.mark.anyio


class Named(ForwardingEndpoint):
    def __init__(self, info: ActionInfo) -> None:
        super().__init__(ActionServer(FIBONACCI, fibonacci))
        self._info = info

    @property
    def info(self) -> ActionInfo:
        return self._info


class House(Connection):
    """A connection whose actions are those of its lists, one list for each look."""

    def __init__(self, *looks: list[str] | None) -> None:
        self.looks = list(looks)
        self.changed = Notifier()

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        if action.name == "odd":
            raise TransportError("its type is not known")
        assert isinstance(action, ActionInfo)
        return Named(action)

    async def actions(self) -> list[ActionInfo]:
        if not self.looks:
            self.changed.notify()
            await anyio.sleep_forever()
        names = self.looks.pop(0)
        if names is None:
            raise ServerNotFound("there is no server")
        return infos(*names)


def infos(*names: str) -> list[ActionInfo]:
    """Descriptions of actions; each name may be followed by a type."""
    return [ActionInfo(name, kind) for name, _, kind in (one.partition(" ") for one in names)]


class End(BridgeEnd):
    def __init__(self) -> None:
        self.calls: list[str] = []

    async def add(self, endpoint: Endpoint) -> None:
        if endpoint.info.name == "refused":
            raise TransportError("ROS has no such type")
        self.calls.append(f"+{endpoint.info.name}")

    async def remove(self, name: str) -> None:
        self.calls.append(f"-{name}")


def bridging(renames: Renames = AS_THEY_ARE) -> tuple[BridgedActions, End]:
    end = End()
    return BridgedActions(House(), renames, end), end


async def test_what_comes_is_served_and_what_is_missing_for_long_is_not() -> None:
    actions, end = bridging()
    await actions.take(infos("a", "b"))
    await actions.take(infos("a", "c"))
    assert end.calls == ["+a", "+b", "+c"]
    for _ in range(LOOKS - 1):
        assert "-b" not in end.calls
        await actions.take(infos("a", "c"))
    assert end.calls[3:] == ["-b"]
    assert [one.info.name for one in actions.endpoints] == ["a", "c"]
    await actions.take(infos("a", "b", "c"))
    assert end.calls[4:] == ["+b"]


async def test_an_action_that_is_missing_for_a_moment_stays() -> None:
    actions, end = bridging()
    for _ in range(LOOKS):
        await actions.take(infos("a"))
        for _ in range(LOOKS - 1):
            await actions.take([])
    assert end.calls == ["+a"]


async def test_what_cannot_be_used_is_left_out_and_told_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    actions, end = bridging()
    for _ in range(2):
        await actions.take(infos("odd", "refused", "a"))
    assert end.calls == ["+a"]
    assert capsys.readouterr().err.splitlines() == [
        "/odd is left out: its type is not known",
        "/refused is left out: ROS has no such type",
    ]
    await actions.take(infos("a"))
    await actions.take(infos("odd", "a"))
    assert capsys.readouterr().err == "/odd is left out: its type is not known\n"


async def test_an_action_whose_name_is_taken_waits_for_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    actions, end = bridging(Renames(ROOT, None, {"/b": "/a"}))
    await actions.take(infos("a"))
    for _ in range(2):
        await actions.take(infos("a", "b"))
    text = "/b is left out: /a and /b cannot both be served as /a: give one another name\n"
    assert capsys.readouterr().err == text
    for _ in range(LOOKS):
        await actions.take(infos("b"))
    await actions.take(infos("b"))
    assert end.calls == ["+a", "-a", "+a"]


async def test_changes_are_followed_and_told_while_the_server_may_be_away(
    capsys: pytest.CaptureFixture[str],
) -> None:
    house, end = House(["a", "b\x1b"], None, ["a"], ["a"], ["a"]), End()
    actions = BridgedActions(house, Renames(ROOT, Namespace("/lab")), end)
    await actions.take(infos("a"))
    await follow_to_the_end(actions, house)
    assert end.calls == ["+lab/a", "+lab/b\x1b", "-lab/b\x1b"]
    assert capsys.readouterr().err.splitlines() == [
        "/b\\x1b has come, and is served as /lab/b\\x1b",
        "/b\\x1b has gone",
    ]
    house = House(["c"])
    await follow_to_the_end(BridgedActions(house, AS_THEY_ARE, End()), house)
    assert capsys.readouterr().err == "/c has come, and is served\n"


async def test_an_action_that_comes_back_with_other_types_is_told(
    capsys: pytest.CaptureFixture[str],
) -> None:
    house, end = House(["a b/action/C"], ["a b/action/C"]), End()
    actions = BridgedActions(house, AS_THEY_ARE, end)
    await actions.take(infos("a"))
    await follow_to_the_end(actions, house)
    assert end.calls == ["+a", "-a", "+a"]
    assert capsys.readouterr().err == "/a has come with other types, and is served\n"


async def follow_to_the_end(actions: BridgedActions, house: House) -> None:
    with anyio.fail_after(10):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(actions.follow, 0.0)
            await house.changed.wait()
            tasks.cancel_scope.cancel()


STRING = "std_msgs/msg/String"


@asynccontextmanager
async def bridged(
    names: dict[str, str], talker: str = "dds://talker"
) -> AsyncGenerator[tuple[Node, BridgedSources], None]:
    """Open a node that publishes, and serve all sources."""
    found = BridgedSources(names)
    with own_domain(), anyio.fail_after(60):
        async with (
            open_node(talker, arguments=[]) as node,
            open_end("tcp://127.0.0.1:0") as end,
            anyio.create_task_group() as tasks,
        ):
            for source in found.all:
                tasks.start_soon(source.serve, end)
            yield node, found
            tasks.cancel_scope.cancel()


@pytest.mark.parametrize(("name", "topic"), [("", "chatter"), ("arm", "arm/chatter")])
async def test_a_topic_begins_with_its_type_and_goes_on_with_the_newest_messages(
    name: str, topic: str
) -> None:
    await check_newest({name: "dds://"}, topic, "dds://talker")


async def test_a_topic_over_zenoh_is_read_as_well() -> None:
    with own_router():
        await check_newest({"arm": "zenoh://"}, "arm/chatter", "zenoh://")


async def check_newest(names: dict[str, str], topic: str, talker: str) -> None:
    """Read a topic of a node that talks on and on."""
    async with bridged(names, talker) as (node, found):
        publisher = node.publisher("/chatter", STRING)

        async def talk() -> None:
            for number in range(1_000_000):
                await publisher.publish({"data": str(number)})
                await anyio.sleep(0.01)

        async with anyio.create_task_group() as tasks, aclosing(found.messages(topic)) as pieces:
            while topic not in found.topics():  # noqa: ASYNC110 - the graph tells of no change
                await anyio.sleep(0.01)
            tasks.start_soon(talk)
            assert found.topics()[topic] == STRING
            kind, schema = msgspec.msgpack.decode(await anext(pieces))
            assert kind == STRING
            (text,) = (one for one in schema["$defs"].values() if one["title"] == "String")
            assert "data" in text["properties"]
            first, second = [msgspec.msgpack.decode(await anext(pieces)) for _ in range(2)]
            assert int(first["data"]) < int(second["data"])
            tasks.cancel_scope.cancel()


async def test_a_topic_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "FIND_TOPIC", 0.1)
    async with bridged({"arm": "dds://", "far": "tcp://127.0.0.1:1"}) as (_, found):
        while found.all[0].node is None:  # noqa: ASYNC110 - it tells of no change
            await anyio.sleep(0.01)
        for topic, told in (
            ("far/odom", "there is no topic far/odom"),
            ("arm/odom", "no node has had the topic /odom"),
        ):
            with pytest.raises(TransportError, match=told):
                await anext(found.messages(topic))


async def test_a_server_is_listed_as_away_until_it_is_there_and_when_it_has_gone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sources, "PERIOD", 0.02)
    robot = f"tcp://127.0.0.1:{free_port()}"
    found = BridgedSources({"arm": robot, "far": "tcp://127.0.0.1:1"})

    async def until(*, reached: bool) -> ListedServer:
        while found.reached()["arm"] is not reached:  # noqa: ASYNC110 - it tells of no change
            await anyio.sleep(0.01)
        return (await found.infos())[0]

    with anyio.fail_after(60):
        async with open_end("tcp://127.0.0.1:0") as end, anyio.create_task_group() as tasks:
            assert [one.away is not None for one in await found.infos()] == [True, True]
            for source in found.all:
                tasks.start_soon(source.serve, end)
            async with serve(ActionServer(FIBONACCI, fibonacci), robot):
                listed = await until(reached=True)
                assert (listed.actions, listed.away, listed.url) == (["arm/fibonacci"], None, robot)
                assert listed.version == __version__
            gone = await until(reached=False)
            assert gone.away is not None
            assert (gone.actions, gone.workers) == (["arm/fibonacci"], [])
            tasks.cancel_scope.cancel()


async def test_a_server_that_cannot_be_connected_to_is_tried_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sources, "PERIOD", 0.01)
    tries: list[str] = []

    def refused(url: str) -> NoReturn:
        tries.append(url)
        raise ConnectionLost("the brokers are away")

    monkeypatch.setattr(sources, "connect", refused)
    server = sources.SourceServer("fleet", "tcp://127.0.0.1:1")
    async with open_end("tcp://127.0.0.1:0") as end, anyio.create_task_group() as tasks:
        tasks.start_soon(server.serve, end)
        with anyio.fail_after(20):
            while len(tries) < 3:  # noqa: ASYNC110 - it tells of no change
                await anyio.sleep(0.01)
        assert server.absence is not None
        assert server.absence.reason == "the brokers are away"
        tasks.cancel_scope.cancel()


async def test_the_only_server_has_to_be_there_and_several_may_come_later() -> None:
    nobody, here = "tcp://127.0.0.1:1", "tcp://127.0.0.1:0"
    with anyio.fail_after(60):
        with pytest.raises(ServerNotFound):
            async with BridgedSources({"": nobody}).served_at(here):
                raise AssertionError
        async with BridgedSources({"arm": nobody, "far": nobody}).served_at(here) as end:
            async with connect(end.where) as connection:
                assert await connection.actions() == []
        async with serve(ActionServer(FIBONACCI, fibonacci), here) as (robot,):
            async with BridgedSources({"arm": robot}).served_at(here) as end:
                async with connect(end.where) as connection:
                    [info] = await connection.actions()
                    assert info.name == "arm/fibonacci"


async def test_a_fleet_that_does_not_tell_its_workers_is_listed_without_them() -> None:
    class Away:
        release = ""

        async def workers(self) -> NoReturn:
            raise ConnectionLost("the brokers are away")

    server = sources.SourceServer("fleet", "nats://127.0.0.1/fleet?token=x")
    server._connection = Away()  # type: ignore[assignment]  # a part of a connection
    info = await server.info()
    assert (info.workers, info.url) == ([], "nats://127.0.0.1/fleet")
