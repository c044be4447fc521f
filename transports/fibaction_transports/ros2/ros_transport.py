"""The common part of the transports of ROS 2, whatever the middleware: settings, URLs, and both
halves.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from typing import Any, ClassVar, Final
from urllib.parse import parse_qsl, urlencode, urlsplit

import msgspec

from fibaction.border.abc import Connection, Endpoint, Transport
from fibaction.border.urls import unknown_setting, without_settings
from fibaction.words.errors import InvalidURL, TransportError
from fibaction_transports.ros2.adapter import RosAdapter
from fibaction_transports.ros2.client.endpoint import connect_actions
from fibaction_transports.ros2.names import ActionNames, action_names
from fibaction_transports.ros2.node.graph_view import FEEDBACK
from fibaction_transports.ros2.node.ros_node import RosTypes
from fibaction_transports.ros2.server.action_server import ServedEndpoint, serve_actions
from fibaction_transports.ros2.settings import EndSettings

_YES_OR_NO = {"true": True, "false": False}

IN_URLS: Final[Mapping[str, Callable[[str], Any]]] = {
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
}
"""The settings that a URL may have with every middleware, and their types."""

_USUAL = {"namespace": "", **msgspec.structs.asdict(EndSettings())}


class RosTransport(Transport):
    """The actions of a ROS graph."""

    shares_address = True
    scheme: ClassVar[str]
    """The scheme of its URLs."""

    def __init__(self, adapter: RosAdapter, ends: EndSettings, shared: Mapping[str, Any]) -> None:
        """Describe the transport; nothing is made yet.

        Args:
            adapter: The way to the graph.
            ends: The settings of the ends of actions.
            shared: The settings that a client should have as its server has them, as in a URL.
        """
        self._adapter = adapter
        self._ends = ends
        self._shared = shared
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
        return self._url(self._shared["namespace"])

    def _url_in(self, space: str) -> str:
        """Return the URL with which a client gets the namespace of a node, remapped or not."""
        is_named = space != "/" or self._shared["namespace"]
        return self._url(space if is_named else "")

    def _url(self, namespace: str) -> str:
        settings = {**self._shared, "namespace": namespace}
        given = {name: one for name, one in settings.items() if one not in (_USUAL.get(name), None)}
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
            async with serve_actions(ros, served, self._ends):
                yield self._url_in(ros.namespace)

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        """See `Transport.connect`. It does not look for servers, which may come later."""
        async with (
            self._adapter.open() as ros,
            connect_actions(ros, self._ends) as connection,
        ):
            yield connection


def _remapped(namespace: str, full: Mapping[str, ActionNames]) -> dict[str, str]:
    """Return the full names of the actions that have others than their own in this namespace."""
    found = {name: names.feedback.removesuffix(FEEDBACK) for name, names in full.items()}
    space = namespace.rstrip("/")
    return {name: one for name, one in found.items() if one not in (name, f"{space}/{name}")}


def shared_settings(namespace: str, domain_id: int | None, ends: EndSettings) -> dict[str, Any]:
    """Return the settings that a client should have as its server has them."""
    return {
        "namespace": namespace,
        "domain_id": domain_id,
        "lease": ends.lease,
        "services_qos": ends.services_qos,
        "feedback_qos": ends.feedback_qos,
        "status_qos": ends.status_qos,
    }


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


def url_parts(
    url: str, in_urls: Mapping[str, Callable[[str], Any]]
) -> tuple[str | None, dict[str, Any]]:
    """Return the name of the node in a URL, and its settings.

    Raises:
        InvalidURL: The URL is not valid; the text says what is wrong.
    """
    where = without_settings(url)
    try:
        parts = urlsplit(url)
    except ValueError as exc:
        raise InvalidURL(f"{where}: {exc}") from exc
    if parts.path.strip("/") or "#" in url:
        what = "part after #" if "#" in url else "path"
        raise InvalidURL(
            f"invalid ROS URL {where}: it has a {what}; a valid one is, for example,"
            f" {parts.scheme}://node_name?namespace=/robot1&domain_id=7"
        )
    query = parse_qsl(parts.query, keep_blank_values=True)
    return parts.netloc or None, _settings(where, query, in_urls)


def _settings(
    where: str, query: list[tuple[str, str]], in_urls: Mapping[str, Callable[[str], Any]]
) -> dict[str, Any]:
    """Return the settings in a URL, converted to their types; `where` names the URL in errors.

    Raises:
        InvalidURL: There is no such setting, or it is given twice, or has another type.
    """
    settings: dict[str, Any] = {}
    for name, text in query:
        if name not in in_urls:
            raise InvalidURL(unknown_setting(where, name, in_urls))
        if name in settings:
            raise InvalidURL(f"{where}: setting {name!r} given twice")
        try:
            settings[name] = in_urls[name](text)
        except (ValueError, KeyError):
            raise InvalidURL(f"{where}: invalid setting {name!r}: {text!r}") from None
    return settings
