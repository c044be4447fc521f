"""ROS 2 actions for asyncio, with or without ROS.

A client sends a goal; the server accepts or rejects it, streams feedback, and ends it with a
result; a client may cancel at any time. All that is needed for that is here.

`fibaction.testing` helps to test it, `fibaction.action_files` has `load_action`, which makes an
action from an `.action` file of ROS 2, and `fibaction.abc` is for those who write transports.
"""

from fibaction.abc import Endpoint, Transport
from fibaction.action import Action, ActionInfo
from fibaction.client import ActionClient, ClientGoal
from fibaction.connection import ClientConnection, connect
from fibaction.exceptions import (
    ActionError,
    AuthenticationFailed,
    CancelRejected,
    ConnectionLost,
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    InvalidTransition,
    ProtocolError,
    ServerNotFound,
    TransportError,
    UnknownGoal,
)
from fibaction.executor import GoalHandle
from fibaction.goals import ActionPeers, CancelAnswer, CancelCode, GoalID, GoalInfo, Outcome
from fibaction.observing import Events, GoalFeedback
from fibaction.server import ActionServer
from fibaction.serving import serve
from fibaction.states import GoalEvent, GoalStatus

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
    "ConnectionLost",
    "Endpoint",
    "Events",
    "GoalAborted",
    "GoalCanceled",
    "GoalEvent",
    "GoalFeedback",
    "GoalHandle",
    "GoalID",
    "GoalInfo",
    "GoalRejected",
    "GoalStatus",
    "InvalidTransition",
    "Outcome",
    "ProtocolError",
    "ServerNotFound",
    "Transport",
    "TransportError",
    "UnknownGoal",
    "connect",
    "serve",
]
