from __future__ import annotations

import re
from typing import Any

import msgspec
import pytest

from fibaction import GoalRejected, RejectionCode
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


@pytest.mark.parametrize("schema", [{"$ref": "#/no/such/part"}, {}])
def test_a_schema_that_cannot_be_used_leaves_the_goal_to_its_type(schema: dict[str, Any]) -> None:
    assert GoalCheck(lambda: schema).check(packed({"a": 1})) is None


def test_a_type_tells_whether_it_says_which_fields_there_are() -> None:
    assert all(Codec[Any](one).is_typed for one in (Drive, int, list[int]))
    assert not any(
        Codec[Any](one).is_typed for one in (Any, object, dict, dict[str, Any], msgspec.Raw)
    )
