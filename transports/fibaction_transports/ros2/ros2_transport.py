"""`ros2://node_name`: actions of ROS 2, through rclpy where it is installed, else over DDS."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, Unpack

import msgspec

from fibaction.border.peer_text import clean_logger
from fibaction.border.settings import TransportSettings
from fibaction.border.urls import without_settings
from fibaction.words.errors import InvalidURL
from fibaction_transports.ros2.dds_transport import DdsTransport
from fibaction_transports.ros2.on_dds.graph import open_scout
from fibaction_transports.ros2.ros_transport import RosTransport
from fibaction_transports.ros2.settings import NodeSettings, RosSettings

if TYPE_CHECKING:
    from fibaction_transports.keywords import Ros2Keywords

_RCLPY, _DDS = _WAYS = ("rclpy", "dds")
_VIA: Final = "via="

logger = clean_logger("fibaction.ros2")


class Ros2Settings(RosSettings, frozen=True, kw_only=True):
    """The settings of a `Ros2Transport`."""

    node: Any = None
    """Your own node, to be used instead of a new one. Its executor must be spinning, in another
    thread than the event loop."""
    via: Literal["", "rclpy", "dds"] = ""
    """At `ros2://`, the way to the graph: `rclpy`, or `dds`, which is `dds://`. Without it, it is
    rclpy where that is installed."""


class Ros2Transport(RosTransport):
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
            raise ValueError(f"via={made.via!r} is for URLs: use DdsTransport, or ros2://?via=dds")
        own, node = made.node, made.node_settings(node_name)
        if own is not None:
            if node != NodeSettings():
                raise ValueError("a node has its name, namespace, domain and arguments already")
            made = msgspec.structs.replace(made, namespace=own.get_namespace())
        from fibaction_transports.ros2.on_rclpy import RclpyAdapter  # which needs rclpy

        super().__init__(RclpyAdapter(node, own, open_scout), made)

    @classmethod
    def from_url(  # type: ignore[override]  # it may be of another class
        cls, url: str, **settings: Any
    ) -> RosTransport:
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
        made = super().from_url(rest, **settings)
        logger.debug("%s goes through rclpy", where)
        return made


def _split_via(url: str) -> tuple[str, str]:
    """Return the setting `via` of a URL, and the URL without it."""
    base, mark, query = url.partition("?")
    words = query.split("&")
    rest = [word for word in words if not word.startswith(_VIA)]
    via = next((word.removeprefix(_VIA) for word in words if word.startswith(_VIA)), "")
    return via, f"{base}{mark if rest else ''}{'&'.join(rest)}"
