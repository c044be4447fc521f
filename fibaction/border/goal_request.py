"""`GoalRequest`: a goal on its way to a server, for authors of endpoints and transports.

One request goes from the client through every endpoint on the way. `fibaction.border.abc` exports
it.
"""

from __future__ import annotations

import math

import msgspec

from fibaction.words.goals import UNKNOWN_SENDER, GoalID, Sender
from fibaction.words.meta import Meta


class GoalRequest(msgspec.Struct, frozen=True):
    """A goal that is sent, with everything that goes with it.

    An endpoint passes it on as it is. To change a field, make a copy:

        request = msgspec.structs.replace(request, sender=sender)
    """

    goal_id: GoalID
    """The ID of the goal, made by the client."""
    goal: bytes
    """The payload."""
    feedback: bool = True
    """True to follow feedback and status changes, too; False to follow the outcome only."""
    sender: Sender = UNKNOWN_SENDER
    """The client that sends the goal, for the goal's record; `UNKNOWN_SENDER` if it is not known. A
    connection to another process does not pass it on, since the server there identifies its clients
    itself."""
    deadline: float = math.inf
    """Time, by `anyio.current_time()`, at which the client gives up the goal; `math.inf` if it does
    not. It may be in the past. The executor gets it as `GoalHandle.deadline`, and the server does
    not enforce it. A goal that is sent again keeps its first deadline. To another process, send the
    seconds that are left: its clock is another one."""
    meta: Meta | None = None
    """A small text map that goes with the goal, for traces: see `fibaction.observe.Tracing`; None
    is the same as an empty one. It has at most 8 keys and 4096 bytes. Watchers of the server get
    it; ROS 2 does not carry it."""
    checked: bool = False
    """True if the client has the types of the action, or has compared the goal with its schema. The
    server then ignores a field that its own type does not have, since the client may be of a newer
    version. False to have such a goal rejected: the field is likely misspelled."""
