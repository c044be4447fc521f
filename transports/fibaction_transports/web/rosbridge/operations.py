"""The messages of rosbridge clients and servers: JSON text to operations.

A message is an object whose `op` names the operation. Operations about publishers, services of
others and the settings of rosbridge itself are not served here, and are `Ignored`. An operation
that is served, with a field that is wrong, is `Wrong`: its client gets an answer, if the message
says to what.

Servers differ. Old ones leave out the `status` of a result, tell some errors as a `status` message,
and make fragments whose `total` is not a whole number. Fields that are not needed may be missing.
"""

from __future__ import annotations

import json
from contextlib import suppress
from typing import Annotated, Any, TypeAlias, Union, cast

import msgspec

from fibaction.border.peer_text import excerpt
from fibaction.schema.turns import has_costly_numbers, read_json
from fibaction.wire.errors import sendable
from fibaction.words.errors import ProtocolError
from fibaction.words.plain_data import is_map

LONGEST_ID = 1000
"""Characters of an ID, at most: it is in each answer."""
MOST_FRAGMENTS = 10_000
"""Fragments of one message, at most."""

ClientID: TypeAlias = (
    Annotated[str, msgspec.Meta(max_length=LONGEST_ID)]
    | Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
    | None
)
"""The ID of a request, made by the client; None if it has none."""
Arguments: TypeAlias = dict[str, Any] | list[Any] | None
"""The fields of a message by name, or in their order; None for the defaults."""
FragmentSize: TypeAlias = Annotated[int, msgspec.Meta(ge=1)] | None
"""Characters of the largest message that the client accepts; None for any."""


class SendActionGoal(msgspec.Struct, tag_field="op", tag="send_action_goal"):
    """Request to send a goal."""

    action: str
    action_type: str | None = None
    id: ClientID = None
    args: Arguments = None
    feedback: bool = False
    fragment_size: FragmentSize = None
    cancel_on_disconnect: bool = False
    """True if the goal is canceled when its connection is lost."""
    meta: dict[str, str] | None = None
    """Text that goes with the goal, for traces: see `SendGoal.meta`."""


class CancelActionGoal(msgspec.Struct, tag_field="op", tag="cancel_action_goal"):
    """Request to cancel the goal that was sent with the same ID."""

    action: str
    id: ClientID = None


class CallService(msgspec.Struct, tag_field="op", tag="call_service"):
    """Call of a service."""

    service: str
    id: ClientID = None
    args: Arguments = None
    fragment_size: FragmentSize = None


class SubscriptionQos(msgspec.Struct):
    """The quality of service of a subscription; only the depth counts."""

    depth: Annotated[int, msgspec.Meta(ge=0)] = 0


class Subscribe(msgspec.Struct, tag_field="op", tag="subscribe"):
    """Request for the messages of a topic."""

    topic: str
    id: ClientID = None
    type: str | None = None
    throttle_rate: Annotated[float, msgspec.Meta(ge=0)] = 0
    """Milliseconds between two messages, at least."""
    queue_length: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Messages that wait for their time, at most; with 0, those that come too early are dropped."""
    fragment_size: FragmentSize = None
    qos: SubscriptionQos | None = None

    @property
    def most_waiting(self) -> int:
        """Messages that wait for their time, at most."""
        return self.queue_length if self.qos is None else self.qos.depth


class Unsubscribe(msgspec.Struct, tag_field="op", tag="unsubscribe"):
    """End of the subscription with that ID; of all of that topic, if it has none."""

    topic: str
    id: ClientID = None


class Fragment(msgspec.Struct, tag_field="op", tag="fragment"):
    """A piece of the text of another message."""

    id: ClientID
    data: str
    num: Annotated[int, msgspec.Meta(ge=0)]
    total: Annotated[int, msgspec.Meta(ge=1, le=MOST_FRAGMENTS)]


class Auth(msgspec.Struct, tag_field="op", tag="auth"):
    """The client's access token: what `authenticate()` of roslibjs has as its first argument."""

    mac: str


class Wrong(msgspec.Struct):
    """An operation with a field that is wrong."""

    op: str
    id: ClientID
    name: str
    """The name of the action or the service; empty if it is wrong, too."""
    why: str


class Ignored(msgspec.Struct):
    """A message with an operation that is not served here, or without one."""

    op: str


Operation: TypeAlias = (
    SendActionGoal
    | CancelActionGoal
    | CallService
    | Subscribe
    | Unsubscribe
    | Fragment
    | Auth
    | Wrong
    | Ignored
)

_id_type: Any = ClientID


