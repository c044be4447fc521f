"""ROS 2 actions for asyncio, with or without ROS.

A client sends a goal; the server accepts or rejects it, streams feedback, and ends it with a
result; a client may cancel at any time. This package exports all names that programs need for that.

`fibaction.testing` has helpers for tests, `fibaction.action_files` has `load_action`, which makes
an action from an `.action` file of ROS 2, and `fibaction.abc` is for authors of transports.

A name is imported from its module when it is used first: so a client does not wait for the import
of the server.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fibaction._api import ClientConnection, Connecting, Serving, connect, serve
    from fibaction.abc import Endpoint, Transport
    from fibaction.action import Action, ActionInfo
    from fibaction.client import ActionClient
    from fibaction.client_goal import ClientGoal, SendingGoal
    from fibaction.events import Events, GoalFeedback
    from fibaction.exceptions import (
        ActionError,
        AuthenticationFailed,
        CancelRejected,
        ConnectionLost,
        GoalAborted,
        GoalCanceled,
        GoalKept,
        GoalRejected,
        GoalTimeout,
        InvalidMessage,
        InvalidTransition,
        InvalidURL,
        LimitReached,
        ProtocolError,
        ServerFailed,
        ServerNotFound,
        StoreError,
        TransportError,
        UnknownGoal,
    )
    from fibaction.goal_store import GoalStore
    from fibaction.goals import (
        ActionPeers,
        CancelAnswer,
        CancelCode,
        GoalID,
        GoalInfo,
        Outcome,
        Sender,
        WorkerInfo,
    )
    from fibaction.retry import Retry
    from fibaction.server import ActionServer, Executor, GoalHandle, Schedule
    from fibaction.states import GoalEvent, GoalStatus
    from fibaction.stores.sqlite_store import SqliteStore
    from fibaction.watchers import Watcher
    from fibaction.wire.auth import Peer, Permission
    from fibaction.wire.settings import Limits
else:
    from importlib import import_module

    _NAMES = {
        "_api": "ClientConnection Connecting Serving connect serve",
        "abc": "Endpoint Transport",
        "action": "Action ActionInfo",
        "client": "ActionClient",
        "client_goal": "ClientGoal SendingGoal",
        "events": "Events GoalFeedback",
        "exceptions": (
            "ActionError AuthenticationFailed CancelRejected ConnectionLost GoalAborted "
            "GoalCanceled GoalKept GoalRejected GoalTimeout InvalidMessage InvalidTransition "
            "InvalidURL LimitReached ProtocolError ServerFailed ServerNotFound StoreError "
            "TransportError UnknownGoal"
        ),
        "goal_store": "GoalStore",
        "goals": "ActionPeers CancelAnswer CancelCode GoalID GoalInfo Outcome Sender WorkerInfo",
        "retry": "Retry",
        "server": "ActionServer Executor GoalHandle Schedule",
        "states": "GoalEvent GoalStatus",
        "stores.sqlite_store": "SqliteStore",
        "watchers": "Watcher",
        "wire.auth": "Peer Permission",
        "wire.settings": "Limits",
    }
    _MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}

    def __getattr__(name: str) -> object:
        """Import a name from its module when it is used first."""
        if name not in _MODULES:
            raise AttributeError(f"module 'fibaction' has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(f"fibaction.{_MODULES[name]}"), name)
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})


__version__ = "0.1.0"

__all__ = [
    "Action",
    "ActionClient",
    "ActionError",
    "ActionInfo",
    "ActionPeers",
    "ActionServer",
    "AuthenticationFailed",
    "CancelAnswer",
    "CancelCode",
    "CancelRejected",
    "ClientConnection",
    "ClientGoal",
    "Connecting",
    "ConnectionLost",
    "Endpoint",
    "Events",
    "Executor",
    "GoalAborted",
    "GoalCanceled",
    "GoalEvent",
    "GoalFeedback",
    "GoalHandle",
    "GoalID",
    "GoalInfo",
    "GoalKept",
    "GoalRejected",
    "GoalStatus",
    "GoalStore",
    "GoalTimeout",
    "InvalidMessage",
    "InvalidTransition",
    "InvalidURL",
    "LimitReached",
    "Limits",
    "Outcome",
    "Peer",
    "Permission",
    "ProtocolError",
    "Retry",
    "Schedule",
    "Sender",
    "SendingGoal",
    "ServerFailed",
    "ServerNotFound",
    "Serving",
    "SqliteStore",
    "StoreError",
    "Transport",
    "TransportError",
    "UnknownGoal",
    "Watcher",
    "WorkerInfo",
    "connect",
    "serve",
]
