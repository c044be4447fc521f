"""`ros2://node_name`: actions of ROS 2, through rclpy where it is installed, or without ROS."""

from __future__ import annotations

import os
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, Unpack

import msgspec

from fibaction.border.peer_text import clean_logger
from fibaction.border.settings import TransportSettings
from fibaction.border.urls import transport_class, without_settings
from fibaction.words.errors import InvalidURL, TransportError
from fibaction_transports.ros2.messaging.node import NodeTransport
from fibaction_transports.ros2.node.middlewares import is_zenoh_named
from fibaction_transports.ros2.on_dds.graph import open_scout
from fibaction_transports.ros2.settings import NodeSettings, RosSettings

if TYPE_CHECKING:
    from fibaction_transports.keywords import Ros2Keywords

_RCLPY, _DDS, _ZENOH = _WAYS = ("rclpy", "dds", "zenoh")
_WITHOUT_ROS: Final = {_DDS: ("dds://", "DDS"), _ZENOH: ("zenoh:///", "Zenoh")}
"""The beginning of the URL of each way without ROS, before the name of the node, and its name."""
_VIA: Final = "via="

logger = clean_logger("fibaction.ros2")


class Ros2Settings(RosSettings, frozen=True, kw_only=True):
    """The settings of a `Ros2Transport`."""

    node: Any = None
    """Your own node, to be used instead of a new one. Its executor must be spinning, in another
    thread than the event loop."""
    via: Literal["", "rclpy", "dds", "zenoh"] = ""
    """At `ros2://`, the way to the graph: `rclpy`, or without ROS `dds` or `zenoh`, as at `dds://`
    and `zenoh://`. By default, it is rclpy where that can be imported, else `zenoh` if
    `RMW_IMPLEMENTATION` is `rmw_zenoh_cpp`, and else `dds`."""


class Ros2Transport(NodeTransport):
    """The actions of a ROS graph, through rclpy."""

    settings_type: ClassVar[type[TransportSettings]] = Ros2Settings
    scheme = "ros2"

    def __init__(
        self,
        node_name: str | None = None,
        **settings: Unpack[Ros2Keywords],
    ) -> None:
        """Describe the node; nothing is made yet. Each `serve` and `connect` makes its own.

        Args:
            node_name: The name of the node; None makes a unique name.
            settings: See the table of settings.

        Raises:
            ValueError: A number is out of range, a word is not valid, or both a node and its
                description are given.
            TransportError: This Python has no rclpy.
        """
        made = Ros2Settings.of(self, settings)
        if made.via not in ("", _RCLPY):
            raise ValueError(
                f"via={made.via!r} is for URLs: use the transport of {made.via}://, or"
                f" ros2://?via={made.via}"
            )
        own, node = made.node, made.node_settings(node_name)
        if own is not None:
            if node != NodeSettings():
                raise ValueError("a node has its name, namespace, domain and arguments already")
            made = msgspec.structs.replace(made, namespace=own.get_namespace())
        from fibaction_transports.ros2.on_rclpy import RclpyAdapter  # which needs rclpy

        super().__init__(RclpyAdapter(node, own, open_scout), made)
        self.is_on_zenoh = is_zenoh_named(os.environ)

    @classmethod
    def from_url(  # type: ignore[override]  # it may be of another class
        cls, url: str, **settings: Any
    ) -> NodeTransport:
        """Make a transport from `ros2://node_name`, where the name may be left out.

        Which class it has is said by `via`. All settings that are text or numbers can be in the
        URL, after `?`; `reconnect` is `true` or `false` there.

        Raises:
            InvalidURL: The URL is not valid; the text says what is wrong.
            TransportError: `via` is `rclpy`, and this Python has none; or it is `zenoh`, and its
                library is missing.
            TypeError: There is no such setting.
        """
        via, rest = _split_via(url)
        where = without_settings(url)
        via = settings.pop("via", via) or _usual_way(where)
        if via not in _WAYS:
            raise InvalidURL(f"{where}: via is {', '.join(_WAYS[:-1])} or {_ZENOH}, not {via!r}")
        if via == _RCLPY:
            logger.debug("%s goes through rclpy", where)
            return super().from_url(rest, **settings)
        begin, name = _WITHOUT_ROS[via]
        logger.info("%s goes over %s, without ROS", where, name)
        made = transport_class(via).from_url(rest.replace("ros2://", begin, 1), **settings)
        assert isinstance(made, NodeTransport)
        return made


def _usual_way(where: str) -> str:
    """Return the way to the graph that is not given. The log says if rclpy is there in vain."""
    without = _ZENOH if is_zenoh_named(os.environ) else _DDS
    if find_spec("rclpy") is None:
        return without
    try:
        import_module("fibaction_transports.ros2.on_rclpy")
    except TransportError as exc:
        logger.warning("%s goes over %s: %s", where, _WITHOUT_ROS[without][1], exc)
        return without
    return _RCLPY


def _split_via(url: str) -> tuple[str, str]:
    """Return the setting `via` of a URL, and the URL without it."""
    base, mark, query = url.partition("?")
    words = query.split("&")
    rest = [word for word in words if not word.startswith(_VIA)]
    via = next((word.removeprefix(_VIA) for word in words if word.startswith(_VIA)), "")
    return via, f"{base}{mark if rest else ''}{'&'.join(rest)}"
