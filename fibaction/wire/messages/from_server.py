"""Messages of a server: its answers, and what it tells about goals."""

from __future__ import annotations

from typing import Annotated, TypeAlias, final

import msgspec

from fibaction.types.action import ActionInfo
from fibaction.wire.frames import MAX_FRAME
from fibaction.wire.messages.fields import (
    ID,
    LONGEST_HEARTBEAT,
    AttemptNumber,
    Count,
    FrameSize,
    GoalBytes,
    Goodbye,
    ParentFields,
    Ping,
    Seconds,
    Stamp,
    WireMessage,
)
from fibaction.words.intake import IntakeMode, ScheduleInfo
from fibaction.words.statuses import GoalStatus


@final
class Welcome(WireMessage, tag=32):
    """First message of the server, but for `Ping`. Answers `Hello`."""

    version: int
    heartbeat: Seconds
    max_frame: FrameSize = MAX_FRAME
    """Length of the largest frame that the server accepts, in bytes."""
    max_heartbeat: Seconds = LONGEST_HEARTBEAT
    """Longest `heartbeat` of the client that the server accepts, in seconds; a client with a longer
    one sends its messages at least this often."""
    newest: Count = 27
    """Highest tag of the messages of a client that the server knows."""
    release: str = ""
    """Version of fibaction at the server; empty if it does not tell it."""


@final
class Following(WireMessage, tag=33):
    """Acceptance of a goal, or the state of a known goal. Answers `SendGoal` and `Follow`.

    `Feedback`, `StatusChanged` and `Ended` follow. It is sent once more if a new attempt at the
    goal begins, before the first feedback of that attempt.
    """

    id: ID
    stamp: Stamp
    status: GoalStatus
    latest: bool
    place: Stamp
    """Number of the feedback after which the stream begins; 0 if it begins with the first."""
    attempt: AttemptNumber = 1
    """Attempt at the goal, from 1, in which the feedback is numbered from now on."""
    goal: bytes | None = None
    """The goal's payload, for a client that did not send it: in the first answer to `Follow`, if
    the goal is active or `after` was given, and it fits into a frame that the client accepts."""
    parent: ParentFields | None = None
    """The goal whose executor has sent this one, and the name of the step, as in `GoalChanged`: in
    the first answer to `Follow`, for a client that did not send it."""
    labels: dict[str, str] | None = None
    """Labels of the goal, as in `GoalChanged`: in the first answer to `Follow`, for a client that
    did not send it."""
    checkpoint: bytes | None = None
    """Last checkpoint of a goal that the server has given up and can run again, a payload; empty if
    it has none, or none that fits into a frame that the client accepts: in the first answer to
    `Follow`, for a client that did not send it. Nil for any other goal."""


@final
class Rejected(WireMessage, tag=34):
    """Rejection of a goal. Answers `SendGoal`; the last message of that ID."""

    id: ID
    reason: str
    code: int = 0
    """Kind of the rejection, for programs: one of the `RejectionCode` numbers; a number that is not
    known means 0."""


@final
class Failed(WireMessage, tag=35):
    """Error of a request. Answers any request; the last message of that ID."""

    id: ID
    why: int
    """One of the `Why` numbers."""
    text: str


class Why:
    """Numbers for the reasons of `Failed` and `Goodbye`."""

    UNKNOWN_GOAL = 1
    SERVER_NOT_FOUND = 2
    CONNECTION_LOST = 3
    FORBIDDEN = 4
    LIMIT = 5
    PROTOCOL = 6
    TRANSPORT = 7
    SERVER_FAILED = 8
    INVALID_MESSAGE = 9
    INVALID_URL = 10


@final
class Feedback(WireMessage, tag=36):
    """One feedback message of a goal. Uses up one credit."""

    id: ID
    number: Stamp
    payload: bytes
    at: Stamp | None = None
    """Time at which the executor reported it: nanoseconds since 1970; nil if the server does not
    know it."""


@final
class FeedbackBatch(WireMessage, tag=48):
    """Feedback messages of a goal with consecutive numbers. Uses up one credit for each of them.

    It is sent only to a client whose `Hello` says that it accepts it, in place of as many
    `Feedback`.
    """

    id: ID
    number: Stamp
    """Number of the first feedback message; the next ones follow without a gap."""
    payloads: Annotated[list[bytes], msgspec.Meta(min_length=1)]
    """The feedback messages, at least one, each a payload."""
    times: list[Stamp] | None = None
    """Time of each of them, as `at` in `Feedback`; nil if the server does not know them."""


@final
class StatusChanged(WireMessage, tag=37):
    """New status of a goal that has not ended."""

    id: ID
    status: GoalStatus


