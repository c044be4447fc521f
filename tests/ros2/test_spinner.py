"""The waitable and the mailbox: the way from the thread that rclpy spins to the event loop."""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

import anyio
import pytest

from fibaction.border.event_loop import Background
from fibaction_transports.ros2.node.mailbox import MAILBOX, TURN, Mailbox
from fibaction_transports.ros2.on_rclpy.rcl import InvalidHandle
from fibaction_transports.ros2.on_rclpy.spinner import RosWaitable, Source
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio

pytestmark = pytest.mark.anyio


def nothing() -> None:
    """Do nothing when there is room."""


class Fake(Source):
    """A source of given items."""

    kind = "subscription"

    def __init__(self, *items: Any, sink: Any = None, kind: str = "subscription") -> None:
        super().__init__(self, sink or self.seen)
        self.kind = kind
        self.items = list(items)
        self.entered = 0
        self.got: list[Any] = []

    def __enter__(self) -> None:
        self.entered += 1

    def __exit__(self, *_: object) -> None:
        self.entered -= 1

    def seen(self, item: Any) -> None:
        self.got.append(item)

    def take(self) -> Any:
        item = self.items.pop(0) if self.items else None
        if isinstance(item, Exception):
            raise item
        return item


class WaitSet:
    """A wait set with given sources ready."""

    def __init__(self, *ready: Source) -> None:
        self.ready = ready
        self.handles: list[Any] = []

    def add(self, handle: Any) -> int:
        self.handles.append(handle)
        return len(self.handles) - 1

    add_subscription = add_client = add_service = add

    def is_ready(self, kind: str, index: int) -> bool:
        return self.handles[index] in self.ready


class Box(Mailbox):
    """A mailbox that keeps what is put into it."""

    def __init__(self) -> None:
        super().__init__(nothing)
        self.batches: list[list[Any]] = []
        self.full = False

    @property
    def is_full(self) -> bool:
        return self.full

    def put(self, items: list[Any]) -> None:
        self.batches.append([item for _, item in items])


def spun(one: RosWaitable, wait_set: Any) -> bool:
    """Do one turn of an executor; return whether something was ready."""
    with one:
        one.get_num_entities()
        one.add_to_wait_set(wait_set)
        if ready := one.is_ready(wait_set):
            one.take_data()
    return ready


async def test_items_of_any_thread_are_handled_on_the_loop_in_order() -> None:
    seen: list[tuple[int, int]] = []
    done = anyio.Event()

    def sink(number: int) -> None:
        seen.append((number, threading.get_ident()))
        if number == 999:
            done.set()

    box = Mailbox(nothing)

    def put() -> None:
        for number in range(1000):
            box.put([(sink, number)])

    thread = threading.Thread(target=put)
    async with Background() as tasks:
        tasks.start_soon(box.run)
        thread.start()
        with anyio.fail_after(30):
            await done.wait()
    thread.join()
    box.close()
    assert seen == [(number, threading.get_ident()) for number in range(1000)]


async def test_an_item_that_is_added_just_before_the_loop_sleeps_is_handled() -> None:
    done = anyio.Event()
    box = Mailbox(nothing)
    lock = box._lock

    class HeldByAnother:
        """A lock that another thread has held, to add an item."""

        def __enter__(self) -> None:
            box._items.append((lambda _: done.set(), None))

        def __exit__(self, *_: object) -> None:
            box._lock = lock

    held: Any = HeldByAnother()
    box._lock = held
    async with Background() as tasks:
        tasks.start_soon(box.run)
        with anyio.fail_after(30):
            await done.wait()
    box.close()


async def test_a_mailbox_that_was_emptied_while_it_was_found_full_is_not_full() -> None:
    class EmptiedMeanwhile(deque[Any]):
        def __len__(self) -> int:
            found = super().__len__()
            self.clear()
            return found

    box = Mailbox(nothing)
    box.put([(print, "")] * MAILBOX)
    assert box.is_full
    box._items = EmptiedMeanwhile(box._items)
    assert not box.is_full  # or `room` would never be called
    box.close()


async def test_an_item_that_cannot_be_handled_is_logged_and_the_next_is_handled(
    caplog: pytest.LogCaptureFixture,
) -> None:
    done = anyio.Event()

    def fail(item: str) -> None:
        raise KeyError(item)

    box = Mailbox(nothing)
    async with Background() as tasks:
        tasks.start_soon(box.run)
        box.put([(fail, "bad"), (lambda _: done.set(), "good")])
        with anyio.fail_after(30):
            await done.wait()
    box.close()
    assert "KeyError: 'bad'" in caplog.text


async def test_many_items_leave_turns_to_others() -> None:
    turns: list[int] = []
    handled: list[int] = []
    box = Mailbox(nothing)
    box.put([(handled.append, number) for number in range(10 * TURN)])
    async with Background() as tasks:
        tasks.start_soon(box.run)
        with anyio.fail_after(30):
            while len(handled) < 10 * TURN:
                turns.append(len(handled))
                await anyio.lowlevel.checkpoint()
    box.close()
    assert len(set(turns)) >= 3


async def test_a_full_mailbox_tells_when_it_has_room_again() -> None:
    room = anyio.Event()
    handled: list[int] = []
    box = Mailbox(room.set)
    box.put([(handled.append, number) for number in range(MAILBOX - 1)])
    assert not box.is_full
    box.put([(handled.append, MAILBOX)])
    assert box.is_full
    async with Background() as tasks:
        tasks.start_soon(box.run)
        with anyio.fail_after(10):
            await room.wait()
    assert len(handled) > MAILBOX // 2
    box.close()
    box.put([(handled.append, 0)])  # too late, and without effect


def test_all_items_are_taken_and_put_in_the_order_of_the_sources() -> None:
    box = Box()
    one = RosWaitable(box)
    first, second = Fake(1, 2), Fake(3, kind="client")
    one.add(first, second)
    assert spun(one, WaitSet(second))
    # The first was not ready when it was looked at, but it is by now.
    assert box.batches == [[1, 2, 3]]
    assert first.entered == second.entered == 0
    assert not spun(one, WaitSet())
    one.clear()
    assert not spun(one, WaitSet(first))
    box.close()


def test_nothing_is_taken_while_the_mailbox_is_full() -> None:
    box = Box()
    one = RosWaitable(box)
    source = Fake(1)
    one.add(source)
    box.full = True
    assert one.is_paused
    assert not spun(one, WaitSet(source))
    box.full = False
    assert not one.is_paused
    assert spun(one, WaitSet(source))
    assert box.batches == [[1]]
    box.close()


def test_an_item_that_cannot_be_taken_is_logged_and_the_next_is_taken(
    caplog: pytest.LogCaptureFixture,
) -> None:
    source = Fake(ValueError("no text"), 2)
    assert [item for _, item in source.take_all()] == [2]
    assert "a message could not be taken: no text" in caplog.text
    endless = Fake(*[ValueError("no text")] * 10 * TURN)
    assert endless.take_all() == []
    assert len(endless.items) == 9 * TURN


def test_a_handle_that_is_destroyed_is_left_alone() -> None:
    assert Fake(1, InvalidHandle("gone"), 2).take_all()[1:] == []

    class Gone(Fake):
        def __enter__(self) -> None:
            raise InvalidHandle("gone")

    box = Box()
    one = RosWaitable(box)
    one.add(Gone(1))
    wait_set = WaitSet()
    assert not spun(one, wait_set)
    assert wait_set.handles == []
    box.close()
