"""The node, the thread that spins it, and the end of both."""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import AsyncGenerator
from functools import partial
from importlib import import_module
from typing import Any

import anyio
import pytest

from fibaction import blocking
from fibaction.border.event_loop import Background
from fibaction.words.errors import ConnectionLost, ServerNotFound, TransportError
from fibaction_transports.ros2 import Ros2Transport
from fibaction_transports.ros2.names import action_names
from fibaction_transports.ros2.node.mailbox import Mailbox
from fibaction_transports.ros2.on_rclpy import rclpy_adapter
from fibaction_transports.ros2.on_rclpy.rcl import (
    Context,
    InvalidHandle,
    SingleThreadedExecutor,
    rclpy,
    rclpy_qos,
    waitable,
)
from fibaction_transports.ros2.on_rclpy.rclpy_adapter import own_node, users_node
from fibaction_transports.ros2.on_rclpy.rclpy_node import RclpyNode
from fibaction_transports.ros2.on_rclpy.spinner import RosWaitable, Spinner
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.settings import NodeSettings
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.ros2.spun import spun_node
from tests.ros2.stock.process import PATIENCE
from tests.ros2.stock.telling import spin
from tests.ros2.stock.waiting import eventually
from tests.support.fibonacci import FIBONACCI

pytestmark = pytest.mark.anyio

GoalStatusArray: Any = import_module("action_msgs.msg").GoalStatusArray


def threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name == "fibaction-ros2"}


@pytest.fixture
async def ros() -> AsyncGenerator[RclpyNode, None]:
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
        with anyio.fail_after(30):
            await told.wait()
        ros.lose("it is told once")
    assert [str(error) for error in said] == ["rclpy was shut down"]
    assert threads() == set()


async def test_a_part_that_is_gone_already_may_be_removed() -> None:
    async with own_node(NodeSettings()) as ros:
        part = ros.publisher("/topic", ros.types.Parameter, EndQos())
        for _ in range(2):
            ros.remove(part)
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
        with anyio.fail_after(30):
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
        with anyio.fail_after(30):
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
        with anyio.fail_after(30):
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


async def test_a_handle_that_ros_does_not_allow_is_a_transport_error(ros: RclpyNode) -> None:
    with pytest.raises(TransportError, match="1 a"):
        ros.publisher("1 a", GoalStatusArray, EndQos())


async def test_a_call_that_fails_while_ros_is_up_is_an_error(ros: RclpyNode) -> None:
    def fail() -> None:
        raise KeyError("mine")

    with pytest.raises(KeyError):
        ros.attempt(fail)
    assert ros.attempt(divmod, 7, 2) == (3, 1)


async def test_a_call_that_fails_because_ros_was_shut_down_is_none(
    ros: RclpyNode, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "fibaction.ros2")

    def fail() -> None:
        ros.node.context.shutdown()  # in the middle
        raise RuntimeError("the context is not valid")

    assert ros.attempt(fail, otherwise=7) == 7
    assert str(ros.error) == "rclpy was shut down"
    ros.warn("a goal\nended")
    ros.complain("it is bad")
    assert caplog.messages[-2:] == ["a goal\\x0aended", "it is bad"]


async def test_a_node_that_is_not_spun_can_be_used_and_left(ros: RclpyNode) -> None:
    mine = rclpy.create_node("mine", context=ros.node.context)
    async with users_node(mine) as made:
        assert made.is_up
    mine.destroy_node()


