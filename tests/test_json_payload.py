from __future__ import annotations

import datetime
import json
import math
import uuid
from typing import Annotated, Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.msgpack import Ext

from fibaction.json_payload import JsonCodec, PayloadError, _validator_class, to_json
from tests.cli.robot import Gripper, Pick, Pose, Sucker

Aware = Annotated[datetime.datetime, msgspec.Meta(tz=True)]
ENDLESS: list[Any] = []
ENDLESS.append(ENDLESS)
NEW_YEAR = datetime.datetime(2026, 1, 2, 3, tzinfo=datetime.UTC)


class Times(msgspec.Struct):
    at: Aware | None = None
    lasting: datetime.timedelta | None = None
    name: str = ""
    number: uuid.UUID | None = None


@pytest.fixture(autouse=True)
def _new_validators() -> None:
    """Make the validators anew, so that these tests cover it whichever tests came before."""
    _validator_class.cache_clear()


def codec_of(kind: Any) -> JsonCodec:
    return JsonCodec(msgspec.json.schema(kind))


def arrived(kind: Any, data: object) -> Any:
    """Return the goal as a server of that type receives it."""
    return msgspec.msgpack.decode(codec_of(kind).encode(data), type=kind)


@pytest.mark.parametrize(
    ("kind", "data", "goal"),
    [
        (Pick, {"object_name": "cup"}, Pick("cup")),
        (Pick, {"object_name": "cup", "pose": {"x": 1}}, Pick("cup", pose=Pose(x=1))),
        (Pick, {"object_name": "cup", "retries": 2.0}, Pick("cup", retries=2)),
        (
            Pick,
            {"object_name": "cup", "waypoints": [{}, {"y": 1}]},
            Pick("cup", waypoints=[Pose(), Pose(y=1)]),
        ),
        (Pick, {"object_name": "cup", "photo": "aGk="}, Pick("cup", photo=b"hi")),
        (Pick, {"object_name": "cup", "photo": b"hi"}, Pick("cup", photo=b"hi")),
        (
            Pick,
            {"object_name": "cup", "start": "2026-01-02T03:04:05"},
            Pick("cup", start=datetime.datetime(2026, 1, 2, 3, 4, 5)),
        ),
        (Pick, {"object_name": "cup", "tags": {"a": 1}}, Pick("cup", tags={"a": 1})),
        (Pick, {"object_name": "cup", "tool": {"type": "sucker"}}, Pick("cup", tool=Sucker())),
        (
            Pick,
            {"object_name": "cup", "tool": {"type": "gripper", "force": 2}},
            Pick("cup", tool=Gripper(2)),
        ),
        (
            Times,
            {"at": "2026-01-02T03:00:00Z", "lasting": "PT1S", "name": "2026-01-02"},
            Times(NEW_YEAR, datetime.timedelta(seconds=1), "2026-01-02"),
        ),
        (Pose, {}, Pose()),
        (int, 5, 5),
        (int | None, None, None),
        (list[float], [1, 2.5, math.inf], [1, 2.5, math.inf]),
        (tuple[int, bytes], [1, "aGk="], (1, b"hi")),
        (dict[int, bytes], {1: "aGk="}, {1: b"hi"}),
        (list[Pose | None], [None, {"x": 1}], [None, Pose(x=1)]),
    ],
)
def test_a_goal_arrives_as_it_was_meant(kind: Any, data: object, goal: object) -> None:
    assert arrived(kind, data) == goal


def test_missing_fields_get_the_defaults_of_the_schema() -> None:
    goal = codec_of(Pick).complete({"tool": {"type": "sucker"}, "object_name": "cup"})

    assert list(goal)[:3] == ["object_name", "speed", "retries"]  # in the order of the type
    assert goal["retries"] == 3
    assert goal["tool"] == {"type": "sucker", "vacuum": 0.5}


def test_an_empty_schema_allows_any_data() -> None:
    assert JsonCodec({}).complete({"a": [1, "b"]}) == {"a": [1, "b"]}


