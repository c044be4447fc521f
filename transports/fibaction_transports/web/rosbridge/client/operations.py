"""The messages of a rosbridge server, and those that are sent to it.

Servers differ. Old ones leave out the `status` of a result, tell some errors as a `status` message,
and make fragments whose `total` is not a whole number. Fields that are not needed may be missing.
"""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias, cast

import msgspec

from fibaction_transports.web.rosbridge.operations import (
    MOST_FRAGMENTS,
    ClientID,
    Fragment,
    Ignored,
    OperationReader,
    Wrong,
)


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
