"""The messages between the two halves of a connection, and their form as bytes.

Each is a msgpack array whose first item tells which it is; `docs/protocol.md` has them all. New
fields are added at the end, with a default, and a peer that does not know them ignores them.
Payloads are byte strings, put together by whoever made them and opened by whoever needs them.

Sans-I/O, and no rule on who may say what when: that is in `fibaction.wire`.
"""

from __future__ import annotations

from typing import Annotated, TypeAlias, final

import msgspec

from fibaction.action import ActionInfo
from fibaction.exceptions import ProtocolError
from fibaction.goals import GoalID
from fibaction.states import GoalStatus
from fibaction.wire.framing import MAX_FRAME

VERSION = 1
"""Of the protocol. Peers of different versions do not talk."""
LARGEST = 2**63 - 1
"""The largest number that a message has room for; as a stamp, a time that nobody will see."""

ID: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=LARGEST)]
"""Names a request, and all that follows from it. The client chooses it, and uses it once."""
GoalBytes: TypeAlias = Annotated[bytes, msgspec.Meta(min_length=16, max_length=16)]
Stamp: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=LARGEST)]
Count: TypeAlias = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
FrameSize: TypeAlias = Annotated[int, msgspec.Meta(ge=1, lt=2**32)]
Seconds: TypeAlias = Annotated[float, msgspec.Meta(gt=0, le=3600)]


class _Message(msgspec.Struct, array_like=True, gc=False):
    """A message. None refers to another one, so the garbage collector need not look."""


# Either side


@final
class Ping(_Message, tag=0):
    """A sign of life, where there was nothing else to say."""


@final
class Goodbye(_Message, tag=1):
    """The last message of a side: why it closes the connection, in a sentence."""

    reason: str
    why: int = 0
    """One of the `Why` numbers, or 0: nothing is wrong."""


# From the client


@final
class Hello(_Message, tag=16):
    """The client's first message."""

    version: int
    heartbeat: Seconds
    """At least so often the client will send something."""
    token: str = ""
    """What it knows that others do not."""
    session: bytes = b""
    """The same on all connections of one client, and known to nobody else: by it the server knows
    whose goals are whose. A connection of the same session that is still open is ended, and what
    was under way on it goes on here."""
    max_frame: FrameSize = MAX_FRAME
    """Bytes of the largest message that the client takes."""

    def __repr__(self) -> str:
        return f"Hello(version={self.version})"  # a token has no place in a log


@final
class SendGoal(_Message, tag=17):
    """Send a goal, and follow it. Answered by `Following`, `Rejected` or `Failed`."""

    id: ID
    action: str
    goal_id: GoalBytes
    goal: bytes
    credit: Count | None
    """How many feedback messages may come before more credit; nil: only the outcome is wanted."""


@final
class Follow(_Message, tag=18):
    """Follow a goal that was sent before. Answered by `Following` or `Failed`."""

    id: ID
    action: str
    goal_id: GoalBytes
    after: Stamp | None
    own: bool
    """Whether this is the goal's own client, which goes on after a connection was lost."""
    credit: Count | None
    """As for `SendGoal`."""


@final
class CancelGoals(_Message, tag=19):
    """Ask to cancel. Answered by `CancelAnswered` or `Failed`."""

    id: ID
    action: str
    goal_id: GoalBytes | None
    stamp: Stamp | None


@final
class WatchStatus(_Message, tag=20):
    """Follow the statuses of all goals. Answered by `Watching`, then `GoalChanged`, or `Failed`."""

    id: ID
    action: str
    credit: Count


@final
class AwaitServer(_Message, tag=21):
    """Wait until somebody serves the action. Answered by `Done` or `Failed`."""

    id: ID
    action: str


@final
class ListActions(_Message, tag=22):
    """Ask what is served here. Answered by `Actions`."""

    id: ID


@final
class Credit(_Message, tag=23):
    """So many more messages may come."""

    id: ID
    count: Count


@final
class Close(_Message, tag=24):
    """No more feedback or status changes are wanted; the outcome still is."""

    id: ID


@final
class Received(_Message, tag=25):
    """`Ended` has arrived. Until then the server keeps what it has of a goal for its client.

    Of a goal that is not the client's own it may come sooner: the client does not wait for the end.
    """

    id: ID


