"""`ros2://node_name`: actions of ROS 2, served and called by a node of this process."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

from fibaction.abc import Connection, Endpoint, Transport
from fibaction.exceptions import InvalidURL, TransportError
from fibaction.urls import check_settings, unknown_setting, without_settings
from fibaction_transports.ros2.calling import connected
from fibaction_transports.ros2.names import action_names
from fibaction_transports.ros2.node import (
    LAST_DOMAIN,
    NodeSettings,
    RosNode,
    own_node,
    users_node,
)
from fibaction_transports.ros2.serving import Plan, served

_NAMES = (
    "namespace",
    "domain_id",
    "arguments",
    "node",
    "feedback_depth",
    "discovery_timeout",
)
"""The settings that are given by name."""


class Ros2Transport(Transport):
    """Everything that is an action in a ROS graph."""

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
    ) -> None:
        """Describe the node; nothing is made yet. Each `serve` and `connect` makes its own.

        Args:
            node_name: The node's name; None makes one that no other node has.
            namespace: The namespace in which the node, and relative names of actions, are.
            domain_id: Which graph; None is what the environment's ROS_DOMAIN_ID says.
            arguments: What ROS would be given on a command line, for instance
                `["--ros-args", "-r", "fibonacci:=sequence"]`; None is the program's own.
            node: A node of one's own, to be used instead. Its executor must be spinning, in
                another thread than the event loop.
            feedback_depth: How many feedback messages are kept: for a client that does not read,
                of each goal, after which the oldest is dropped; for a server, of all goals, in the
                middleware, and no faster than five times that many are published in a second.
            discovery_timeout: Seconds in which a client that has just come does not give up if it
                finds no server. Nodes announce themselves at once, and again after 3 s: on a busy
                machine it may take as long.

        Raises:
            ValueError: A number is out of range, or there is a node and its description, too.
        """
        for name, value, least, most in (
            ("domain_id", domain_id or 0, 0, LAST_DOMAIN),
            ("feedback_depth", feedback_depth, 1, 100_000),
            ("discovery_timeout", discovery_timeout, 0, math.inf),
        ):
            if not least <= value <= most:
                raise ValueError(f"{name} is between {least} and {most}, not {value}")
        self._settings = NodeSettings(node_name or "", namespace, domain_id, arguments)
        if node is not None and self._settings != NodeSettings():
            raise ValueError("a node has its name, namespace, domain and arguments already")
        self._node = node
        self._feedback_depth = feedback_depth
        self._discovery_timeout = discovery_timeout

    @classmethod
    def from_url(cls, url: str, **settings: Any) -> Ros2Transport:
        """Make it from `ros2://node_name`, where the name may be left out.

        Behind `?`: `namespace`, `domain_id`, `feedback_depth`, `discovery_timeout`.

        Raises:
            InvalidURL: The URL is another one.
            TypeError: There is no such setting.
        """
        where = without_settings(url)
        try:
            parts = urlsplit(url)
            if parts.path.strip("/") or "#" in url:
                what = "part behind #" if "#" in url else "path"
                raise InvalidURL(
                    f"{where} has a {what}, and the URL of ROS is like"
                    f" ros2://node_name?namespace=/robot1&domain_id=7"
                )
            check_settings(cls.__name__, settings, _NAMES)
            found = _settings(where, parse_qsl(parts.query, keep_blank_values=True))
            return cls(parts.netloc or None, **{**found, **settings})
        except ValueError as exc:
            raise InvalidURL(f"{where}: {exc}") from exc

    @property
    def url(self) -> str:
        """The URL under which a client finds the same graph."""
        settings = self._settings
        query = {"namespace": settings.namespace, "domain_id": settings.domain_id}
        if self._node is not None:
            query = {"namespace": self._node.get_namespace(), "domain_id": None}
        text = urlencode(
            {name: value for name, value in query.items() if value not in ("", None)}, safe="/"
        )
        return f"ros2://{f'?{text}' if text else ''}"

    @asynccontextmanager
    async def serve(self, *endpoints: Endpoint) -> AsyncGenerator[str, None]:
        """See `Transport.serve`. The types of all actions are compared with those of ROS first."""
        plans = _plans(endpoints)
        async with self._open() as ros:
            full = [action_names(ros.node, endpoint.info.name) for endpoint in endpoints]
            if len(set(full)) < len(full):
                raise TransportError("two of the endpoints serve actions of the same name")
            async with served(ros, plans, self._feedback_depth):
                yield self.url

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        """See `Transport.connect`. It finds nobody missing: servers may come later."""
        async with (
            self._open() as ros,
            connected(
                ros,
                feedback_depth=self._feedback_depth,
                discovery_timeout=self._discovery_timeout,
            ) as connection,
        ):
            yield connection

    def _open(self) -> AbstractAsyncContextManager[RosNode]:
        return own_node(self._settings) if self._node is None else users_node(self._node)


def _plans(endpoints: Sequence[Endpoint]) -> list[Plan]:
    plans: list[Plan] = []
    errors: list[str] = []
    for endpoint in endpoints:
        try:
            plans.append(Plan(endpoint))
        except TransportError as exc:
            errors.append(str(exc))
    if errors:
        raise TransportError(";\n".join(errors))
    return plans


def _settings(where: str, query: list[tuple[str, str]]) -> dict[str, Any]:
    """The settings in a URL, of their types; `where` is the rest of it, for errors.

    Raises:
        InvalidURL: There is no such setting, or it is there twice, or of another type.
    """
    kinds = {
        "namespace": str,
        "domain_id": int,
        "feedback_depth": int,
        "discovery_timeout": float,
    }
    settings: dict[str, Any] = {}
    for name, text in query:
        if name not in kinds:
            raise InvalidURL(unknown_setting(where, name, kinds))
        if name in settings:
            raise InvalidURL(f"{where}: setting given twice")
        try:
            settings[name] = kinds[name](text)
        except ValueError:
            raise InvalidURL(f"{where}: the setting {name!r} cannot be {text!r}") from None
    return settings
