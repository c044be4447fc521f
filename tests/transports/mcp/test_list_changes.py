"""The clients that are told that the list of tools has changed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from fibaction_transports.mcp.tool_server import SESSION_HEADER, ListChanges

pytestmark = pytest.mark.asyncio


class Session:
    """A client that is told, or that does not read."""

    def __init__(self, *, reads: bool = True) -> None:
        self.told = 0
        self._reads = reads

    async def send_tool_list_changed(self) -> None:
        if not self._reads:
            await anyio.sleep_forever()
        self.told += 1


def request(session: Session, identity: object, http: str | None = None) -> Any:
    headers = {} if http is None else {SESSION_HEADER: http}
    return SimpleNamespace(
        protocol_version="2025-11-25",
        session=session,
        lifespan_context=identity,
        request=None if http is None else SimpleNamespace(headers=headers),
    )


async def test_each_client_is_told_once_by_its_newest_session() -> None:
    changes, old, new, other = ListChanges(), Session(), Session(), Session()
    async with changes.connection() as one, changes.connection() as two:
        changes.note(request(old, one))
        changes.note(request(new, one))
        changes.note(request(other, two))
        await changes.tell()
    assert (old.told, new.told, other.told) == (0, 1, 1)
    await changes.tell()
    assert (new.told, other.told) == (1, 1)


async def test_sessions_over_http_are_kept_apart_and_limited() -> None:
    changes, sessions = ListChanges(most_sessions=2), [Session() for _ in range(3)]
    async with changes.connection() as identity:
        for number, session in enumerate(sessions):
            changes.note(request(session, identity, f"session {number}"))
        await changes.tell()
    assert [session.told for session in sessions] == [0, 1, 1]


async def test_a_client_that_does_not_read_holds_no_other_up() -> None:
    changes = ListChanges(tell_timeout=0.02)
    deaf, other = Session(reads=False), Session()
    async with changes.connection() as one, changes.connection() as two:
        changes.note(request(deaf, one))
        changes.note(request(other, two))
        await changes.tell()
    assert other.told == 1