@final
class AskPeers(_Message, tag=26):
    """Ask who else uses an action. Answered by `Peers` or `Failed`."""

    id: ID
    action: str


# From the server


@final
class Welcome(_Message, tag=32):
    """The server's first message."""

    version: int
    heartbeat: Seconds
    max_frame: FrameSize = MAX_FRAME
    """Bytes of the largest message that the server takes."""


@final
class Following(_Message, tag=33):
    """The goal is accepted, or known; its feedback, status changes and outcome follow."""

    id: ID
    stamp: Stamp
    status: GoalStatus
    latest: bool
    place: Stamp
    """The number of the feedback after which the stream begins."""


@final
class Rejected(_Message, tag=34):
    """The goal was not accepted."""

    id: ID
    reason: str


@final
class Failed(_Message, tag=35):
    """The request could not be answered."""

    id: ID
    why: int
    """One of the `Why` numbers."""
    text: str


class Why:
    """The reasons of `Failed` and `Goodbye`."""

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
    """One feedback message; it uses up one credit."""

    id: ID
    number: Stamp
    payload: bytes


@final
class StatusChanged(_Message, tag=37):
    """The goal has another status, and has not ended."""

    id: ID
    status: GoalStatus


@final
class Ended(_Message, tag=38):
    """The goal has ended. The last message of that ID; the client answers with `Received`."""

    id: ID
    status: GoalStatus
    result: bytes | None
    reason: str
    place: Stamp
    """The number of the last feedback: what has not come by now is lost."""


@final
class CancelAnswered(_Message, tag=39):
    """The answer to a cancel, as `action_msgs/srv/CancelGoal` has it, with a reason."""

    id: ID
    return_code: Annotated[int, msgspec.Meta(ge=0, le=3)]
    goals: list[tuple[GoalBytes, Stamp, GoalStatus]]
    reason: str


@final
class GoalChanged(_Message, tag=40):
    """A goal and its status; it uses up one credit."""

    id: ID
    goal_id: GoalBytes
    stamp: Stamp
    status: GoalStatus
    dropped: Stamp
    """How many of these were left out so far, because they were not taken in time."""
    feedback_count: Stamp = 0
    """How many feedback messages of the goal there have been."""
    client: str = ""
    """Who sent the goal, as far as the server knows."""


@final
class Done(_Message, tag=41):
    """What was waited for is there."""

    id: ID


@final
class Finished(_Message, tag=42):
    """There will be no more `GoalChanged`. The last message of that ID."""

    id: ID


@final
class Actions(_Message, tag=43):
    """What is served here."""

    id: ID
    actions: list[ActionInfo]


@final
class Watching(_Message, tag=44):
    """The statuses follow: first those of the goals that there are, then each change."""

    id: ID
    known: Stamp
    """How many goals there are."""


@final
class Peers(_Message, tag=45):
    """Who uses the action."""

    id: ID
    clients: list[str]
    """Each as the server's log names it."""


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
    | Ping
    | Goodbye
)
FromServer: TypeAlias = (
    Welcome
    | Following
    | Rejected
    | Failed
    | Feedback
    | StatusChanged
    | Ended
    | CancelAnswered
    | GoalChanged
    | Done
    | Finished
    | Actions
    | Watching
    | Peers
    | Ping
    | Goodbye
)


def _plain(value: object) -> bytes:
    if isinstance(value, GoalID):
        return bytes(value)
    raise TypeError(f"no message holds a {type(value).__name__}")


encode = msgspec.msgpack.Encoder(enc_hook=_plain).encode
"""A message as bytes."""

_from_client: msgspec.msgpack.Decoder[FromClient] = msgspec.msgpack.Decoder(FromClient)
_from_server: msgspec.msgpack.Decoder[FromServer] = msgspec.msgpack.Decoder(FromServer)


def decode_from_client(frame: bytes) -> FromClient:
    """Read what a client sent.

    Raises:
        ProtocolError: It is no such message.
    """
    try:
        return _from_client.decode(frame)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as exc:
        raise ProtocolError(f"invalid client message: {exc}") from exc


def decode_from_server(frame: bytes) -> FromServer:
    """Read what a server sent.

    Raises:
        ProtocolError: It is no such message.
    """
    try:
        return _from_server.decode(frame)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as exc:
        raise ProtocolError(f"invalid server message: {exc}") from exc
