"""The way to a graph of ROS through rclpy: a node of our own, with a context and a thread, or the
user's.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import AsyncGenerator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any

import anyio

from fibaction.border.event_loop import Background
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import TransportError
from fibaction_transports.ros2.node.parts import ScoutOpener, no_scout
from fibaction_transports.ros2.node.ros_node import RosAdapter, RosNode
from fibaction_transports.ros2.on_rclpy.rcl import (
    Context,
    ParameterService,
    SignalHandlerOptions,
    rclpy,
    validate_namespace,
    validate_node_name,
)
from fibaction_transports.ros2.on_rclpy.rclpy_node import RclpyNode
from fibaction_transports.ros2.on_rclpy.rclpy_types import RclpyTypes
from fibaction_transports.ros2.on_rclpy.spinner import Source, Spinner
from fibaction_transports.ros2.settings import NodeSettings, domain_in

UNSPUN = 2.0
"""Seconds after which a node that no executor has spun is told in the log."""

logger = clean_logger("fibaction.ros2")


class RclpyAdapter(RosAdapter):
    """The way to a graph of ROS through rclpy."""

    def __init__(self, settings: NodeSettings, node: Any, scout: ScoutOpener) -> None:
        """`node` is the user's own; None makes one with these settings each time. `scout` opens a
        view of the graph of a domain that tells how far discovery has come.
        """
        self._scout = scout
        self.types = RclpyTypes()
        self._settings = settings
        self._node = node

    def open(self) -> AbstractAsyncContextManager[RosNode]:
        if self._node is None:
            return own_node(self._settings, self._scout)
        return users_node(self._node, self._scout)


@asynccontextmanager
async def own_node(
    settings: NodeSettings, scout: ScoutOpener = no_scout
) -> AsyncGenerator[RclpyNode, None]:
    """Make a node in a context of its own, spun by a thread of its own.

    Raises:
        TransportError: ROS does not allow such a node.
    """
    name = settings.name or f"fibaction_{uuid.uuid4().hex[:8]}"
    _check(settings, name)
    context = Context()
    try:
        ros = _make(context, settings, name, scout)
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
    if settings.domain_id is None:
        domain_in(os.environ)  # with a wrong one, the middleware would end the process
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


def _make(context: Any, settings: NodeSettings, name: str, scout: ScoutOpener) -> RclpyNode:
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
    ros = RclpyNode(node, scout)
    for source in parameter_services(node):
        ros.keep(source.handle)
        ros.listen(source)
    return ros


@asynccontextmanager
async def users_node(node: Any, scout: ScoutOpener = no_scout) -> AsyncGenerator[RclpyNode, None]:
    """Use the node of the user, which an executor of the user spins.

    Raises:
        TransportError: It is a node of another kind, to which nothing can be added.
    """
    if not hasattr(node, "add_waitable"):
        raise TransportError(
            f"a node of the type {type(node).__name__} has no add_waitable(), which actions need:"
            " leave node= out, so that fibaction makes its own node, or use dds:// alongside it"
        )
    ros = RclpyNode(node, scout)
    try:
        ros.start()
        async with Background() as tasks:
            tasks.start_soon(ros.run, name="ros2 mailbox")
            tasks.start_soon(_warn_if_unspun, ros, name="ros2 unspun node")
            yield ros
    finally:
        ros.close()


async def _warn_if_unspun(ros: RclpyNode) -> None:
    """Log once that a node is not spun, if it is not."""
    await anyio.sleep(UNSPUN)
    if not ros.sources.is_spun:
        logger.warning(
            "the node %s is not spun, so nothing arrives at it: spin its executor in another"
            " thread, and do not wait for fibaction in a callback of a single-threaded executor",
            ros.full_name,
        )


class ParameterRequests(Source):
    """The requests to one of the services. They are answered on the event loop, where the functions
    of users belong that check values.
    """

    kind = "service"

    def __init__(self, service: Any) -> None:
        super().__init__(service.handle, sink=lambda taken: self._answer(*taken))
        self._service = service

    def take(self) -> Any:
        request, header = self.handle.service_take_request(self._service.srv_type.Request)
        return None if header is None else (request, header)

    def _answer(self, request: Any, header: Any) -> None:
        response = self._service.callback(request, self._service.srv_type.Response())
        self._service.send_response(response, header)


def parameter_services(node: Any) -> list[ParameterRequests]:
    """Make the services of a node's parameters, for `ros2 param`, and return the sources of their
    requests.

    rclpy makes them, and its executor would answer their requests. But a `Spinner` does without
    that executor, except for what is rclpy's own. So they are taken from the node, and their
    requests are taken together with everything else.
    """
    others = set(node.services)
    node._parameter_service = ParameterService(node)
    services = [one for one in node.services if one not in others]
    for service in services:
        node._services.remove(service)
    return [ParameterRequests(service) for service in services]