@pytest.mark.parametrize(
    ("kind", "data", "message"),
    [
        (Pick, {}, "goal.object_name is missing"),
        (
            Pick,
            {"object_name": 5, "pose": {"z": 1}},
            'goal.object_name must be text, not 5; goal.pose has no field "z"; it has x, y, frame',
        ),
        (
            Pick,
            {"object_name": "cup", "photo": "???"},
            'goal.photo must be bytes in base64, not "???"',
        ),
        (Times, {"at": "soon"}, 'goal.at must be a date and time in ISO 8601, not "soon"'),
        (Pose, {"x": object()}, "the goal cannot be encoded: Encoding objects of type object"),
        (list[Any], ENDLESS, "the goal cannot be encoded: "),
    ],
)
def test_an_error_is_one_sentence_that_names_the_field(
    kind: Any, data: object, message: str
) -> None:
    with pytest.raises(PayloadError) as caught:
        codec_of(kind).complete(data)

    assert str(caught.value).startswith(message)


def test_an_error_names_the_message_as_the_codec_does() -> None:
    with pytest.raises(PayloadError, match="result must be a whole number, not"):
        JsonCodec(msgspec.json.schema(int), "result").encode("ten")


def test_an_error_shows_the_first_problems_and_holds_all() -> None:
    with pytest.raises(PayloadError) as caught:
        codec_of(list[int]).complete(list("abcdefg"))

    assert str(caught.value).startswith('goal[0] must be a whole number, not "a"; goal[1]')
    assert str(caught.value).endswith('not "e"; and 2 more')
    assert len(caught.value.problems) == 7


def test_a_number_beyond_msgpack_is_rejected() -> None:
    with pytest.raises(PayloadError, match="the goal cannot be encoded: "):
        codec_of(int).encode(2**64)


def test_a_payload_becomes_json_data() -> None:
    value = {"a": [1, 2.5, None], "b": b"hi", "t": NEW_YEAR, "e": Ext(5, b"x"), "ü": math.nan}

    assert JsonCodec({}).decode(msgspec.msgpack.encode(value)) == {
        "a": [1, 2.5, None],
        "b": "aGk=",
        "t": "2026-01-02T03:00:00Z",
        "e": {"ext": 5, "data": "eA=="},
        "ü": None,
    }


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\xa1\xff"])
def test_a_payload_that_is_not_msgpack_is_rejected(payload: bytes) -> None:
    with pytest.raises(PayloadError, match="the feedback is not a valid payload: "):
        JsonCodec({}, "feedback").decode(payload)


@pytest.mark.parametrize("value", [{(1, 2): 3}, object()])
def test_a_value_beyond_json_is_rejected(value: object) -> None:
    with pytest.raises(PayloadError, match="the value cannot be written as JSON: "):
        to_json(value)


class Tree(msgspec.Struct):
    value: int
    children: list[Tree] = []
    by_name: dict[str, Tree] = {}
    pair: tuple[int, Pose] | None = None


leaves = st.builds(Tree, value=st.integers(-(2**63), 2**63 - 1))
trees = st.builds(
    Tree,
    value=st.integers(-9, 9),
    children=st.lists(leaves, max_size=3),
    by_name=st.dictionaries(st.text(max_size=5), leaves, max_size=3),
    pair=st.none() | st.tuples(st.integers(-9, 9), st.builds(Pose, frame=st.text(max_size=5))),
)


@given(trees)
def test_any_goal_in_json_arrives_as_it_is(tree: Tree) -> None:
    data = json.loads(msgspec.json.encode(tree))

    assert arrived(Tree, data) == tree
    assert codec_of(Tree).decode(msgspec.msgpack.encode(tree)) == data


def test_a_schema_is_not_changed() -> None:
    schema = msgspec.json.schema(Pick)
    before = json.dumps(schema)

    JsonCodec(schema).complete({"object_name": "cup"})["tags"]["a"] = 1

    assert json.dumps(schema) == before
