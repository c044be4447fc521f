"""`GoalCheck`: the check of goals by the JSON Schema of their type, as at every other door.

The types of the action decide whether a goal can be read, and take a field that they do not have,
so that clients of a newer version are understood. A client without types has no version: there, a
field that is not known is a mistake. So its goals are compared with the schema, too, by the check
that REST, rosbridge, MCP and the command use. Goals that the types have not taken are compared with
it as well, since its sentences name the field and what is expected. Large goals are checked in a
thread, as the documents of strangers are everywhere.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Coroutine, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from fibaction.words.errors import GoalRejected, RejectionCode

if TYPE_CHECKING:
    from fibaction.schema.payload import GoalCodec

_PLACED = re.compile(r"([^`]*(?:`[^`]*`[^`]*)*) - at `\$([^`]*)`")
_DATE_TIME = "must be a date and time with seconds, such as 2026-01-31T12:00:00Z"
_DURATION = "must be a duration in days, hours, minutes and seconds, such as P1DT2H30M"
_CLEAR = {
    "Invalid RFC3339 encoded datetime": _DATE_TIME,
    "Expected `datetime` with a timezone component": f"{_DATE_TIME}, and tell the offset from UTC",
    "Invalid RFC3339 encoded date": "must be a date such as 2026-01-31",
    "Invalid RFC3339 encoded time": "must be a time with seconds, such as 12:00:00",
    "Expected `time` with a timezone component": (
        "must be a time with its offset from UTC, such as 12:00:00Z"
    ),
    "Only units 'D', 'H', 'M', and 'S' are supported when parsing ISO8601 durations": _DURATION,
    "Invalid ISO8601 duration": _DURATION,
    "Invalid UUID": "must be a UUID such as 00000000-0000-0000-0000-000000000000",
}
"""Sentences in place of those of msgspec, for texts that the check by the schema takes, since
pydantic does.
"""

Pause: TypeAlias = Callable[[], None]


class GoalCheck:
    """The check of the goals of one action by the schema of their type."""

    def __init__(self, schema: Callable[[], Mapping[str, Any]]) -> None:
        """Make a check; `schema` is called for the first goal that is checked."""
        self._schema = schema
        self._json: GoalCodec | None = None

    def check(self, goal: bytes, misread: str = "") -> Coroutine[Any, Any, None] | None:
        """Check a goal: return None if it matches, or a coroutine that checks a large one.

        `misread` is the error of the types; empty if they have taken the goal.

        Raises:
            GoalRejected: The goal does not match, or there is an error already; here or in the
                coroutine.
        """
        from fibaction.schema.turns import SMALL  # not needed by clients with types

        if len(goal) > SMALL:
            return self._check_in_turn(goal, misread)
        self._check(goal, misread, None)
        return None

    async def _check_in_turn(self, goal: bytes, misread: str) -> None:
        from fibaction.schema.turns import in_turn

        await in_turn(len(goal), lambda pause: self._check(goal, misread, pause))

    def _check(self, goal: bytes, misread: str, pause: Pause | None) -> None:
        text = self._mismatch(goal, pause) or _readable(misread)
        if text:
            raise GoalRejected(text, code=RejectionCode.UNREADABLE)

    def _mismatch(self, goal: bytes, pause: Pause | None) -> str:
        """Return what is wrong with a goal; empty if the schema finds nothing."""
        from fibaction.schema.payload import GoalCodec, PayloadError, SchemaError

        try:
            if self._json is None:
                self._json = GoalCodec(self._schema())
            self._json.check(msgspec.msgpack.decode(goal), pause)
        except PayloadError as exc:
            # An error of the schema is not the client's.
            return "" if isinstance(exc.__cause__, SchemaError) else str(exc)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, TypeError):
            pass  # it is not msgpack, and the types have told that
        return ""


def _readable(misread: str) -> str:
    """Return the error of the types as sentences that begin with the field."""
    if "; " in misread and misread.count("`$") > 1:  # of pydantic, which tells several
        return "; ".join(map(_readable, misread.split("; ")))
    found = _PLACED.fullmatch(misread)
    if found is None:
        return misread
    text, place = found.groups()
    return f"goal{place} {_CLEAR[text]}" if text in _CLEAR else f"goal{place}: {text}"
