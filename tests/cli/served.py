"""A connection for tests of those who look at many actions: its servers are in this process, and
come, go and fall silent as they are told.
"""

from __future__ import annotations

import io
from collections.abc import Awaitable, Callable, Generator
from contextlib import contextmanager, redirect_stdout
from typing import Any

import anyio
import pytest

from fibaction import (
    Action,
    ActionError,
    ActionInfo,
    CancelAnswer,
    ClientConnection,
    GoalID,
    Outcome,
    TransportError,
)
from fibaction._runtime.notify import Notifier
from fibaction.border.abc import Connection, Endpoint, StatusStream
from fibaction.border.endpoints import ForwardingEndpoint
from fibaction.observe import action_listener
from fibaction.testing import ScriptedServer


def counter(name: str, *scripts: Any) -> ScriptedServer[int, int, str]:
    """A server of that name; without a script, its goals give feedback 11 and go on for ever."""
    action = Action(name, goal=int, feedback=int, result=str)
    return ScriptedServer(action, *(scripts or ([11, anyio.Event()],)))


def look_often(monkeypatch: pytest.MonkeyPatch, seconds: float = 0.02) -> None:
    """Let those who follow actions look for them so often."""
    monkeypatch.setattr(action_listener, "PERIOD", seconds)


class Altered(ForwardingEndpoint):
    """An endpoint in front of a server, some of whose calls are those of a test."""

    def __init__(self, inner: Endpoint, **calls: Callable[..., Awaitable[Any]]) -> None:
        super().__init__(inner)
        self.calls = calls

    async def status(self) -> StatusStream:
        statuses: StatusStream = await self.calls.get("status", super().status)()
        return statuses

    async def wait_for_server(self) -> None:
        await self.calls.get("wait_for_server", super().wait_for_server)()

    async def get_result(self, goal_id: GoalID) -> Outcome[bytes]:
        call = self.calls.get("get_result", super().get_result)
        outcome: Outcome[bytes] = await call(goal_id)
        return outcome

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        call = self.calls.get("cancel_goals", super().cancel_goals)
        answer: CancelAnswer = await call(goal_id, stamp)
        return answer


class Served(Connection):
    """What can be reached is what `servers` holds."""

    def __init__(self, *servers: Endpoint) -> None:
        self.servers: dict[str, Endpoint] = {one.info.name: one for one in servers}
        self.unusable: set[str] = set()
        self.error: ActionError | None = None
        self.silent = False

    @property
    def connection(self) -> ClientConnection:
        """As `connect` gives it."""
        return ClientConnection(self)

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        if action.name in self.unusable:
            raise TransportError(f"the type of {action.name} is not installed")
        return self.servers[action.name]

    async def actions(self) -> list[ActionInfo]:
        if self.silent:
            await anyio.sleep_forever()
        if self.error is not None:
            raise self.error
        return [one.info for one in self.servers.values()]


class Heard(list[Any]):
    """What has been said so far, and a way to wait for more."""

    def __init__(self) -> None:
        super().__init__()
        self._news = Notifier()

    def __call__(self, *what: Any) -> None:
        self.append(what[0] if len(what) == 1 else what)
        self._news.notify()

    @contextmanager
    def on_stdout(self) -> Generator[None, None, None]:
        """Hear each text that is printed in the block, without the end of its last line."""
        with redirect_stdout(_Hearing(self)):
            yield

    async def until(self, condition: Callable[[list[Any]], object]) -> None:
        """Wait until something has been said, and the condition holds."""
        with anyio.fail_after(10):
            while not (self and condition(self)):
                await self._news.wait()


class _Hearing(io.StringIO):
    """A file that says what is written to it."""

    def __init__(self, heard: Heard) -> None:
        super().__init__()
        self._heard = heard

    def write(self, text: str) -> int:
        written = super().write(text)
        if text:  # click also tries whether it may write, first bytes and then nothing
            self._heard(text.removesuffix("\n"))
        return written
