"""`RosbridgeTranslator`: one rosbridge client as a client of the wire protocol.

Theory of operation
-------------------

A rosbridge client gets a `Session` of the `WireServer`, as every client over the wire protocol: the
same permissions, limits, turns, log and goodbye. The translator stands in between. It makes the
frames of the wire protocol that such a client would send, and JSON text of those that it would get:

    send_action_goal    SendGoal        with an ID of its own, and credit for all feedback
    cancel_action_goal  CancelGoals     of one goal of this connection
    call_service        CancelGoals     for `<action>/_action/cancel_goal`
                        ListActions     for rosapi, whose answers are made of the list
    subscribe           WatchStatus     for the topics of an action, status and feedback
                        Follow          of each goal, for its feedback
    action_feedback     Feedback
    action_result       Ended, Rejected, Failed
    service_response    CancelAnswered, Actions, Failed
    publish             GoalChanged, Feedback

*The beginning.* rosbridge has no hello, so the translator says it: at once with the token of the
`Authorization` header, if there is one, or if the server asks for none; otherwise with the token of
the client's first message, which must be an `auth`.

*Replies.* A client over the wire protocol confirms the end of a goal, grants credit, and has a
heartbeat. The translator does this as soon as what it is about was written; its channel hands these
frames to the session. The session hears of a client that is alive by the pongs of WebSocket.

*Flow.* Feedback is read from the log of its goal when the line can take more. The executor waits
for that for moments, so that a burst arrives whole. If a client reads slowly, feedback is
dropped there; ends never are.

*What is wrong.* Text that is not JSON ends the connection. Everything else concerns one call: it
gets an answer, if it says to what. These answers do not pass the session, so they have a limit: a
client that makes them and reads none is ended, as one over the wire protocol would be. An operation
that is not served is ignored, and logged once.

IDs are those of one connection. Two goals of the same ID may be open: a cancel is for the later.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from fibaction.border.abc import Endpoint
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.schema.payload import PayloadError
from fibaction.schema.turns import Pause, in_turn
from fibaction.wire.errors import sendable
from fibaction.wire.frames import FIRST_FRAME, FrameMemory
from fibaction.wire.link import OVERFULL
from fibaction.wire.messages import (
    VERSION,
    Goodbye,
    Hello,
    Ping,
    Welcome,
    decode_from_server,
    encode,
)
from fibaction.wire.settings import WireSettings
from fibaction.words.errors import ProtocolError, RejectionCode
from fibaction.words.goals import GoalID
from fibaction_transports.web.rosbridge.action_values import GoalArguments
from fibaction_transports.web.rosbridge.operations import (
    Auth,
    CallService,
    CancelActionGoal,
    Fragment,
    Ignored,
    Operation,
    SendActionGoal,
    Subscribe,
    Unsubscribe,
    Wrong,
    read,
)
from fibaction_transports.web.rosbridge.server.pending_calls import (
    Answer,
    GoalReplies,
    PendingCalls,
    SentGoal,
    ServiceReplies,
)
from fibaction_transports.web.rosbridge.server.rosapi import (
    CANCEL_SUFFIX,
    ServiceFailed,
    cancel_request,
    known_name,
    service_of,
    short_type,
)
from fibaction_transports.web.rosbridge.server.topics import Topics
from fibaction_transports.web.rosbridge.text_messages import PartialMessages, size_of

CLIENT_HEARTBEAT = 5.0
"""The heartbeat of a client, in seconds: it is dead after four of them without a pong."""
MOST_NOTES = 20
"""Different lines about what is ignored that one connection writes into the log."""

logger = clean_logger("fibaction.web")


class RosbridgeTranslator:
    """The translation of one connection, both ways."""

    def __init__(
        self,
        peer: str,
        endpoints: Mapping[str, Endpoint],
        settings: WireSettings,
        memory: FrameMemory,
        token: str = "",
    ) -> None:
        """Take the token of the request for the WebSocket; empty if it has none."""
        self.messages = PartialMessages(settings.limits.frame, memory)
        """The messages that have not arrived completely."""
        self.calls = PendingCalls(peer, self._note)
        """All that the client waits for."""
        self.topics = Topics(endpoints, max(settings.limits.goals // 2, 1), self._note)
        """All topics to which the client subscribes."""
        self.goodbye: Goodbye | None = None
        """The reason of the end, once the session has said it."""
        self._peer = peer
        self._endpoints = endpoints
        self._limit = OVERFULL * settings.limits.queue
        self._token: str | None = token
        self._frame_limit = settings.limits.frame
        if not token and settings.access.asks_for_tokens:
            self._token = None  # the first message has it
            self.messages.limit = min(FIRST_FRAME, self._frame_limit)
        self._has_begun = self._is_welcome = False
        self._arguments: dict[str, GoalArguments] = {}
        self._texts: list[str] = []
        self._size = 0
        self._notes: set[str] = set()

    # From the client

    def begin(self) -> list[bytes]:
        """Return the hello, if it can be said now and was not."""
        if self._has_begun or self._token is None:
            return []
        self._has_begun = True
        return [encode(Hello(VERSION, CLIENT_HEARTBEAT, self._token))]

    async def frames_of(self, text: str, *, was_fragmented: bool = False) -> list[bytes]:
        """Return the frames for the session that a message of the client is.

        A large message is read in its turn. The next one must wait for it.

        Raises:
            ProtocolError: The message is not JSON, or the client makes errors faster than it reads
                the answers.
        """
        with self.messages.held(text):
            operation, goal = await in_turn(len(text), partial(self._read, text))
        if self._token is None:
            self._token = operation.mac if isinstance(operation, Auth) else ""
            self.messages.limit = self._frame_limit
        frames = self.begin()
        match operation:
            case SendActionGoal():
                return frames + self._send_goal(operation, goal)
            case CancelActionGoal():
                return frames + self._cancel_goal(operation)
            case CallService():
                return frames + self._call_service(operation)
            case Subscribe():
                return frames + self.topics.subscribe(operation)
            case Unsubscribe():
                return frames + self.topics.unsubscribe(operation)
            case Fragment():
                if was_fragmented:
                    raise ProtocolError("it sent a fragment within fragments")
                message = self.messages.add_fragment(operation)
                if message is not None:
                    frames += await self.frames_of(message, was_fragmented=True)
            case Wrong():
                self._answer_wrong(operation)
            case Ignored(op):
                self._note(f"the operation {op!r} of rosbridge is not served: ignored")
            case _:
                pass  # of an auth, the token is known by now, or was not asked for
        return frames

    def _read(self, text: str, pause: Pause | None) -> tuple[Operation, bytes | str]:
        """Return the operation in a message, and if it is a goal, its payload or what is wrong."""
        operation = read(text)
        if not isinstance(operation, SendActionGoal):
            return operation, b""
        try:
            return operation, self._payload(operation, pause)
        except PayloadError as exc:
            return operation, str(exc)

    def _send_goal(self, sent: SendActionGoal, payload: bytes | str) -> list[bytes]:
        action = known_name(sent.action, self._endpoints)
        replies = GoalReplies(sent.id, sent.action, sent.fragment_size)
        if isinstance(payload, str):
            self._tell(replies.rejected(sendable(payload), RejectionCode.UNREADABLE))
            return []
        goal_id, is_bound = GoalID.random(), sent.cancel_on_disconnect
        goal = SentGoal(sent.id, action, goal_id, is_bound, replies, sent.feedback)
        return [self.calls.send_goal(goal, payload, sent.meta)]

    def _payload(self, sent: SendActionGoal, pause: Pause | None) -> bytes:
        action = known_name(sent.action, self._endpoints)
        endpoint = self._endpoints.get(action)
        if endpoint is None:
            return b""  # the session tells the client
        kind, given = endpoint.info.type_name, sent.action_type
        if kind and given and short_type(kind) != short_type(given):
            raise PayloadError(f"the type of {action!r} is {kind}, and not {excerpt(given)}")
        arguments = self._arguments.get(action)
        if arguments is None or arguments.info is not endpoint.info:
            arguments = self._arguments[action] = GoalArguments(endpoint.info)
        return arguments.encode(sent.args, pause)

    def _cancel_goal(self, sent: CancelActionGoal) -> list[bytes]:
        goal = self.calls.latest_goal(sent.id)
        if goal is None or goal.action != known_name(sent.action, self._endpoints):
            # Mostly it has just ended, and its result is under way.
            self._note("it has canceled a goal that it has not sent, or that has ended")
            return []
        return [self.calls.cancel_goal(goal)]

    def _call_service(self, call: CallService) -> list[bytes]:
        replies = ServiceReplies(call.id, call.service, call.fragment_size)
        service = service_of(call.service)
        if service is not None:
            return [self.calls.call(replies, service, call.args)]
        if not call.service.endswith(CANCEL_SUFFIX):
            self._tell(replies.failed(_not_served(call.service)))
            return []
        action = known_name(call.service.removesuffix(CANCEL_SUFFIX), self._endpoints)
        try:
            goal_id, stamp = cancel_request(call.args)
        except ServiceFailed as exc:
            self._tell(replies.failed(str(exc)))
            return []
        return [self.calls.cancel_goals(replies, action, goal_id, stamp)]

    def _answer_wrong(self, wrong: Wrong) -> None:
        if wrong.op == "send_action_goal":
            replies = GoalReplies(wrong.id, wrong.name, None)
            self._tell(replies.rejected(wrong.why, RejectionCode.UNREADABLE))
        elif wrong.op == "call_service":
            self._tell(ServiceReplies(wrong.id, wrong.name, None).failed(wrong.why))
        else:
            self._note(f"an operation {wrong.op!r} of rosbridge is wrong: {wrong.why}")

    def _note(self, text: str) -> None:
        if text not in self._notes and len(self._notes) < MOST_NOTES:
            self._notes.add(text)
            logger.info("%s: %s", self._peer, text)

    # To the client

    @property
    def has_texts(self) -> bool:
        """True if there are messages to send that are not about a frame."""
        return self._is_welcome and (bool(self._texts) or self.topics.has_texts)

    def _tell(self, texts: list[str]) -> None:
        self._texts += texts
        self._size += sum(map(size_of, texts))
        if self._size > self._limit:
            raise ProtocolError("it makes errors faster than it reads the answers")

    def texts_of(self, frame: bytes) -> list[str]:
        """Return the messages for the client that a frame of the session is."""
        message = decode_from_server(frame)
        if self.topics.is_about(message):
            return self.topics.texts_of(message)
        if isinstance(message, Answer):
            return self.calls.texts_of(message)
        if isinstance(message, Welcome):
            self._is_welcome = True
        elif isinstance(message, Goodbye):
            self.goodbye = message
        return []

    def take_texts(self) -> list[str]:
        """Return the messages that are not about a frame, once the client is let in."""
        if not self._is_welcome:
            return []
        texts, self._texts, self._size = self._texts, [], 0
        return texts + self.topics.take_texts()

    def take_replies(self) -> list[bytes]:
        """Return the frames for the session about what was written, or is due."""
        return self.calls.take_replies() + self.topics.take_replies()

    def is_alive(self) -> list[bytes]:
        """Return the frames for the session that say that the client is alive."""
        return [_PING] if self._has_begun else []


_PING = encode(Ping())


def _not_served(service: str) -> str:
    return (
        f"the service {sendable(excerpt(service))!r} is not served here: there are actions,"
        f" their {CANCEL_SUFFIX} and parts of rosapi"
    )
