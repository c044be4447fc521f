"""Messages of the wire protocol.

Each message is a msgpack array that begins with the tag of its type; `docs/protocol.md` lists all
messages. New fields are added at the end, with a default, and a peer that does not know them
ignores them. A payload is a byte string, encoded by its sender and decoded by its receiver.

Sans-I/O. The rules on which message may follow which are in the session and the client connection.
"""

from __future__ import annotations

from fibaction.wire.messages.fields import (
    LARGEST,
    LONGEST_HEARTBEAT,
    LONGEST_TIMEOUT,
    VERSION,
    Goodbye,
    Ping,
    Seconds,
    label_fields,
    parent_fields,
    parent_from,
    past_fields,
    past_from,
)
from fibaction.wire.messages.from_client import (
    AskPeers,
    AskPlaces,
    AwaitServer,
    CancelGoals,
    Close,
    Credit,
    Follow,
    Hello,
    ListActions,
    Received,
    SendGoal,
    WatchStatus,
)
from fibaction.wire.messages.from_server import (
    Actions,
    CancelAnswered,
    Done,
    Ended,
    Failed,
    Feedback,
    FeedbackBatch,
    Finished,
    Following,
    GoalChanged,
    Peers,
    Places,
    Rejected,
    StatusChanged,
    Watching,
    Welcome,
    Why,
)

__all__ = [
    "LARGEST",
    "LONGEST_HEARTBEAT",
    "LONGEST_TIMEOUT",
    "VERSION",
    "Actions",
    "AskPeers",
    "AskPlaces",
    "AwaitServer",
    "CancelAnswered",
    "CancelGoals",
    "Close",
    "Credit",
    "Done",
    "Ended",
    "Failed",
    "Feedback",
    "FeedbackBatch",
    "Finished",
    "Follow",
    "Following",
    "GoalChanged",
    "Goodbye",
    "Hello",
    "ListActions",
    "Peers",
    "Ping",
    "Places",
    "Received",
    "Rejected",
    "Seconds",
    "SendGoal",
    "StatusChanged",
    "WatchStatus",
    "Watching",
    "Welcome",
    "Why",
    "label_fields",
    "parent_fields",
    "parent_from",
    "past_fields",
    "past_from",
]
