"""The actions that a bridge takes up, and those that it withdraws."""

from __future__ import annotations

from typing import Any

import anyio
import pytest

from fibaction import Action, ActionInfo, ActionServer
from fibaction._runtime.notify import Notifier
from fibaction.border.abc import Connection, Endpoint, ForwardingEndpoint
from fibaction.cli.arguments.namespaces import ROOT, Namespace
from fibaction.cli.bridge.actions import LOOKS, BridgedActions
from fibaction.cli.bridge.ends import BridgeEnd
from fibaction.cli.bridge.renames import AS_THEY_ARE, Renames
from fibaction.words.errors import ServerNotFound, TransportError
from tests.support.fibonacci import FIBONACCI, fibonacci

pytestmark = pytest.mark.asyncio


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


def bridged(renames: Renames = AS_THEY_ARE) -> tuple[BridgedActions, End]:
    end = End()
    return BridgedActions(House(), renames, end), end


async def test_what_comes_is_served_and_what_is_missing_for_long_is_not() -> None:
    actions, end = bridged()
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
    actions, end = bridged()
    for _ in range(LOOKS):
        await actions.take(infos("a"))
        for _ in range(LOOKS - 1):
            await actions.take([])
    assert end.calls == ["+a"]


async def test_what_cannot_be_used_is_left_out_and_told_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    actions, end = bridged()
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
    actions, end = bridged(Renames(ROOT, None, {"/b": "/a"}))
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