async def test_a_node_that_nothing_spins_is_told_in_one_line(
    ros: RclpyNode, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(rclpy_adapter, "UNSPUN", 0.0)
    mine = rclpy.create_node("mine", context=ros.node.context)
    with anyio.fail_after(10):
        async with users_node(mine):
            while not caplog.messages:  # noqa: ASYNC110  # a line of the log tells nobody
                await anyio.sleep(0.01)
            await anyio.wait_all_tasks_blocked()
    (line,) = caplog.messages
    assert line.startswith(
        "the node /mine is not spun, so nothing arrives at it: spin its executor"
    )
    mine.destroy_node()


async def test_a_node_that_is_spun_is_not_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(rclpy_adapter, "UNSPUN", 1.0)
    with anyio.fail_after(10), spun_node("/spun") as mine:
        async with users_node(mine) as made:
            while not made.sources.is_spun:  # noqa: ASYNC110  # nothing tells of it
                await anyio.sleep(0.01)
            monkeypatch.setattr(rclpy_adapter, "UNSPUN", 0.0)
            await rclpy_adapter._warn_if_unspun(made)
    assert caplog.messages == []


async def test_a_node_without_waitables_is_an_error_that_says_what_to_use() -> None:
    class AsyncNode:
        """A node to which no waitable can be added."""

    with pytest.raises(
        TransportError, match=r"type AsyncNode has no add_waitable.*use dds:// alongs"
    ):
        async with users_node(AsyncNode()):
            pass


def test_a_wait_with_a_timeout_ends_in_a_callback_of_the_only_thread() -> None:
    space, ends = f"/t{uuid.uuid4().hex}", list[str]()
    context = Context()
    rclpy.init(args=[], context=context)
    node = rclpy.create_node("mine", context=context, namespace=space)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def wait() -> None:
        timer.cancel()
        with blocking.connect(Ros2Transport(node=node), FIBONACCI) as client:
            try:
                client.wait_for_server(timeout=0.2)
            except ServerNotFound as exc:
                ends.append(str(exc))

    timer = node.create_timer(0.0, wait)
    while not ends:
        executor.spin_once(timeout_sec=10)
    assert ends == ["the action 'fibonacci' was not served within 0.2 s"]
    executor.shutdown()
    node.destroy_node()
    context.try_shutdown()


async def test_a_spinner_may_be_stopped_twice(ros: RclpyNode) -> None:
    mine = rclpy.create_node("mine", context=ros.node.context)
    spinner = Spinner(mine, RosWaitable(Mailbox(ros.wake)), ros.node.context, ros.lose_later)
    spinner.start()
    spinner.stop()
    spinner.stop()
    assert len(threads()) == 1  # the other's
    mine.destroy_node()


async def test_what_rclpy_makes_at_the_node_is_served_too_and_can_be_destroyed(
    ros: RclpyNode,
) -> None:
    seen: dict[str, threading.Thread] = {}
    news = Mailbox(lambda: None)
    told = anyio.Event()

    def note(name: str) -> None:
        seen[name] = threading.current_thread()
        if len(seen) == 2:
            news.put([(lambda _: told.set(), None)])

    publisher = ros.node.create_publisher(GoalStatusArray, "mine", 1)

    def publish_once() -> None:
        note("timer")
        publisher.publish(GoalStatusArray())

    async with Background() as tasks:
        tasks.start_soon(news.run)
        timer = ros.node.create_timer(0.01, publish_once)
        subscription = ros.node.create_subscription(
            GoalStatusArray, "mine", lambda _: note("subscription"), 1
        )
        with anyio.fail_after(PATIENCE):
            await told.wait()
        assert set(seen.values()) == threads()
        ros.node.destroy_timer(timer)
        ros.node.destroy_subscription(subscription)
        seen.clear()
        told = anyio.Event()
        others = [ros.node.create_timer(0.01, partial(note, name)) for name in ("one", "two")]
        with anyio.fail_after(PATIENCE):
            await told.wait()
        for other in others:
            ros.node.destroy_timer(other)
    news.close()


async def test_a_handle_that_is_being_destroyed_is_not_waited_for(
    ros: RclpyNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = threading.Event()

    class Gone:
        def __enter__(self) -> None:
            looked.set()
            raise InvalidHandle("gone")

        def __exit__(self, *_: object) -> None:
            """Do nothing: it was not entered."""

    class Part:
        handle = Gone()

    monkeypatch.setattr(type(ros.node), "clients", [Part])
    ros.wake()
    assert await anyio.to_thread.run_sync(looked.wait, PATIENCE)
    monkeypatch.undo()
    assert len(threads()) == 1
    assert ros.is_up


async def test_a_part_that_is_destroyed_between_two_waits_is_not_waited_for_again(
    ros: RclpyNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = threading.Event()

    class Part:
        """The events of a subscription, say, which can be held until their destruction."""

        def __enter__(self) -> None:
            """Do nothing: it is held."""

        def __exit__(self, *_: object) -> None:
            """Do nothing."""

        def get_num_entities(self) -> Any:
            return waitable.NumberOfEntities()

        def add_to_wait_set(self, _: object) -> None:
            looked.set()
            raise InvalidHandle("destruction was requested")

    monkeypatch.setattr(type(ros.node), "waitables", [Part()])
    ros.wake()
    assert await anyio.to_thread.run_sync(looked.wait, PATIENCE)
    monkeypatch.undo()
    heard = anyio.Event()
    news = Mailbox(lambda: None)
    async with Background() as tasks:
        tasks.start_soon(news.run)
        timer = ros.node.create_timer(0.01, lambda: news.put([(lambda _: heard.set(), None)]))
        with anyio.fail_after(PATIENCE):
            await heard.wait()
        ros.node.destroy_timer(timer)
    news.close()
    assert ros.is_up


async def test_the_thread_takes_nothing_while_the_mailbox_is_full_and_then_goes_on(
    ros: RclpyNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    paused = threading.Event()

    def is_paused(sources: RosWaitable) -> bool:
        if is_full := sources._mailbox.is_full:
            paused.set()
        return is_full

    taken: list[Any] = []
    told = anyio.Event()

    def take(message: bytes, publisher: bytes) -> None:
        taken.append(message)
        if len(taken) == 4:
            told.set()

    ros.subscription("mine", GoalStatusArray, EndQos(depth=10), take)
    profile = rclpy_qos.QoSProfile(depth=10)
    publisher = ros.node.create_publisher(GoalStatusArray, "mine", profile)
    monkeypatch.setattr("fibaction_transports.ros2.node.mailbox.MAILBOX", 2)
    monkeypatch.setattr(RosWaitable, "is_paused", property(is_paused))

    async def readers() -> int:
        count: int = publisher.get_subscription_count()
        return count

    await eventually(readers, bool)
    for _ in range(3):
        publisher.publish(GoalStatusArray())
    assert paused.wait(PATIENCE)  # which stops the event loop, so that the mailbox stays full
    publisher.publish(GoalStatusArray())
    with anyio.fail_after(PATIENCE):
        await told.wait()


async def test_an_invalid_name_is_a_transport_error(ros: RclpyNode) -> None:
    with pytest.raises(TransportError, match="'1 a' is not a valid name in ROS"):
        action_names(ros.resolve, "1 a")


class Kept(list[str]):
    """A logger of rclpy that keeps the texts."""

    warning = error = list[str].append


@pytest.mark.promise("ERROR-5")
async def test_a_text_becomes_one_line_of_the_log_of_ros(
    ros: RclpyNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros, "_logger", kept := Kept())
    ros.warn("a\nb\x1b\ud800")
    ros.complain("x" * 10_000)

    assert kept[0] == "a\\x0ab\\x1b\\ud800"
    assert len(kept[1]) == 2000
