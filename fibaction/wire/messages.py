"""Messages of the wire protocol.

Each message is a msgpack array that begins with the tag of its type; `docs/protocol.md` lists all
messages. New fields are added at the end, with a default, and a peer that does not know them
ignores them. A payload is a byte string, encoded by its sender and decoded by its receiver.

Sans-I/O. The rules on which message may follow which are in the session and the client connection.
"""

from __future__ import annotations

from typing import Annotated, TypeAlias, final

import msgspec

from fibaction.types.action import ActionInfo
from fibaction.wire.frames import MAX_FRAME
from fibaction.words.statuses import GoalStatus

VERSION = 1
"""Version of the protocol. A peer of another version is rejected."""
LARGEST = 2**63 - 1
"""Largest number that a message can contain; as a stamp, later than every goal."""

ID: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=LARGEST)]
"""ID of a request and of all messages that belong to it; the client uses each number once."""
GoalBytes: TypeAlias = Annotated[bytes, msgspec.Meta(min_length=16, max_length=16)]
Stamp: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=LARGEST)]
AttemptNumber: TypeAlias = Annotated[int, msgspec.Meta(ge=1, le=LARGEST)]
Count: TypeAlias = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
FrameSize: TypeAlias = Annotated[int, msgspec.Meta(ge=1, lt=2**32)]
LONGEST_HEARTBEAT = 3600.0
"""Longest heartbeat that a message can contain, in seconds."""
Seconds: TypeAlias = Annotated[float, msgspec.Meta(gt=0, le=LONGEST_HEARTBEAT)]
LONGEST_TIMEOUT = 1e9
"""Longest timeout of a goal that a message can contain, in seconds: some 30 years."""
Timeout: TypeAlias = Annotated[float, msgspec.Meta(gt=0, le=LONGEST_TIMEOUT)]


class _Message(msgspec.Struct, array_like=True, gc=False):
    """Base of all messages. A message cannot be part of a cycle: it needs no garbage collector."""


# Either side


@final
class Ping(_Message, tag=0):
    """Heartbeat of a side that has nothing else to send. Not answered."""


@final
class Goodbye(_Message, tag=1):
    """Last message of a side, with the reason why it closes the connection. Not answered."""

    reason: str
    why: int = 0
    """One of the `Why` numbers; 0 if there is no error."""


# From the client


@final
class Hello(_Message, tag=16):
    """First message of the client. Answered by `Welcome` or `Goodbye`."""

    version: int
    heartbeat: Seconds
    """Longest time between two messages of the client, in seconds."""
    token: str = ""
    """The client's access token; empty if it has none."""
    session: bytes = b""
    """Secret ID of the client, 16 or 32 bytes, the same on all its connections; empty if it does
    not resume goals. Together with the name of the token it identifies the owner of a goal. The
    server ends an older connection of the same session, so that its goals can be resumed on this
    one."""
    max_frame: FrameSize = MAX_FRAME
    """Length of the largest frame that the client accepts, in bytes; at least 1024."""
    batches: bool = False
    """True if the client accepts `FeedbackBatch`."""

    def __repr__(self) -> str:
        return f"Hello(version={self.version})"  # a token has no place in a log


@final
class SendGoal(_Message, tag=17):
    """Request to send a goal and to follow it. Answered by `Following`, `Rejected` or `Failed`."""

    id: ID
    action: str
    goal_id: GoalBytes
    goal: bytes
    credit: Count | None
    """Feedback messages that the server may send before more credit; nil for the outcome only."""
    timeout: Timeout | None = None
    """Seconds from now after which the client gives the goal up; nil if it does not."""
    meta: dict[str, str] | None = None
    """Text that goes with the goal, for traces: at most 8 keys, and 4096 bytes of keys and values
    together. The keys `traceparent`, `tracestate` and `baggage` are those of the W3C; `detached`
    says that the client does not wait for the goal. Nil if there is none."""


@final
class Follow(_Message, tag=18):
    """Request to follow a goal that was sent before. Answered by `Following` or `Failed`."""

    id: ID
    action: str
    goal_id: GoalBytes
    after: Stamp | None
    own: bool
    """True if this client owns the goal: it sent the goal, and resumes after a lost connection."""
    credit: Count | None
    """As in `SendGoal`."""
    attempt: AttemptNumber = 1
    """Attempt in which `after` counts. If the goal is in another one by now, the stream begins with
    the first feedback of that one."""


@final
class CancelGoals(_Message, tag=19):
    """Request to cancel one goal or several. Answered by `CancelAnswered` or `Failed`."""

    id: ID
    action: str
    goal_id: GoalBytes | None
    stamp: Stamp | None


@final
class WatchStatus(_Message, tag=20):
    """Request to follow the statuses of all goals, once for each action and connection at a time.

    Answered by `Watching` or `Failed`.
    """

    id: ID
    action: str
    credit: Count


