from __future__ import annotations

import re
from datetime import UTC, datetime, time, timedelta
from typing import Annotated, Any
from uuid import UUID

import msgspec
import pytest

from fibaction import GoalRejected, ProtocolError, RejectionCode
from fibaction.schema.goal_check import GoalCheck
from fibaction.types.action import Codec


class Drive(msgspec.Struct):
    meters: float
    speed: float = 1.0


def packed(goal: Any) -> bytes:
    return msgspec.msgpack.encode(goal)


def test_a_goal_that_matches_its_schema_passes_at_once() -> None:
    check = GoalCheck(Codec(Drive).schema)
    for _ in range(2):
        assert check.check(packed({"meters": 2.0})) is None


@pytest.mark.parametrize(
    ("goal", "misread", "reason"),
    [
        (packed({"meters": 2.0, "sped": 3.0}), "", 'goal has no field "sped"; did you mean speed?'),
        (packed({"meters": "far"}), "Expected `float`", 'goal.meters must be a number, not "far"'),
        (packed({"meters": 2.0}), "the rule of its class", "the rule of its class"),
        (b"\xc1", "MessagePack data is malformed", "MessagePack data is malformed"),
    ],
)
def test_a_goal_is_rejected_with_the_text_of_the_schema_or_else_of_its_type(
    goal: bytes, misread: str, reason: str
) -> None:
    with pytest.raises(GoalRejected, match=f"^{re.escape(reason)}$") as caught:
        GoalCheck(Codec(Drive).schema).check(goal, misread)
    assert caught.value.code is RejectionCode.UNREADABLE


@pytest.mark.asyncio
async def test_a_large_goal_is_checked_when_it_is_waited_for() -> None:
    checking = GoalCheck(Codec(Drive).schema).check(packed({"meters": 1.0, "note": "x" * 3000}))
    assert checking is not None
    with pytest.raises(GoalRejected, match='goal has no field "note"'):
        await checking


def test_a_time_that_only_the_type_refuses_is_told_with_its_field_and_a_right_one() -> None:
    class Times(msgspec.Struct):
        at: datetime
        naive: Annotated[datetime, msgspec.Meta(tz=False)] = datetime(2026, 1, 1)
        aware: Annotated[datetime, msgspec.Meta(tz=True)] = datetime(2026, 1, 1, tzinfo=UTC)
        every: timedelta = timedelta()
        days: list[time] = []
        id: UUID = UUID(int=0)

    codec = Codec(Times)
    for field, text, told in [
        ("at", "2025-01-01T00:00Z", "goal.at must be a date and time with seconds, such as 2026-"),
        ("naive", "2025-01-01T00:00:00Z", "goal.naive must be a date and time in ISO 8601 without"),
        ("aware", "2025-01-01T00:00:00", "goal.aware must be .*, and tell the offset from UTC$"),
        ("every", "P2W", "goal.every must be a duration in days, hours, minutes and seconds, such"),
        ("days", ["12:00"], r"goal\.days\[0\] must be a time with seconds, such as 12:00:00, not "),
        ("id", f"urn:uuid:{UUID(int=0)}", "goal.id must be a UUID such as 0000"),
    ]:
        goal = packed({"at": "2026-01-01T00:00:00", field: text})
        with pytest.raises(ProtocolError) as caught:
            codec.decode(goal)
        with pytest.raises(GoalRejected, match=f"^{told}"):
            GoalCheck(codec.schema).check(goal, str(caught.value))


@pytest.mark.parametrize(
    ("misread", "told"),
    [
        ("too far - at `$.meters`", "goal.meters: too far"),
        ("a; b - at `$.a`", "goal.a: a; b"),
        (
            "Expected `A` - at `$[...].b[1]`; No - at `$.b`",
            "goal[...].b[1]: Expected `A`; goal.b: No",
        ),
        ("a `$ b `$", "a `$ b `$"),
    ],
)
def test_the_error_of_a_type_begins_with_the_field(misread: str, told: str) -> None:
    with pytest.raises(GoalRejected, match=f"^{re.escape(told)}$"):
        GoalCheck(Codec(Drive).schema).check(packed({"meters": 2.0}), misread)


@pytest.mark.parametrize("schema", [{"$ref": "#/no/such/part"}, {}])
def test_a_schema_that_cannot_be_used_leaves_the_goal_to_its_type(schema: dict[str, Any]) -> None:
    assert GoalCheck(lambda: schema).check(packed({"a": 1})) is None


def test_a_type_tells_whether_it_says_which_fields_there_are() -> None:
    assert all(Codec[Any](one).is_typed for one in (Drive, int, list[int]))
    assert not any(
        Codec[Any](one).is_typed for one in (Any, object, dict, dict[str, Any], msgspec.Raw)
    )
