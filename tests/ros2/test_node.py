"""The thread that rclpy spins, the way from there to the event loop, and how both end."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import AsyncGenerator
from typing import Any

import anyio
import pytest

from fibaction._tasks import Background
from fibaction.exceptions import ConnectionLost, TransportError
from fibaction_transports.ros2.mailbox import MAILBOX, TURN, Mailbox
from fibaction_transports.ros2.names import action_names
from fibaction_transports.ros2.node import (
    NodeSettings,
    RosNode,
    one_line,
    own_node,
    users_node,
)
from fibaction_transports.ros2.rcl import (
    Context,
    InvalidHandle,
    SingleThreadedExecutor,
    check_for_type_support,
    raw,
    rclpy,
    rclpy_qos,
    uuid_of,
    waitable,
)
from fibaction_transports.ros2.spinner import Spinner
from fibaction_transports.ros2.waitable import RosWaitable, Source
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.ros2.stock.telling import spin

pytestmark = pytest.mark.anyio


def nothing() -> None:
    """Nobody has to be told of room."""


class Fake(Source):
    """A source of what the test says."""

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
    """A wait set in which those are ready that the test says."""

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
    """A mailbox that is looked into."""

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
    """Do what an executor does in one turn; say whether something was ready."""
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
        with anyio.fail_after(5):
            await done.wait()
    thread.join()
    box.close()
    assert seen == [(number, threading.get_ident()) for number in range(1000)]


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
    assert not box.is_full  # or nobody would say that there is room
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
        with anyio.fail_after(5):
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
        with anyio.fail_after(5):
            while len(handled) < 10 * TURN:
                turns.append(len(handled))
                await anyio.lowlevel.checkpoint()
    box.close()
    assert len(set(turns)) >= 3


async def test_a_full_mailbox_says_when_it_has_room_again() -> None:
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
    box.put([(handled.append, 0)])  # whoever is late disturbs nobody


def test_all_that_is_there_is_taken_and_handed_over_in_the_order_of_the_sources() -> None:
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
    assert not spun(one, WaitSet(source))
    box.full = False
    assert spun(one, WaitSet(source))
    assert box.batches == [[1]]
    box.close()


def test_what_cannot_be_taken_is_logged_and_the_next_is_taken(
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


def threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name == "fibaction-ros2"}


@pytest.fixture
async def ros() -> AsyncGenerator[RosNode, None]:
    async with own_node(NodeSettings()) as made:
        yield made


async def test_a_node_leaves_no_thread_behind() -> None:
    async with own_node(NodeSettings(name="mine")) as ros:
        assert ros.node.get_name() == "mine"
        assert len(threads()) == 1
    assert threads() == set()


async def test_a_node_that_was_shut_down_from_outside_says_so() -> None:
    said: list[ConnectionLost] = []
    told = anyio.Event()

    def listen(error: ConnectionLost) -> None:
        said.append(error)
        told.set()

    async with own_node(NodeSettings()) as ros:
        ros.on_loss(listen)
        ros.node.context.shutdown()
        with anyio.fail_after(5):
            await told.wait()
        ros.lose("it is told once")
    assert [str(error) for error in said] == ["rclpy was shut down"]
    assert threads() == set()


async def test_an_error_in_the_thread_is_logged_and_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    told = anyio.Event()

    def fail(self: RosWaitable, wait_set: Any) -> bool:
        raise KeyError("mine")

    async with own_node(NodeSettings()) as ros:
        ros.on_loss(lambda error: told.set())
        monkeypatch.setattr(RosWaitable, "is_ready", fail)
        ros.wake()
        with anyio.fail_after(5):
            await told.wait()
        assert "the thread of rclpy has ended: KeyError: 'mine'" in str(ros.error)
    assert caplog.records[-1].levelno == logging.ERROR
    assert threads() == set()


async def test_a_shutdown_between_two_waits_of_rclpy_is_a_shutdown_and_not_an_error(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    told = anyio.Event()
    async with own_node(NodeSettings()) as ros:
        ros.on_loss(lambda error: told.set())
        shut_down_before_the_next_wait(monkeypatch, ros.node.context)
        ros.wake()
        with anyio.fail_after(5):
            await told.wait()
        assert str(ros.error) == "rclpy was shut down"
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []
    assert threads() == set()


async def test_a_thread_that_spins_a_users_node_ends_if_rclpy_is_shut_down_between_two_waits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    context = Context()
    rclpy.init(args=[], context=context)
    executor = SingleThreadedExecutor(context=context)
    node = rclpy.create_node("mine", context=context)
    executor.add_node(node)
    async with users_node(node):
        shut_down_before_the_next_wait(monkeypatch, context)
        with anyio.fail_after(5):
            await anyio.to_thread.run_sync(spin, executor)
    executor.shutdown()
    node.destroy_node()


def shut_down_before_the_next_wait(monkeypatch: pytest.MonkeyPatch, context: Any) -> None:
    """Shut ROS down after rclpy has looked whether it is up, and before it makes its wait set."""
    count = RosWaitable.get_num_entities

    def shut_down_and_count(self: RosWaitable) -> Any:
        context.try_shutdown()
        return count(self)

    monkeypatch.setattr(RosWaitable, "get_num_entities", shut_down_and_count)


async def test_a_handle_that_ros_does_not_allow_is_a_transport_error(ros: RosNode) -> None:
    from action_msgs.msg import GoalStatusArray

    with pytest.raises(TransportError, match="1 a"):
        ros.make(
            raw.Publisher, GoalStatusArray, "1 a", rclpy_qos.QoSProfile(depth=1).get_c_qos_profile()
        )


async def test_a_call_that_fails_while_ros_is_up_is_an_error(ros: RosNode) -> None:
    def fail() -> None:
        raise KeyError("mine")

    with pytest.raises(KeyError):
        ros.attempt(fail)
    assert ros.attempt(divmod, 7, 2) == (3, 1)


async def test_a_call_that_fails_because_ros_was_shut_down_is_none(
    ros: RosNode, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "fibaction.ros2")

    def fail() -> None:
        ros.node.context.shutdown()  # in the middle
        raise RuntimeError("the context is not valid")

    assert ros.attempt(fail, otherwise=7) == 7
    assert str(ros.error) == "rclpy was shut down"
    ros.warn("a goal\nended")
    ros.complain("it is bad")
    assert caplog.messages[-2:] == ["a goal ended", "it is bad"]


async def test_a_node_that_nobody_spins_can_be_used_and_left(ros: RosNode) -> None:
    mine = rclpy.create_node("mine", context=ros.node.context)
    async with users_node(mine) as made:
        assert made.is_up
    mine.destroy_node()


async def test_a_spinner_may_be_stopped_twice(ros: RosNode) -> None:
    mine = rclpy.create_node("mine", context=ros.node.context)
    spinner = Spinner(mine, ros.node.context, ros.lose_later)
    spinner.start()
    spinner.stop()
    spinner.stop()
    assert len(threads()) == 1  # the other's
    mine.destroy_node()


async def test_a_name_that_is_none_in_ros_is_a_transport_error(ros: RosNode) -> None:
    with pytest.raises(TransportError, match="'1 a' is not a valid name in ROS"):
        action_names(ros.node, "1 a")


def test_a_text_becomes_one_line() -> None:
    assert one_line("a\nb\tc\ud800") == "a b c?"


def test_all_that_is_used_of_rclpy_is_there() -> None:
    assert waitable.Waitable is RosWaitable.__mro__[1]
    assert uuid_of(bytes(range(16))).tolist() == list(range(16))
    assert callable(check_for_type_support)
