"""`ros2://node_name`: actions of ROS 2, served and called by a node of this process."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

import msgspec

from fibaction.border.abc import Connection, Endpoint, Transport
from fibaction.border.urls import check_settings, unknown_setting, without_settings
from fibaction.words.errors import InvalidURL, TransportError
from fibaction_transports.ros2.client.endpoint import connect_actions
from fibaction_transports.ros2.names import action_names
from fibaction_transports.ros2.node.ros_node import RosNode, RosTypes
from fibaction_transports.ros2.server.action_server import ServedEndpoint, serve_actions
from fibaction_transports.ros2.settings import (
    LAST_DOMAIN,
    EndSettings,
    NodeSettings,
    check_range,
)

_YES_OR_NO = {"true": True, "false": False}

_IN_URLS: dict[str, Callable[[str], Any]] = {
    "namespace": str,
    "domain_id": int,
    "feedback_depth": int,
    "discovery_timeout": float,
    "lease": float,
    "reconnect": _YES_OR_NO.__getitem__,
    "reconnect_timeout": float,
    "services_qos": str,
    "feedback_qos": str,
    "status_qos": str,
    "introspection": str,
}
"""The settings that a URL may have, and their types."""

_NAMES = (*_IN_URLS, "arguments", "node")
"""The settings that are given by name."""

_SHARED = ("lease", "services_qos", "feedback_qos", "status_qos")
"""The settings that a client should have as its server has them."""
_USUAL = {"namespace": "", **msgspec.structs.asdict(EndSettings())}


class Ros2Transport(Transport):
    """The actions of a ROS graph."""

    shares_address = True

    def __init__(
        self,
        node_name: str | None = None,
        *,
        namespace: str = "",
        domain_id: int | None = None,
        arguments: Sequence[str] | None = None,
        node: Any = None,
        feedback_depth: int = 1000,
        discovery_timeout: float = 4.0,
        lease: float = 2.0,
        reconnect: bool = True,
        reconnect_timeout: float = 10.0,
        services_qos: str = "",
        feedback_qos: str = "",
        status_qos: str = "",
        introspection: str = "off",
    ) -> None:
        """Describe the node; nothing is made yet. Each `serve` and `connect` makes its own.

        Args:
            node_name: The name of the node; None makes a unique name.
            namespace: The namespace of the node, and of relative names of actions.
            domain_id: The ROS domain; None takes ROS_DOMAIN_ID from the environment.
            arguments: ROS's arguments on a command line, for example
                `["--ros-args", "-r", "fibonacci:=sequence"]`; None takes the program's own.
            node: Your own node, to be used instead. Its executor must be spinning, in another
                thread than the event loop.
            feedback_depth: The number of feedback messages that are kept. A client keeps so many of
                each goal until they are read; then the oldest is dropped. A server keeps so many of
                all goals in the middleware, and publishes at most five times as many in a second.
            discovery_timeout: Seconds for which a new client waits if it finds no server. Nodes
                announce themselves at once, and again after 3 s: on a busy machine, discovery may
                take as long.
            lease: Seconds, from 0.1 to 3600. A server gives signs of life so often that clients
                with this lease, or a longer one, do not miss it. At a client, a server counts as
                silent after so many seconds without one. A client whose lease is shorter than the
                server's gets no signs of life.
            reconnect: False ends waiting calls with `ConnectionLost` as soon as their server is
                silent. It has no effect for a server.
            reconnect_timeout: Seconds that a client waits for a silent server to be there again.
            services_qos: The quality of service of the three services, as words of ROS with commas:
                `reliable` or `best_effort`, `volatile` or `transient_local`. What is left out is as
                `rcl_action` has it.
            feedback_qos: The same for the feedback topic, for example `best_effort`.
            status_qos: The same for the status topic, for example `volatile`.
            introspection: The events that the services publish at each request and answer:
                `"off"`, `"metadata"` (who, and when) or `"contents"`, which has the messages, too.

        Raises:
            ValueError: A number is out of range, a word is not valid, or both a node and its
                description are given.
            TransportError: This Python has no rclpy.
        """
        from fibaction_transports.ros2 import on_rclpy  # not before it is known to be wanted

        self._adapter = on_rclpy
        check_range("domain_id", domain_id or 0, 0, LAST_DOMAIN)
        self._ends = EndSettings(
            feedback_depth=feedback_depth,
            discovery_timeout=discovery_timeout,
            lease=lease,
            reconnect=reconnect,
            reconnect_timeout=reconnect_timeout,
            services_qos=services_qos,
            feedback_qos=feedback_qos,
            status_qos=status_qos,
            introspection=introspection,
        )
        self._settings = NodeSettings(node_name or "", namespace, domain_id, arguments)
        if node is not None and self._settings != NodeSettings():
            raise ValueError("a node has its name, namespace, domain and arguments already")
        self._node = node

    @classmethod
    def from_url(cls, url: str, **settings: Any) -> Ros2Transport:
        """Make a transport from `ros2://node_name`, where the name may be left out.

        All settings that are text or numbers can be in the URL, after `?`; `reconnect` is `true` or
        `false` there.

        Raises:
            InvalidURL: The URL is not valid; the text says what is wrong.
            TypeError: There is no such setting.
        """
        check_settings(cls.__name__, settings, _NAMES)
        where = without_settings(url)
        try:
            parts = urlsplit(url)
            if parts.path.strip("/") or "#" in url:
                what = "part after #" if "#" in url else "path"
                raise InvalidURL(
                    f"invalid ROS URL {where}: it has a {what}; a valid one is, for example,"
                    " ros2://node_name?namespace=/robot1&domain_id=7"
                )
            found = _settings(where, parse_qsl(parts.query, keep_blank_values=True))
            return cls(parts.netloc or None, **{**found, **settings})
        except ValueError as exc:
            raise InvalidURL(f"{where}: {exc}") from exc

    @property
    def url(self) -> str:
        """The URL with which a client finds the same graph, and suits servers with these
        settings.
        """
        if self._node is not None:
            return self._url_in(self._node.get_namespace())
        return self._url(self._settings.namespace)

    def _url_in(self, space: str) -> str:
        """Return the URL with which a client gets the namespace of a node, remapped or not."""
        is_named = space != "/" or self._settings.namespace or self._node is not None
        return self._url(space if is_named else "")

    def _url(self, namespace: str) -> str:
        settings = {"namespace": namespace, "domain_id": self._settings.domain_id}
        settings |= {name: getattr(self._ends, name) for name in _SHARED}
        given = {name: one for name, one in settings.items() if one not in (_USUAL.get(name), None)}
        return f"ros2://{'?' if given else ''}{urlencode(given, safe='/,')}"

    @asynccontextmanager
    async def serve(self, *endpoints: Endpoint) -> AsyncGenerator[str, None]:
        """See `Transport.serve`. First, the types of all actions are compared with those of ROS."""
        served = _served(endpoints, self._adapter.RclpyTypes())
        async with self._open() as ros:
            full = [action_names(ros.resolve, endpoint.info.name) for endpoint in endpoints]
            if len(set(full)) < len(full):
                raise TransportError("two of the endpoints serve actions of the same name")
            async with serve_actions(ros, served, self._ends):
                yield self._url_in(ros.namespace)

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        """See `Transport.connect`. It does not look for servers, which may come later."""
        async with (
            self._open() as ros,
            connect_actions(ros, self._ends) as connection,
        ):
            yield connection

    def _open(self) -> AbstractAsyncContextManager[RosNode]:
        if self._node is None:
            return self._adapter.own_node(self._settings)
        return self._adapter.users_node(self._node)


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


def _settings(where: str, query: list[tuple[str, str]]) -> dict[str, Any]:
    """Return the settings in a URL, converted to their types; `where` names the URL in errors.

    Raises:
        InvalidURL: There is no such setting, or it is given twice, or has another type.
    """
    settings: dict[str, Any] = {}
    for name, text in query:
        if name not in _IN_URLS:
            raise InvalidURL(unknown_setting(where, name, _IN_URLS))
        if name in settings:
            raise InvalidURL(f"{where}: setting {name!r} given twice")
        try:
            settings[name] = _IN_URLS[name](text)
        except (ValueError, KeyError):
            raise InvalidURL(f"{where}: invalid setting {name!r}: {text!r}") from None
    return settings
