"""`with_result`: the result of a goal that has ended, for a list of goals."""

from __future__ import annotations

from msgspec.structs import replace

from fibaction.border.abc import Endpoint
from fibaction.types.action import Codec, ResultT
from fibaction.words.errors import ProtocolError
from fibaction.words.goals import GoalInfo


async def with_result(endpoint: Endpoint, codec: Codec[ResultT], info: GoalInfo) -> GoalInfo:
    """Return a goal with its result, and with its whole reason, if it has ended.

    A goal that the server has forgotten meanwhile stays as it is. If the result cannot be read, the
    reason says so.

    Raises:
        TransportError, ProtocolError: As for `Endpoint.get_result`.
    """
    if not info.status.is_terminal:
        return info
    outcome = await endpoint.get_result(info.goal_id)
    if not outcome.status.is_terminal:
        return info
    try:
        result = None if outcome.result is None else codec.decode(outcome.result)
    except ProtocolError as exc:
        return replace(info, reason=outcome.unreadable(exc).reason)
    return replace(info, result=result, reason=outcome.reason)
