"""The public names of `fibaction`, imported at the first use of one of them."""

from __future__ import annotations

from fibaction._api import ClientConnection, connect, serve
from fibaction.abc import Endpoint, Transport
from fibaction.action import Action, ActionInfo
from fibaction.client import ActionClient, ClientGoal, SendingGoal
from fibaction.events import Events, GoalFeedback
from fibaction.exceptions import (
    ActionError,
    AuthenticationFailed,
    CancelRejected,
    ConnectionLost,
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    InvalidMessage,
    InvalidTransition,
    InvalidURL,
    LimitReached,
    ProtocolError,
    ServerFailed,
    ServerNotFound,
    TransportError,
    UnknownGoal,
)
from fibaction.goals import ActionPeers, CancelAnswer, CancelCode, GoalID, GoalInfo, Outcome
from fibaction.server import ActionServer, Executor, GoalHandle
from fibaction.states import GoalEvent, GoalStatus
from fibaction.wire.auth import Peer, Permission
from fibaction.wire.settings import Limits

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
    "Executor",
    "GoalAborted",
    "GoalCanceled",
    "GoalEvent",
    "GoalFeedback",
    "GoalHandle",
    "GoalID",
    "GoalInfo",
    "GoalRejected",
    "GoalStatus",
    "InvalidMessage",
    "InvalidTransition",
    "InvalidURL",
    "LimitReached",
    "Limits",
    "Outcome",
    "Peer",
    "Permission",
    "ProtocolError",
    "SendingGoal",
    "ServerFailed",
    "ServerNotFound",
    "Transport",
    "TransportError",
    "UnknownGoal",
    "connect",
    "serve",
]
