"""Messages of a client: its requests, and what belongs to them."""

from __future__ import annotations

from typing import TypeAlias, final

from fibaction.wire.frames import MAX_FRAME
from fibaction.wire.messages.fields import (
    ID,
    AttemptNumber,
    Count,
    FrameSize,
    GoalBytes,
    Goodbye,
    LabelFields,
    PastFields,
    Ping,
    Seconds,
    Stamp,
    Timeout,
    WireMessage,
    WordFields,
)
from fibaction.words.intake import IntakeMode


@final
class Hello(WireMessage, tag=16):
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
class SendGoal(WireMessage, tag=17):
    """Request to send a goal and to follow it. Answered by `Following`, `Rejected` or `Failed`."""

    id: ID
    action: str
    goal_id: GoalBytes
    goal: bytes
    credit: Count | None
    """Feedback messages that the server may send before more credit; nil for the outcome only."""
    timeout: Timeout | None = None
    """Seconds from now after which the client gives up the goal; nil if it does not."""
    meta: dict[str, str] | None = None
    """Text that goes with the goal, for traces: at most 8 keys, and 4096 bytes of keys and values
    together. The keys `traceparent`, `tracestate` and `baggage` are those of the W3C; `detached`
    says that the client does not wait for the goal, and `parent` and `step` name the goal and the
    step that it is. Nil if there is none."""
    checked: bool = False
    """True if the client has the types of the action, or has compared the goal with its schema: the
    server ignores fields that its type does not have. If false, it rejects a goal with such a
    field."""


@final
class Follow(WireMessage, tag=18):
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
class CancelGoals(WireMessage, tag=19):
    """Request to cancel one goal or several. Answered by `CancelAnswered` or `Failed`."""

    id: ID
    action: str
    goal_id: GoalBytes | None
    stamp: Stamp | None


@final
class WatchStatus(WireMessage, tag=20):
    """Request to follow the statuses of all goals, once for each action and connection at a time;
    or for a page of the history.

    Answered by `Watching` or `Failed`.
    """

    id: ID
    action: str
    credit: Count
    past: PastFields | None = None
    """Page of the history in place of the statuses: statuses, none for any; a part of the name of
    the client; earliest and latest stamp; number of goals; stamp and ID of the goal before the
    first one, in the order of the page; and whether the newest goals come first. Nil for the
    statuses."""
    labels: LabelFields | None = None
    """Keys and values of labels that each goal of the page has; nil for any labels. It
    does not apply to the statuses."""
    words: WordFields | None = None
    """Words in lower case that the text of each goal of the page has, which is its ID, status,
    client, worker, reason, labels and parent; nil for any text. It does not apply to the
    statuses."""


@final
class AwaitServer(WireMessage, tag=21):
    """Request to wait until the action is served. Answered by `Done` or `Failed`."""

    id: ID
    action: str


@final
class ListActions(WireMessage, tag=22):
    """Request for the actions that are served. Answered by `Actions` or `Failed`."""

    id: ID


@final
class Credit(WireMessage, tag=23):
    """Grant of more credit for a request. Not answered."""

    id: ID
    count: Count


@final
class Close(WireMessage, tag=24):
    """End of the client's interest in the feedback and the status changes of a request.

    The outcome of a goal still comes. `WatchStatus` is answered by `Finished`.
    """

    id: ID


@final
class Received(WireMessage, tag=25):
    """Confirmation that `Ended` has arrived. Not answered.

    Until then the server keeps the end of a goal for the client that owns it. For a goal that the
    client does not own, it may be sent before `Ended`: the client then gets no further message.
    """

    id: ID


@final
class AskPeers(WireMessage, tag=26):
    """Request for the clients that use an action. Answered by `Peers` or `Failed`."""

    id: ID
    action: str


@final
class AskPlaces(WireMessage, tag=27):
    """Request for the goals that wait for their turn. Answered by `Places` or `Failed`."""

    id: ID
    action: str
    most: Count
    """Largest number of goals in the answer."""


@final
class Operate(WireMessage, tag=28):
    """Request to pause an action, to let it take goals again, or to drain its server; or for how it
    takes goals. Answered by `Operated` or `Failed`. Sent only if `newest` of `Welcome` is 28 or
    more.
    """

    id: ID
    action: str
    mode: IntakeMode | None = None
    """`open`, `hold`, `refuse` or `drain`; nil to change nothing."""
    reason: str = ""
    """Reason of the change, for people."""
    by: str = ""
    """Name that the operator gives itself; the server notes it beside the name of the client."""
    worker: str = ""
    """Name of the only worker of a fleet that it is about, at a gateway; empty for all."""


@final
class Rerun(WireMessage, tag=29):
    """Request to run a goal again that was given up, as a new goal from its last checkpoint.
    Answered by `RunsAgain` or `Failed`. Sent only if `newest` of `Welcome` is 29 or more.
    """

    id: ID
    action: str
    goal_id: GoalBytes


@final
class AskLog(WireMessage, tag=30):
    """Request for the newest log records of a goal's executor. Answered by `Logged` or `Failed`.
    Sent only if `newest` of `Welcome` is 30 or more.
    """

    id: ID
    action: str
    goal_id: GoalBytes


FromClient: TypeAlias = (
    Hello
    | SendGoal
    | Follow
    | CancelGoals
    | WatchStatus
    | AwaitServer
    | ListActions
    | Credit
    | Close
    | Received
    | AskPeers
    | AskPlaces
    | Operate
    | Rerun
    | AskLog
    | Ping
    | Goodbye
)
"""A message that a client may send."""