@final
class AwaitServer(_Message, tag=21):
    """Request to wait until the action is served. Answered by `Done` or `Failed`."""

    id: ID
    action: str


@final
class ListActions(_Message, tag=22):
    """Request for the actions that are served. Answered by `Actions` or `Failed`."""

    id: ID


@final
class Credit(_Message, tag=23):
    """Grant of more credit for a request. Not answered."""

    id: ID
    count: Count


@final
class Close(_Message, tag=24):
    """End of the client's interest in the feedback and the status changes of a request.

    The outcome of a goal still comes. `WatchStatus` is answered by `Finished`.
    """

    id: ID


@final
class Received(_Message, tag=25):
    """Confirmation that `Ended` has arrived. Not answered.

    Until then the server keeps the end of a goal for the client that owns it. For a goal that the
    client does not own, it may be sent before `Ended`: the client then gets no further message.
    """

    id: ID


@final
class AskPeers(_Message, tag=26):
    """Request for the clients that use an action. Answered by `Peers` or `Failed`."""

    id: ID
    action: str


@final
class AskPlaces(_Message, tag=27):
    """Request for the goals that wait for their turn. Answered by `Places` or `Failed`."""

    id: ID
    action: str
    most: Count
    """Most goals to be told in the answer."""


# From the server


@final
class Welcome(_Message, tag=32):
    """First message of the server, but for `Ping`. Answers `Hello`."""

    version: int
    heartbeat: Seconds
    max_frame: FrameSize = MAX_FRAME
    """Length of the largest frame that the server accepts, in bytes."""
    max_heartbeat: Seconds = LONGEST_HEARTBEAT
    """Longest `heartbeat` of the client that the server accepts, in seconds; a client with a longer
    one sends its messages at least this often."""


@final
class Following(_Message, tag=33):
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
    the goal is active and fits into a frame that the client accepts."""


@final
class Rejected(_Message, tag=34):
    """Rejection of a goal. Answers `SendGoal`; the last message of that ID."""

    id: ID
    reason: str


@final
class Failed(_Message, tag=35):
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
class Feedback(_Message, tag=36):
    """One feedback message of a goal. Uses up one credit."""

    id: ID
    number: Stamp
    payload: bytes


@final
class FeedbackBatch(_Message, tag=48):
    """Feedback messages of a goal with consecutive numbers. Uses up one credit for each of them.

    It is sent only to a client whose `Hello` says that it accepts it, in place of as many
    `Feedback`.
    """

    id: ID
    number: Stamp
    """Number of the first feedback message; the next ones follow without a gap."""
    payloads: Annotated[list[bytes], msgspec.Meta(min_length=1)]
    """The feedback messages, at least one, each a payload."""


@final
class StatusChanged(_Message, tag=37):
    """New status of a goal that has not ended."""

    id: ID
    status: GoalStatus


@final
class Ended(_Message, tag=38):
    """End of a goal. The last message of that ID; answered by `Received`."""

    id: ID
    status: GoalStatus
    result: bytes | None
    reason: str
    place: Stamp
    """Number of the last feedback that was sent or left out; what has not arrived is lost."""


@final
class CancelAnswered(_Message, tag=39):
    """Fields of a response of `action_msgs/srv/CancelGoal`, and a reason. Answers `CancelGoals`."""

    id: ID
    return_code: Annotated[int, msgspec.Meta(ge=0, le=3)]
    goals: list[tuple[GoalBytes, Stamp, GoalStatus]]
    reason: str


@final
class GoalChanged(_Message, tag=40):
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


@final
class Done(_Message, tag=41):
    """The server is now available. Answers `AwaitServer`; the last message of that ID."""

    id: ID


@final
class Finished(_Message, tag=42):
    """End of the `GoalChanged` of a `WatchStatus`. The last message of that ID."""

    id: ID


@final
class Actions(_Message, tag=43):
    """The actions that are served. Answers `ListActions`; the last message of that ID."""

    id: ID
    actions: list[ActionInfo]


@final
class Watching(_Message, tag=44):
    """Start of the statuses. Answers `WatchStatus`.

    `GoalChanged` follows: one for each known goal, then one for each change.
    """

    id: ID
    known: Stamp
    """Number of known goals."""


@final
class Peers(_Message, tag=45):
    """The clients that use an action. Answers `AskPeers`; the last message of that ID."""

    id: ID
    clients: list[str]
    """Name of each client, as in the server's log."""


@final
class Places(_Message, tag=46):
    """The goals that wait for their turn. Answers `AskPlaces`; the last message of that ID."""

    id: ID
    goals: list[tuple[GoalBytes, Stamp, Stamp]]
    """ID, place and length of the queue of each goal."""
