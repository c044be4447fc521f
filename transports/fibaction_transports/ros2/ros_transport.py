"""The common part of the transports of ROS 2, whatever the middleware: settings, URLs, and both
halves.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Mapping, Sequence
from contextlib import asynccontextmanager
from typing import Any
from urllib.parse import SplitResult, urlencode

import msgspec

from fibaction.border.abc import Connection, Diagnosis, Endpoint
from fibaction.wire.transport import ConfiguredTransport
from fibaction.words.errors import TransportError
from fibaction.words.plain_data import is_list
from fibaction_transports.ros2.client.diagnosis import diagnose_graph
from fibaction_transports.ros2.client.endpoint import connect_actions
from fibaction_transports.ros2.names import ActionNames, action_names
from fibaction_transports.ros2.node.middlewares import LOCALHOST, middlewares_at
from fibaction_transports.ros2.node.parts import FEEDBACK
from fibaction_transports.ros2.node.ros_node import RosAdapter, RosTypes
from fibaction_transports.ros2.server.action_server import ServedEndpoint, serve_actions
from fibaction_transports.ros2.settings import RosSettings


class RosTransport(ConfiguredTransport):
    """The actions of a ROS graph."""

    shares_address = True
    scheme: str
    """The scheme of its URLs."""
    is_on_zenoh: bool = False
    """True if its nodes are in Zenoh, and not in DDS."""

    def __init__(self, adapter: RosAdapter, settings: RosSettings) -> None:
        """Describe the transport, with the way to the graph; nothing is made yet."""
        self._adapter = adapter
        self._settings = settings
        self._remapped: dict[str, str] = {}
        """The full names of the actions that are served under other names than their own."""

    def served_as(self, name: str) -> str:
        """See `Transport.served_as`: a remapped name is the one in the graph."""
        return self._remapped.get(name, name)

    @property
    def url(self) -> str:
        """The URL with which a client finds the same graph, and suits servers with these
        settings.
        """
        return self._url(self._settings.namespace)

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the name of the node in a URL.

        Raises:
            ValueError: It has a path.
        """
        if parts.path.strip("/"):
            raise ValueError(
                f"it has a path; a URL of ROS is, for example,"
                f" {parts.scheme}://node_name?namespace=/robot1&domain_id=7"
            )
        return {"node_name": parts.netloc or None}

    def _url_in(self, space: str) -> str:
        """Return the URL with which a client gets the namespace of a node, remapped or not."""
        is_named = space != "/" or self._settings.namespace
        return self._url(space if is_named else "")

    def _url(self, namespace: str) -> str:
        settings = msgspec.structs.replace(self._settings, namespace=namespace)
        usual = type(settings)()
        given: dict[str, str] = {}
        for name in settings.shared:
            one = getattr(settings, name)
            text = ",".join(map(str, one)) if is_list(one) else str(one)
            if one != getattr(usual, name) and text:
                given[name] = text.lower() if isinstance(one, bool) else text
        return f"{self.scheme}://{'?' if given else ''}{urlencode(given, safe='/,')}"

    @asynccontextmanager
    async def serve(self, *endpoints: Endpoint) -> AsyncGenerator[str, None]:
        """See `Transport.serve`. First, the types of all actions are compared with those of ROS."""
        served = _served(endpoints, self._adapter.types)
        async with self._adapter.open() as ros:
            full = {one.info.name: action_names(ros.resolve, one.info.name) for one in endpoints}
            if len(set(full.values())) < len(endpoints):
                raise TransportError("two of the endpoints serve actions of the same name")
            self._remapped = _remapped(ros.namespace, full)
            async with serve_actions(ros, served, self._settings):
                yield self._url_in(ros.namespace)

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        """See `Transport.connect`. It does not look for servers, which may come later."""
        async with (
            self._adapter.open() as ros,
            connect_actions(ros, self._settings, self._hints) as connection,
        ):
            yield connection

    async def diagnose(self, seconds: float, action: str = "") -> Diagnosis:
        """See `Transport.diagnose`. It listens for nodes for so many seconds."""
        there = await middlewares_at(self._hosts())
        hints = list(there.advice(at_zenoh=self.is_on_zenoh))
        return await diagnose_graph(self._adapter, self._settings, there, hints, seconds, action)

    def _hosts(self) -> list[str]:
        """Return the hosts at which a router of Zenoh may listen."""
        return [LOCALHOST]

    async def _hints(self) -> list[str]:
        """Return why nodes may be at another middleware than this one."""
        there = await middlewares_at(self._hosts())
        return list(there.advice(at_zenoh=self.is_on_zenoh))


def _remapped(namespace: str, full: Mapping[str, ActionNames]) -> dict[str, str]:
    """Return the full names of the actions that have others than their own in this namespace."""
    found = {name: names.feedback.removesuffix(FEEDBACK) for name, names in full.items()}
    space = namespace.rstrip("/")
    return {name: one for name, one in found.items() if one not in (name, f"{space}/{name}")}


def _served(endpoints: Sequence[Endpoint], types: RosTypes) -> list[ServedEndpoint]:
    served: list[ServedEndpoint] = []
    errors: list[str] = []
    for endpoint in endpoints:
        try:
            served.append(ServedEndpoint(endpoint, types))
        except TransportError as exc:
            errors.append(str(exc))
    if errors:
        raise TransportError(";\n".join(errors))
    return served
