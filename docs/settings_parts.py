"""Generated parts of the reference pages of the transports: the tables of their settings."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
from page_parts import table
from protocol_parts import docs_of_fields

from fibaction.border.settings import TransportSettings
from fibaction.wire.settings import WireSettings
from fibaction_transports._agents.agent_http_transport import AgentHttpSettings
from fibaction_transports._socket_lines.stream_transport import HostSettings
from fibaction_transports.nats.settings import NatsSettings
from fibaction_transports.ros2.on_dds.node import DdsSettings
from fibaction_transports.ros2.on_zenoh.node import ZenohSettings
from fibaction_transports.ros2.ros2_transport import Ros2Settings
from fibaction_transports.ros2.settings import RosSettings
from fibaction_transports.web.http_transport import HttpSettings
from fibaction_transports.web.rosbridge.client.link_opener import RosbridgeSettings
from fibaction_transports.web.web_transport import WebSettings
from fibaction_transports.web.websocket_transport import WebSocketSettings


def settings_part(kind: type[TransportSettings], known: type[TransportSettings] | None) -> str:
    """Return the table of some settings, but for those that others have as well."""
    described = {field: text for base in kind.__mro__[::-1] for field, text in _docs(base).items()}
    left_out = known.__struct_fields__ if known else ()
    rows = [
        [f"`{field.name}`", f"`{_default(field)}`", _half(kind, field.name), described[field.name]]
        for field in msgspec.structs.fields(kind)
        if field.name not in left_out
    ]
    return table(["Setting", "Default", "Read by", "Meaning"], rows)


def _docs(base: type) -> dict[str, str]:
    is_settings = issubclass(base, TransportSettings) and base is not TransportSettings
    return docs_of_fields(base) if is_settings else {}


def _default(field: msgspec.structs.FieldInfo) -> str:
    if isinstance(field.default, msgspec.Struct):
        return f"{type(field.default).__name__}()"
    return f'"{field.default}"' if isinstance(field.default, str) else repr(field.default)


def _half(kind: type[TransportSettings], name: str) -> str:
    half = "both"
    if not kind.for_servers or name in kind.only_for_clients:
        half = "client"
    elif not kind.for_clients or name in kind.only_for_servers:
        half = "server"
    return half if name in kind.in_urls() else f"{half}, not after `?`"


def _part(
    kind: type[TransportSettings], known: type[TransportSettings] | None = None
) -> Callable[[], str]:
    return lambda: settings_part(kind, known)


SETTINGS_PARTS: dict[str, dict[str, Callable[[], str]]] = {
    "reference/transports.md": {
        "settings of the wire protocol": _part(WireSettings),
        "settings of hosts": _part(HostSettings, WireSettings),
        "settings of WebSocket": _part(WebSocketSettings, HostSettings),
        "settings of HTTP": _part(HttpSettings, WebSocketSettings),
        "settings of rosbridge": _part(RosbridgeSettings),
        "settings of an application": _part(WebSettings, WireSettings),
        "settings of NATS": _part(NatsSettings, WireSettings),
        "settings of ROS": _part(Ros2Settings),
        "settings of DDS": _part(DdsSettings, RosSettings),
        "settings of Zenoh": _part(ZenohSettings, RosSettings),
        "settings of agents": _part(AgentHttpSettings),
    },
}
"""Function that makes each table, by page."""
