"""A node of ROS, and the thread that spins it.

Everything in ROS that this package uses is made and destroyed here, in the order that rclpy needs:
made before it is waited for, no longer waited for before it is destroyed.
"""

from __future__ import annotations

import atexit
import logging
import os
import threading
import uuid
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from typing import Any

import msgspec

from fibaction._tasks import Background
from fibaction.exceptions import ConnectionLost, TransportError
from fibaction_transports.ros2.intake import Intake, Mailbox, Source
from fibaction_transports.ros2.rcl import (
    Context,
    ExternalShutdownException,
    Future,
    InvalidHandle,
    SignalHandlerOptions,
    SingleThreadedExecutor,
    check_for_type_support,
    rclpy,
    validate_namespace,
    validate_node_name,
)

LAST_DOMAIN = 232
"""The highest domain ID: those above would have ports above 65535."""

logger = logging.getLogger("fibaction.ros2")


class NodeSettings(msgspec.Struct, frozen=True):
    """The node that is made, if the user has none."""

    name: str = ""
    """Without one, it has one that no other node has."""
    namespace: str = ""
    domain_id: int | None = None
    """None takes it from the environment's ROS_DOMAIN_ID."""
    arguments: Sequence[str] | None = None
    """What `ros2 run` would give it: `["--ros-args", "-r", "a:=b"]`; None is the command line."""


class RosNode:
    """A node with an `Intake`, for as long as a block lasts."""

    def __init__(self, node: Any) -> None:
        self.node = node
        self._logger = node.get_logger()
        self._mailbox = Mailbox(self.wake)
        self._intake = Intake(self._mailbox)
        self._handles: list[Any] = []
        self._lost: list[Callable[[ConnectionLost], None]] = []
        self.error: ConnectionLost | None = None
        """Why nothing more will arrive, if so."""

    @property
    def is_up(self) -> bool:
        """Whether ROS can still be used. Nobody announces that a signal has shut it down, or that
        the user has destroyed his node.
        """
        if self.error is None:
            if not self.node.context.ok():
                self.lose("rclpy was shut down")
            elif not self._has_node():
                self.lose("the node was destroyed")
        return self.error is None

    def _has_node(self) -> bool:
        try:
            with self.node.handle:
                return True
        except InvalidHandle:
            return False

    def attempt(self, call: Callable[..., Any], *arguments: Any, otherwise: Any = None) -> Any:
        """What a call of rclpy gives; `otherwise` if ROS has been shut down, which may happen at
        any moment.
        """
        try:
            return call(*arguments)
        except Exception:
            if self.is_up:
                raise
            return otherwise

    def warn(self, text: str) -> None:
        """Say it, as one line, in ROS's own log, which others in the graph can see."""
        if self._can_tell(text):
            self._logger.warning(one_line(text))

    def complain(self, text: str) -> None:
        """As `warn`, of an error."""
        if self._can_tell(text):
            self._logger.error(one_line(text))  # rclpy allows a line of code only one severity

    def _can_tell(self, text: str) -> bool:
        if not self.is_up:
            logger.info("%s", one_line(text))
        return self.is_up

    def make(self, kind: Any, ros_type: Any, name: str, profile: Any) -> Any:
        """A raw handle; it is destroyed at the end.

        Raises:
            TransportError: ROS does not allow it.
        """
        try:
            check_for_type_support(ros_type)
            with self.node.handle:
                handle = kind(self.node.handle, ros_type, name, profile)
        except Exception as exc:  # rclpy raises whatever rcl says
            raise TransportError(f"{name}: {exc}") from exc
        self._handles.append(handle)
        return handle

    def keep(self, handle: Any) -> Any:
        """Another raw handle to destroy at the end."""
        self._handles.append(handle)
        return handle

    def listen(self, *sources: Source) -> None:
        """Handle what arrives there: see `Intake.add`."""
        self._intake.add(*sources)
        self.wake()

    def on_loss(self, call: Callable[[ConnectionLost], None]) -> None:
        """Call that on the event loop if nothing more will arrive."""
        self._lost.append(call)

    def wake(self) -> None:
        """Make the executor look again at what to wait for."""
        executor = self.node.executor
        if executor is not None:
            executor.wake()

    def lose(self, reason: str) -> None:
        """Nothing more will arrive, and others are to see that nobody is here any more."""
        if self.error is None:
            logger.info("nothing more arrives over ROS: %s", reason)
            self.error = ConnectionLost(reason)
            for call in self._lost:
                call(self.error)
            self._destroy()

    def lose_later(self, reason: str) -> None:
        """As `lose`, but from any thread."""
        self._mailbox.put([(self.lose, reason)])

    async def run(self) -> None:
        """Handle what arrives, for ever."""
        await self._mailbox.run()

    def attach(self) -> None:
        """From now on, the node's executor takes what arrives."""
        self.node.add_waitable(self._intake)

    def close(self) -> None:
        """Destroy what was made. What an executor is just waiting for, it destroys when woken."""
        with suppress(ValueError):
            self.node.remove_waitable(self._intake)
        self._destroy()
        self._mailbox.close()

    def _destroy(self) -> None:
        self._intake.clear()
        for handle in reversed(self._handles):
            handle.destroy_when_not_in_use()
        self._handles.clear()
        self.wake()


