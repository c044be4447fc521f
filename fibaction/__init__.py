"""ROS 2 actions for asyncio, with or without ROS.

A client sends a goal; the server accepts or rejects it, streams feedback, and ends it with a
result; a client may cancel at any time. This package exports all names that programs need for that.

`fibaction.testing` has helpers for tests, `fibaction.action_files` has `load_action`, which makes
an action from an `.action` file of ROS 2, and `fibaction.border.abc` is for authors of transports.

A name is imported from its module when it is used first: so a client does not wait for the import
of the server.
"""

from typing import TYPE_CHECKING

from fibaction._runtime import RELEASE

if TYPE_CHECKING:
    from fibaction._api import ClientConnection, Connecting, Serving, call, connect, serve
    from fibaction.border.abc import Endpoint, Transport
    from fibaction.border.goal_store import GoalStore
    from fibaction.border.watchers import Watcher
    from fibaction.client.client import ActionClient
    from fibaction.client.events import Events, GoalFeedback
    from fibaction.client.goal import ClientGoal, SendingGoal
    from fibaction.client.retry import Retry
    from fibaction.client.track import track
    from fibaction.server import (
        ActionServer,
        Executor,
        FunctionAction,
        GoalHandle,
        Report,
        Schedule,
        action,
    )
    from fibaction.stores.sqlite_store import SqliteStore
    from fibaction.types.action import Action, ActionInfo
    from fibaction.types.arguments import Arguments
    from fibaction.wire.auth import Peer, Permission
    from fibaction.wire.settings import Limits
    from fibaction.words.errors import (
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
        RejectionCode,
        ServerFailed,
        ServerNotFound,
        StoreError,
        TransportError,
        UnknownGoal,
    )
    from fibaction.words.goal_query import GoalHistory
    from fibaction.words.goals import (
        ActionPeers,
        CancelAnswer,
        CancelCode,
        GoalID,
        GoalInfo,
        Outcome,
        Parent,
        Sender,
        WorkerInfo,
    )
    from fibaction.words.progress import Progress, Return
    from fibaction.words.statuses import GoalEvent, GoalStatus
else:
    from importlib import import_module

    _NAMES = {
        "_api": "ClientConnection Connecting Serving call connect serve",
        "border.abc": "Endpoint Transport",
        "types.action": "Action ActionInfo",
        "types.arguments": "Arguments",
        "client.client": "ActionClient",
        "client.goal": "ClientGoal SendingGoal",
        "client.events": "Events GoalFeedback",
        "words.errors": (
            "ActionError AuthenticationFailed CancelRejected ConnectionLost GoalAborted "
            "GoalCanceled GoalKept GoalRejected GoalTimeout InvalidMessage InvalidTransition "
            "InvalidURL LimitReached ProtocolError RejectionCode ServerFailed ServerNotFound "
            "StoreError TransportError UnknownGoal"
        ),
        "border.goal_store": "GoalStore",
        "words.goals": (
            "ActionPeers CancelAnswer CancelCode GoalID GoalInfo Outcome Parent Sender WorkerInfo"
        ),
        "client.retry": "Retry",
        "client.track": "track",
        "server": ("ActionServer Executor FunctionAction GoalHandle Report Schedule action"),
        "words.progress": "Progress Return",
        "words.statuses": "GoalEvent GoalStatus",
        "words.goal_query": "GoalHistory",
        "stores.sqlite_store": "SqliteStore",
        "border.watchers": "Watcher",
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


__version__ = RELEASE

__all__ = [
    "Action",
    "ActionClient",
    "ActionError",
    "ActionInfo",
    "ActionPeers",
    "ActionServer",
    "Arguments",
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
    "FunctionAction",
    "GoalAborted",
    "GoalCanceled",
    "GoalEvent",
    "GoalFeedback",
    "GoalHandle",
    "GoalHistory",
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
    "Parent",
    "Peer",
    "Permission",
    "Progress",
    "ProtocolError",
    "RejectionCode",
    "Report",
    "Retry",
    "Return",
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
    "action",
    "call",
    "connect",
    "serve",
    "track",
]
