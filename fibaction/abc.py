"""The interfaces between clients and servers, for authors of transports."""

from fibaction.border.abc import (
    Connection,
    Diagnosis,
    Endpoint,
    FeedbackItem,
    ForwardingEndpoint,
    GoalQuery,
    GoalRequest,
    GoalStream,
    GoalUpdate,
    Meta,
    Notifier,
    PastPage,
    Startable,
    StatusStream,
    Transport,
)

__all__ = [
    "Connection",
    "Diagnosis",
    "Endpoint",
    "FeedbackItem",
    "ForwardingEndpoint",
    "GoalQuery",
    "GoalRequest",
    "GoalStream",
    "GoalUpdate",
    "Meta",
    "Notifier",
    "PastPage",
    "Startable",
    "StatusStream",
    "Transport",
]
