"""How an action of a fleet takes goals, kept by the brokers for all workers."""

from __future__ import annotations

import anyio
import pytest

from fibaction import StoreError, TransportError
from fibaction_transports.nats.worker import journal
from tests.support.memory_broker import MemoryBrokers, Write
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.members import NAMES, Member, member

pytestmark = [pytest.mark.anyio, in_virtual_time()]


async def add(one: Member, text: bytes) -> bytes:
    return await one.journal.change_intake(lambda kept: kept if text in kept else kept + text)


async def test_all_workers_have_what_one_has_kept_and_no_change_is_lost() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a, member(shared, "b") as b:
        assert await b.journal.intake() == b""
        assert await add(a, b"1") == b"1"
        assert await b.journal.intake() == b"1"
        async with anyio.create_task_group() as tasks:
            for one, text in ((a, b"2"), (b, b"3"), (a, b"4")):
                tasks.start_soon(add, one, text)
        kept = await a.journal.intake()
        assert sorted(kept) == sorted(b"1234")
        assert kept == await b.journal.intake()
        assert await add(b, b"4") == kept


async def test_what_was_lost_with_its_stream_is_kept_again() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a, member(shared, "b") as b:
        await add(a, b"1")
        shared.lose_streams()
        assert await b.journal.intake() == b""
        assert await a.journal.intake() == b"1"
        assert await b.journal.intake() == b"1"


async def test_brokers_that_agree_on_their_leader_are_waited_for() -> None:
    async with (
        MemoryBrokers() as shared,
        member(shared, "a") as a,
        anyio.create_task_group() as tasks,
    ):

        async def agree() -> None:
            await anyio.sleep(10)
            a.broker.is_away = False

        await add(a, b"1")
        a.broker.is_away = True
        tasks.start_soon(agree)
        assert await a.journal.intake() == b"1"


async def test_a_lost_answer_is_looked_up() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a:

        def loses(write: Write) -> bool:
            return write.subject == NAMES.intake("count") and len(shared.writes) % 2 == 1

        shared.loses_answer = loses
        assert await add(a, b"1") == b"1"
        assert await a.journal.intake() == b"1"


async def test_a_change_that_cannot_be_kept_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal, "INTAKE_TRIES", 3)
    async with MemoryBrokers() as shared, member(shared, "a") as a:
        number = iter(range(99))

        def other_is_faster(_kept: bytes) -> bytes:
            newest = shared.newest(NAMES.intake("count"))
            shared.store(NAMES.intake("count"), b"%d" % next(number), 99)
            return b"mine" if newest is None else newest.data + b"mine"

        with pytest.raises(StoreError, match="too many others change it"):
            await a.journal.change_intake(other_is_faster)
        shared.is_full = True
        with pytest.raises(StoreError, match="maximum bytes"):
            await add(a, b"1")
        a.broker.is_away = True
        for call in (a.journal.intake(), add(a, b"2")):
            with pytest.raises(StoreError, match="the intake cannot be"):
                await call


async def test_a_stream_that_cannot_be_made_is_an_error_of_the_store(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def fail(*_: object, **__: object) -> None:
        raise TransportError("it is of something else")

    async with MemoryBrokers() as shared, member(shared, "a") as a:
        monkeypatch.setattr(a.broker, "create_streams", fail)
        with pytest.raises(StoreError, match="of something else"):
            await add(a, b"1")