@final
class Ended(WireMessage, tag=38):
    """End of a goal. The last message of that ID; answered by `Received`."""

    # The fields of an `Outcome`, in its order, with `place` after the third: both ends rely on it.

    id: ID
    status: GoalStatus
    result: bytes | None
    reason: str
    place: Stamp
    """Number of the last feedback that was sent or left out; what has not arrived is lost."""
    ended_at: Stamp | None = None
    """Time of the end: nanoseconds since 1970; nil if the server does not know it."""


@final
class CancelAnswered(WireMessage, tag=39):
    """Fields of a response of `action_msgs/srv/CancelGoal`, and a reason. Answers `CancelGoals`."""

    id: ID
    return_code: Annotated[int, msgspec.Meta(ge=0, le=3)]
    goals: list[tuple[GoalBytes, Stamp, GoalStatus]]
    reason: str


@final
class GoalChanged(WireMessage, tag=40):
    """A goal and its current status. Uses up one credit of a `WatchStatus`."""

    id: ID
    goal_id: GoalBytes
    stamp: Stamp
    status: GoalStatus
    dropped: Stamp
    """Messages of this type left out so far, because the client read too slowly."""
    feedback_count: Stamp = 0
    """Feedback messages of the attempt so far."""
    client: str = ""
    """Name of the client that sent the goal; empty if the server does not know it."""
    place: Stamp = 0
    """Place among the goals that wait, from 1; 0 if the goal does not wait."""
    queue_length: Stamp = 0
    """Goals that wait in the same queue."""
    attempt: AttemptNumber = 1
    """Attempt at the goal, from 1."""
    parent: ParentFields | None = None
    """ID of the goal whose executor has sent this one, and the name of the step; nil if the meta of
    the goal names none."""
    began_at: Stamp | None = None
    """Time when the first attempt began: nanoseconds since 1970; nil if none has, or if the server
    does not know it."""
    ended_at: Stamp | None = None
    """Time when the goal ended; nil if it is active, or if the server does not know it."""
    reason: str = ""
    """Reason of an abort or a cancel, of 200 characters at most; may be empty."""
    labels: dict[str, str] | None = None
    """Labels of the goal: the entries of its meta that have no other meaning; nil if there are
    none."""
    worker: str = ""
    """Name of the worker of a fleet that has the goal, or had it at its end; empty if there is
    none, or if the server does not know it."""


@final
class Done(WireMessage, tag=41):
    """The server is now available. Answers `AwaitServer`; the last message of that ID."""

    id: ID


@final
class Finished(WireMessage, tag=42):
    """End of the `GoalChanged` of a `WatchStatus`. The last message of that ID."""

    id: ID


@final
class Actions(WireMessage, tag=43):
    """The actions that are served. Answers `ListActions`; the last message of that ID."""

    id: ID
    actions: list[ActionInfo]


@final
class Watching(WireMessage, tag=44):
    """Start of the statuses. Answers `WatchStatus`.

    `GoalChanged` follows: one for each known goal, then one for each change.
    """

    id: ID
    known: Stamp
    """Number of known goals."""


@final
class Peers(WireMessage, tag=45):
    """The clients that use an action. Answers `AskPeers`; the last message of that ID."""

    id: ID
    clients: list[str]
    """Name of each client, as in the server's log."""


@final
class Places(WireMessage, tag=46):
    """The goals that wait for their turn. Answers `AskPlaces`; the last message of that ID."""

    id: ID
    goals: list[tuple[GoalBytes, Stamp, Stamp]]
    """ID, place and length of the queue of each goal."""


@final
class Operated(WireMessage, tag=47):
    """The way in which an action takes goals. Answers `Operate`; the last message of that ID."""

    id: ID
    mode: IntakeMode
    changes: list[tuple[IntakeMode, str, str, Stamp]]
    """Newest changes, newest first: mode, reason, operator, and time in nanoseconds since 1970."""
    schedule: ScheduleInfo | None = None
    """Limits of the server; nil if it does not tell them."""
    has_levers: bool = True
    """False if the way in which the action takes goals cannot be changed from here."""


@final
class RunsAgain(WireMessage, tag=49):
    """The new goal for one that was given up. Answers `Rerun`; the last message of that ID."""

    id: ID
    new_id: GoalBytes | None
    """ID of the new goal; nil if the goal was not given up, is not kept any more, or runs again."""


@final
class Logged(WireMessage, tag=50):
    """Newest log records of a goal's executor. Answers `AskLog`; the last message of that ID."""

    id: ID
    lines: list[tuple[Stamp, str, str, str]] | None
    """Time in nanoseconds since 1970, level, logger and text of each, the oldest first; nil if the
    server keeps none."""


FromServer: TypeAlias = (
    Welcome
    | Following
    | Rejected
    | Failed
    | Feedback
    | FeedbackBatch
    | StatusChanged
    | Ended
    | CancelAnswered
    | GoalChanged
    | Done
    | Finished
    | Actions
    | Watching
    | Peers
    | Places
    | Operated
    | RunsAgain
    | Logged
    | Ping
    | Goodbye
)
"""A message that a server may send."""