class Spinner:
    """A thread that spins a node."""

    def __init__(self, node: Any, context: Any, on_end: Callable[[str], None]) -> None:
        self._on_end = on_end
        self._context = context
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(node)
        self._stop = Future()
        # A daemon, because a thread that is waited for could keep a program from ending; but a
        # program that ends while C++ waits dies of it, so `stop` is called then, too.
        self._thread = threading.Thread(target=self._run, name="fibaction-ros2", daemon=True)

    def start(self) -> None:
        """Begin to spin."""
        atexit.register(self.stop)
        self._thread.start()

    def stop(self) -> None:
        """Spin no more; waits for the thread, which takes a moment. Twice does nothing."""
        atexit.unregister(self.stop)
        if not self._stop.done():
            self._stop.set_result(None)
            self._thread.join()
            self._executor.shutdown()

    def _run(self) -> None:
        reason = "rclpy was shut down"
        try:
            self._executor.spin_until_future_complete(self._stop)
        except ExternalShutdownException:
            pass
        except BaseException as exc:
            # If ROS is shut down between rclpy's look whether it is up and its next wait, rclpy
            # raises whatever rcl says. With rclpy's own handlers of signals, Ctrl-C does that to
            # all contexts of the process, this one included.
            if self._context.ok():
                reason = f"the thread of rclpy has ended: {type(exc).__name__}: {exc}"
                logger.error("%s", reason, exc_info=exc)
        if not self._stop.done():
            self._on_end(reason)


@asynccontextmanager
async def own_node(settings: NodeSettings) -> AsyncGenerator[RosNode, None]:
    """A node of its own, in a context of its own, spun by a thread of its own.

    Raises:
        TransportError: ROS does not allow such a node.
    """
    name = settings.name or f"fibaction_{uuid.uuid4().hex[:8]}"
    _check(settings, name)
    context = Context()
    try:
        ros = _make(context, settings, name)
    except Exception as exc:  # rclpy raises whatever rcl says
        context.try_shutdown()
        raise TransportError(f"there can be no ROS node {name!r}: {exc}") from exc
    spinner = Spinner(ros.node, context, ros.lose_later)
    try:
        ros.attach()
        spinner.start()
        async with Background() as tasks:
            tasks.start_soon(ros.run, name="ros2 mailbox")
            yield ros
    finally:
        spinner.stop()
        ros.close()
        ros.node.destroy_node()
        context.try_shutdown()
        context.destroy()


def _check(settings: NodeSettings, name: str) -> None:
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    if settings.domain_id is None and not (domain.isdecimal() and int(domain) <= LAST_DOMAIN):
        # For one that is too high, the middleware would end the process.
        raise TransportError(
            f"ROS_DOMAIN_ID in the environment is between 0 and {LAST_DOMAIN}, not {domain!r}"
        )
    # rclpy would say it in several lines, and leave half a node behind.
    namespace = f"/{settings.namespace.removeprefix('/')}"
    for setting, value, rule, check in (
        ("node_name", name, "letters, digits and _, and starts with no digit", validate_node_name),
        (
            "namespace",
            namespace,
            "names of letters, digits and _ behind slashes",
            validate_namespace,
        ),
    ):
        try:
            check(value)
        except Exception as exc:
            raise TransportError(f"{setting} is of {rule}, unlike {value!r}") from exc


def _make(context: Any, settings: NodeSettings, name: str) -> RosNode:
    arguments = None if settings.arguments is None else list(settings.arguments)
    rclpy.init(
        args=arguments,
        context=context,
        domain_id=settings.domain_id,
        # Signals belong to the event loop: rclpy's handlers would shut ROS down before any goal
        # could be ended.
        signal_handler_options=SignalHandlerOptions.NO,
    )
    node = rclpy.create_node(
        name,
        context=context,
        namespace=settings.namespace,
        start_parameter_services=False,  # there are no parameters, and six services fewer to spin
    )
    return RosNode(node)


@asynccontextmanager
async def users_node(node: Any) -> AsyncGenerator[RosNode, None]:
    """The user's node, which his own executor spins."""
    ros = RosNode(node)
    try:
        ros.attach()
        async with Background() as tasks:
            tasks.start_soon(ros.run, name="ros2 mailbox")
            yield ros
    finally:
        ros.close()


def one_line(text: str) -> str:
    """A text as one line of ROS's log, whatever is in it."""
    return "".join(c if c.isprintable() else " " for c in text.encode("utf-8", "replace").decode())
