"""A node of ROS, which makes and destroys everything in ROS that this package uses.

rclpy needs an order: a handle is made before a thread waits for it, and is destroyed after no
thread waits for it any more.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from typing import Any

import msgspec

from fibaction.border.event_loop import Background
from fibaction.border.peer_text import MESSAGE, clean_logger, excerpt
from fibaction.words.errors import ConnectionLost, TransportError
from fibaction_transports.ros2.node.clock import NodeClock
from fibaction_transports.ros2.node.mailbox import Mailbox
from fibaction_transports.ros2.node.parameters import parameter_services
from fibaction_transports.ros2.node.spinner import Spinner
from fibaction_transports.ros2.node.waitable import RosWaitable, Source
from fibaction_transports.ros2.rcl import (
    Context,
    IntrospectionState,
    InvalidHandle,
    SignalHandlerOptions,
    check_for_type_support,
    rclpy,
    rclpy_qos,
    validate_namespace,
    validate_node_name,
)

LAST_DOMAIN = 232
"""The highest domain ID. Higher ones would have ports above 65535."""

logger = clean_logger("fibaction.ros2")


class NodeSettings(msgspec.Struct, frozen=True):
    """Settings of a node that fibaction makes."""

    name: str = ""
    """The name; without one, a unique name is made."""
    namespace: str = ""
    domain_id: int | None = None
    """The domain; None takes it from ROS_DOMAIN_ID in the environment."""
    arguments: Sequence[str] | None = None
    """ROS's arguments, for example `["--ros-args", "-r", "a:=b"]`; None is the command line."""


class RosNode:
    """A node with a `RosWaitable`, for as long as a block lasts."""

    def __init__(self, node: Any) -> None:
        self.node = node
        self.clock = NodeClock(node)
        self._logger = node.get_logger()
        self._mailbox = Mailbox(self.wake)
        self.sources = RosWaitable(self._mailbox)
        """The sources of fibaction at this node."""
        self._handles: list[Any] = []
        self._lost: list[Callable[[ConnectionLost], None]] = []
        self.error: ConnectionLost | None = None
        """The reason for which nothing more will arrive, if so."""

    @property
    def is_up(self) -> bool:
        """True if ROS can still be used. It is polled, because ROS does not announce that a signal
        has shut it down, or that the user has destroyed the node.
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
        """Call rclpy, and return the result; `otherwise` if ROS was shut down, which may happen at
        any moment.
        """
        try:
            return call(*arguments)
        except Exception:
            if self.is_up:
                raise
            return otherwise

    def warn(self, text: str) -> None:
        """Log a warning as one line in ROS's own log, which other nodes can read."""
        if self._can_log(text):
            self._logger.warning(excerpt(text, MESSAGE))

    def complain(self, text: str) -> None:
        """Log an error as one line in ROS's own log."""
        if self._can_log(text):
            # Not in one place with `warn`: rclpy allows one severity for each line of code.
            self._logger.error(excerpt(text, MESSAGE))

    def _can_log(self, text: str) -> bool:
        if not self.is_up:
            logger.info("%s", text)
        return self.is_up

    def make(self, kind: Any, ros_type: Any, name: str, profile: Any) -> Any:
        """Make a raw handle with this quality of service, which is destroyed at the end.

        Raises:
            TransportError: ROS does not allow it.
        """
        try:
            check_for_type_support(ros_type)
            with self.node.handle:
                handle = kind(self.node.handle, ros_type, name, profile.get_c_qos_profile())
        except Exception as exc:  # rclpy raises whatever rcl says
            raise TransportError(f"{name}: {exc}") from exc
        self._handles.append(handle)
        return handle

    def keep(self, handle: Any) -> Any:
        """Destroy this raw handle, too, at the end. Returns it."""
        self._handles.append(handle)
        return handle

    def introspect(self, level: str, *handles: Any) -> None:
        """Publish events of raw services or clients: `off`, `metadata` or `contents`."""
        if level == "off":
            return
        state = IntrospectionState.__members__[level.upper()]
        profile = rclpy_qos.qos_profile_system_default.get_c_qos_profile()
        for handle in handles:
            handle.configure_introspection(self.node.get_clock().handle, profile, state)

    def listen(self, *sources: Source, first: bool = False) -> None:
        """Take what arrives at these sources: see `RosWaitable.add`."""
        self.sources.add(*sources, first=first)
        self.wake()

    def on_loss(self, call: Callable[[ConnectionLost], None]) -> None:
        """Call this on the event loop if nothing more will arrive."""
        self._lost.append(call)

    def wake(self) -> None:
        """Make the executor collect anew what it waits for."""
        executor = self.node.executor
        if executor is not None:
            executor.wake()

    def lose(self, reason: str) -> None:
        """Note that nothing more will arrive, and leave the graph."""
        if self.error is None:
            logger.info("nothing more arrives over ROS: %s", reason)
            self.fail(ConnectionLost(reason))
            self._destroy()

    def fail(self, error: ConnectionLost) -> None:
        """End everything that is pending, and everything that is tried later, with an error."""
        if self.error is None:
            self.error = error
            for call in self._lost:
                call(error)

    def lose_later(self, reason: str) -> None:
        """Call `lose` on the event loop, from any thread."""
        self._mailbox.put([(self.lose, reason)])

    async def run(self) -> None:
        """Handle what arrives, until canceled."""
        await self._mailbox.run()

    def start(self) -> None:
        """Let the executor of a user's node take what arrives."""
        self.node.add_waitable(self.sources)

    def close(self) -> None:
        """Destroy all handles; those that an executor waits for are destroyed when it wakes."""
        with suppress(ValueError):
            self.node.remove_waitable(self.sources)
        self.clock.close()
        self._destroy()
        self._mailbox.close()

    def _destroy(self) -> None:
        self.sources.clear()
        for handle in reversed(self._handles):
            handle.destroy_when_not_in_use()
        self._handles.clear()
        self.wake()


