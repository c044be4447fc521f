"""`ros2://node_name`: actions of ROS 2, through rclpy where it is installed, else over DDS."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any, Final

from fibaction.border.peer_text import clean_logger
from fibaction.border.urls import check_settings, without_settings
from fibaction.words.errors import InvalidURL
from fibaction_transports.ros2.dds_transport import DdsTransport
from fibaction_transports.ros2.on_dds.scout import open_scout
from fibaction_transports.ros2.ros_transport import (
    IN_URLS,
    RosTransport,
    shared_settings,
    url_parts,
)
from fibaction_transports.ros2.settings import (
    LAST_DOMAIN,
    EndSettings,
    NodeSettings,
    check_range,
)

_RCLPY, _DDS = _WAYS = ("rclpy", "dds")
_VIA: Final = "via="
_RCLPY_IN_URLS: Final[Mapping[str, Callable[[str], Any]]] = {**IN_URLS, "introspection": str}
"""The settings that a URL may have with rclpy, and their types."""

logger = clean_logger("fibaction.ros2")


class Ros2Transport(RosTransport):
    """The actions of a ROS graph, through rclpy."""

    scheme = "ros2"

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
            reconnect_timeout: Seconds that a client waits for a silent server to come back.
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
        check_range("domain_id", domain_id or 0, 0, LAST_DOMAIN)
        ends = EndSettings(
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
        settings = NodeSettings(node_name or "", namespace, domain_id, arguments)
        if node is not None and settings != NodeSettings():
            raise ValueError("a node has its name, namespace, domain and arguments already")
        from fibaction_transports.ros2.on_rclpy import RclpyAdapter  # which needs rclpy

        shared = shared_settings(namespace, domain_id, ends)
        if node is not None:
            shared["namespace"] = node.get_namespace()
        super().__init__(RclpyAdapter(settings, node, open_scout), ends, shared)

    @classmethod
    def from_url(cls, url: str, **settings: Any) -> RosTransport:
        """Make a transport from `ros2://node_name`, where the name may be left out.

        It is a `DdsTransport` if `via` is `dds`, or if there is no `via` and this Python has no
        rclpy. All settings that are text or numbers can be in the URL, after `?`; `reconnect` is
        `true` or `false` there.

        Raises:
            InvalidURL: The URL is not valid; the text says what is wrong.
            TransportError: `via` is `rclpy`, and this Python has none.
            TypeError: There is no such setting.
        """
        via, rest = _split_via(url)
        via = settings.pop("via", via) or (_RCLPY if find_spec("rclpy") else _DDS)
        where = without_settings(url)
        if via not in _WAYS:
            raise InvalidURL(f"{where}: via is {' or '.join(_WAYS)}, not {via!r}")
        if via == _DDS:
            logger.info("%s goes over DDS, without ROS", where)
            return DdsTransport.from_url(
                rest.replace(cls.scheme, DdsTransport.scheme, 1), **settings
            )
        check_settings(cls.__name__, settings, (*_RCLPY_IN_URLS, "via", "arguments", "node"))
        name, found = url_parts(rest, _RCLPY_IN_URLS)
        try:
            made = cls(name, **{**found, **settings})
        except ValueError as exc:
            raise InvalidURL(f"{where}: {exc}") from exc
        logger.debug("%s goes through rclpy", where)
        return made


def _split_via(url: str) -> tuple[str, str]:
    """Return the setting `via` of a URL, and the URL without it."""
    base, mark, query = url.partition("?")
    words = query.split("&")
    rest = [word for word in words if not word.startswith(_VIA)]
    via = next((word.removeprefix(_VIA) for word in words if word.startswith(_VIA)), "")
    return via, f"{base}{mark if rest else ''}{'&'.join(rest)}"
