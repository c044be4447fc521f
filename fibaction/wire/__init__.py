"""The wire protocol: both halves of a connection over any transport that moves frames.

For authors of transports it has `WireTransport`, the base of their class, and `Line`, `Channel` and
`StreamChannel`, of which they supply one. For callers it has the settings of such transports. The
modules are the reference of the rest: `errors` has the number of each error, `heartbeat` decides
when a peer is dead, `reconnect` when to connect again, `auth` who may do what, and `ownership` what
happens to the goals of a client that is gone.

The names are imported when they are used: `fibaction` itself needs three light ones.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fibaction.wire.auth import AccessPolicy, Authorize, Peer, Permission
    from fibaction.wire.channel import Channel, Line, NextFrames, OnFrames, StreamChannel
    from fibaction.wire.connection import RemoteConnection, open_connection
    from fibaction.wire.settings import (
        ClientKeywords,
        ClientSettings,
        Limits,
        ServerKeywords,
        ServerSettings,
        WireKeywords,
    )
    from fibaction.wire.tls_files import TlsFiles
    from fibaction.wire.transport import FromText, WireTransport, boolean, host_only
    from fibaction.wire.wire_server import WireServer, open_server

__all__ = [
    "AccessPolicy",
    "Authorize",
    "Channel",
    "ClientKeywords",
    "ClientSettings",
    "FromText",
    "Limits",
    "Line",
    "NextFrames",
    "OnFrames",
    "Peer",
    "Permission",
    "RemoteConnection",
    "ServerKeywords",
    "ServerSettings",
    "StreamChannel",
    "TlsFiles",
    "WireKeywords",
    "WireServer",
    "WireTransport",
    "boolean",
    "host_only",
    "open_connection",
    "open_server",
]

_MODULES = {
    "auth": ("AccessPolicy", "Authorize", "Peer", "Permission"),
    "channel": ("Channel", "Line", "NextFrames", "OnFrames", "StreamChannel"),
    "connection": ("RemoteConnection", "open_connection"),
    "settings": (
        "ClientKeywords",
        "ClientSettings",
        "Limits",
        "ServerKeywords",
        "ServerSettings",
        "WireKeywords",
    ),
    "tls_files": ("TlsFiles",),
    "transport": ("FromText", "WireTransport", "boolean", "host_only"),
    "wire_server": ("WireServer", "open_server"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a name when it is used for the first time."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