@asynccontextmanager
async def own_node(settings: NodeSettings) -> AsyncGenerator[RosNode, None]:
    """Make a node in a context of its own, spun by a thread of its own.

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
        raise TransportError(f"cannot make the ROS node {name!r}: {exc}") from exc
    spinner = Spinner(ros.node, ros.sources, context, ros.lose_later)
    try:
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
        # With a higher one, the middleware would end the process.
        raise TransportError(
            f"invalid ROS_DOMAIN_ID in the environment: {domain!r} is not a number from 0 to"
            f" {LAST_DOMAIN}"
        )
    # rclpy's error has several lines, and leaves half a node behind.
    namespace = f"/{settings.namespace.removeprefix('/')}"
    for setting, value, rule, check in (
        (
            "node_name",
            name,
            "letters, digits and _, and does not begin with a digit",
            validate_node_name,
        ),
        (
            "namespace",
            namespace,
            "names of letters, digits and _ after slashes",
            validate_namespace,
        ),
    ):
        try:
            check(value)
        except Exception as exc:
            raise TransportError(f"invalid {setting} {value!r}: it has {rule}") from exc


def _make(context: Any, settings: NodeSettings, name: str) -> RosNode:
    arguments = None if settings.arguments is None else list(settings.arguments)
    rclpy.init(
        args=arguments,
        context=context,
        domain_id=settings.domain_id,
        # Signals belong to the event loop. rclpy's handlers would shut ROS down before the goals
        # are ended.
        signal_handler_options=SignalHandlerOptions.NO,
    )
    node = rclpy.create_node(
        name,
        context=context,
        namespace=settings.namespace,
        start_parameter_services=False,  # see `parameters`
    )
    ros = RosNode(node)
    for source in parameter_services(node):
        ros.keep(source.handle)
        ros.listen(source)
    return ros


@asynccontextmanager
async def users_node(node: Any) -> AsyncGenerator[RosNode, None]:
    """Use the node of the user, which an executor of the user spins."""
    ros = RosNode(node)
    try:
        ros.start()
        async with Background() as tasks:
            tasks.start_soon(ros.run, name="ros2 mailbox")
            yield ros
    finally:
        ros.close()