class OperationReader:
    """A reader of the operations that one side serves."""

    def __init__(self, *served: type[msgspec.Struct], accepts_nan: bool = False) -> None:
        """Serve these operations; with `accepts_nan`, even with values that are not numbers, as
        Python's JSON writes them.
        """
        self._type: Any = Union[served]  # noqa: UP007  # it is not written out here
        self._decoder: msgspec.json.Decoder[Any] = msgspec.json.Decoder(self._type)
        self._names = frozenset(one.__struct_config__.tag for one in served)
        self._accepts_nan = accepts_nan

    def read(self, text: str) -> Any:
        """Return the operation in a message; `Wrong` or `Ignored` if it cannot be served.

        Raises:
            ProtocolError: The message is not JSON.
        """
        try:
            if has_costly_numbers(text):
                return msgspec.convert(read_json(text), self._type)
            return self._decoder.decode(text)
        except (ValueError, RecursionError) as exc:
            why = str(exc)
        # Python's own parser takes NaN as well, which roslibpy writes: such a call gets its answer.
        # Raised behind the block, so that the error does not keep the message.
        try:
            data = json.loads(text)
        except (ValueError, RecursionError):
            data = _NOT_JSON
        if data is _NOT_JSON:
            raise ProtocolError(f"it sent a message that is not JSON: {excerpt(why)}")
        if self._accepts_nan:
            with suppress(ValueError, RecursionError):
                return msgspec.convert(data, self._type)
        return self._wrong(data, why)

    def _wrong(self, data: object, why: str) -> Wrong | Ignored:
        op = data.get("op") if is_map(data) else None
        if not is_map(data) or not isinstance(op, str) or op not in self._names:
            return Ignored(excerpt(op) if isinstance(op, str) else "")
        name = data.get("action", data.get("service"))
        text = sendable(name) if isinstance(name, str) else ""
        return Wrong(op, _id_in(data), text, why)


_NOT_JSON = object()
_of_clients = OperationReader(
    SendActionGoal, CancelActionGoal, CallService, Subscribe, Unsubscribe, Fragment, Auth
)


def read(text: str) -> Operation:
    """Return the operation in a message of a client.

    Raises:
        ProtocolError: The message is not JSON.
    """
    return cast("Operation", _of_clients.read(text))


def _id_in(data: dict[Any, Any]) -> ClientID:
    try:
        found = msgspec.convert(data.get("id"), _id_type)
    except msgspec.ValidationError:
        return None
    return sendable(found) if isinstance(found, str) else cast("int | None", found)


class ActionFeedback(msgspec.Struct, tag_field="op", tag="action_feedback"):
    """A feedback message of a goal."""

    id: ClientID = None
    values: Any = None


class ActionResult(msgspec.Struct, tag_field="op", tag="action_result"):
    """The end of a goal."""

    id: ClientID = None
    values: Any = None
    """The result; a text if there is none."""
    status: int | None = None
    """The status of the goal; None from old servers."""
    result: bool = True
    """True if `values` is a result."""
    reason: str = ""
    """The reason of the end, which only servers of fibaction tell."""
    code: int | None = None
    """The `RejectionCode` of a goal that was not accepted, which only servers of fibaction tell."""


class ServiceResponse(msgspec.Struct, tag_field="op", tag="service_response"):
    """The answer to a call of a service."""

    id: ClientID = None
    values: Any = None
    result: bool = True
    """True if `values` is an answer, and not the text of an error."""


class StatusMessage(msgspec.Struct, tag_field="op", tag="status"):
    """A line of the log of a server, mostly about a message that it could not use."""

    id: ClientID = None
    level: str = "error"
    msg: str = ""


class ServerFragment(msgspec.Struct, tag_field="op", tag="fragment"):
    """A piece of the text of another message."""

    id: ClientID
    data: str
    num: Annotated[int, msgspec.Meta(ge=0)]
    total: Annotated[float, msgspec.Meta(ge=1, le=MOST_FRAGMENTS)]
    """The number of pieces; servers of ROS 2 add a fraction of one."""

    def whole(self) -> Fragment:
        """Return the fragment with a whole number of pieces."""
        return Fragment(self.id, self.data, self.num, int(self.total))


ServerOperation: TypeAlias = (
    ActionFeedback | ActionResult | ServiceResponse | StatusMessage | Fragment | Wrong | Ignored
)

_reader = OperationReader(
    ActionFeedback, ActionResult, ServiceResponse, StatusMessage, ServerFragment, accepts_nan=True
)


def read_from_server(text: str) -> ServerOperation:
    """Return the operation in a message of a server.

    Raises:
        ProtocolError: The message is not JSON.
    """
    found = _reader.read(text)
    return found.whole() if isinstance(found, ServerFragment) else cast("ServerOperation", found)
