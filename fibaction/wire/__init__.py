"""The wire protocol: both halves of a connection over any transport that moves frames.

Here are the settings and permissions of every transport over it. The author of a transport finds
`WireTransport`, the base class, in `transport`, and `Line`, `Channel` and `StreamChannel`, of which
a transport supplies one, in `channel`. `fibaction` imports this package, so it imports no more.

Each rule has its module: `errors` the number of each error, `link` when a peer is dead,
`reconnect` when to connect again, `auth` tokens and permissions, and `ownership` the fate of goals
whose client is gone.
"""

from fibaction.wire.auth import AccessPolicy, Authorize, Peer, Permission
from fibaction.wire.settings import (
    ClientSettings,
    Limits,
    WireSettings,
)

__all__ = [
    "AccessPolicy",
    "Authorize",
    "ClientSettings",
    "Limits",
    "Peer",
    "Permission",
    "WireSettings",
]
