"""`serve`, `connect` and `call`: servers and clients at an address."""

from fibaction._api.connections import ClientConnection, Connecting, check_is_action, connect
from fibaction._api.one_call import call, goal_and_connection
from fibaction._api.servers import Served, Serving, serve

__all__ = [
    "ClientConnection",
    "Connecting",
    "Served",
    "Serving",
    "call",
    "check_is_action",
    "connect",
    "goal_and_connection",
    "serve",
]
