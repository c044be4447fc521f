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

from fibaction.schema.check import LISTS_OF_PARTS, PARTS, REFERENCES, TURN, CheckSteps
from fibaction.schema.keywords import COMPARISONS
from fibaction.schema.payload import GoalCodec, JsonCodec, PayloadError, to_json
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
        (list[bytes], ["aGk=", [104, 105], [], b"hi"], [b"hi", b"hi", b"", b"hi"]),
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
        (list[bytes], [[True]], "goal[0] must be text, not [true]"),
        (list[bytes], [[1, 256]], "goal[0] must be text, not [1,256]"),
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


def test_a_message_of_msgpack_is_compared_as_one_that_is_sent() -> None:
    codec = JsonCodec({"properties": {"speed": {"type": "number"}}, "type": "object"})
    codec.check(msgspec.msgpack.decode(codec.encode({"speed": 1.5})))
    with pytest.raises(PayloadError) as sent:
        codec.encode({"speeed": 1.5})
    with pytest.raises(PayloadError) as compared:
        codec.check({"speeed": 1.5})
    assert str(compared.value) == str(sent.value)


def test_an_error_shows_the_first_problems_and_holds_all() -> None:
    with pytest.raises(PayloadError) as caught:
        codec_of(list[int]).complete(list("abcdefg"))

    assert str(caught.value).startswith('goal[0] must be a whole number, not "a"; goal[1]')
    assert str(caught.value).endswith('not "e"; and 2 more')
    assert len(caught.value.problems) == 7


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


def test_data_that_was_read_from_json_is_sent_without_a_copy() -> None:
    data = {"object_name": "cup", "waypoints": [{"x": 1.0}]}

    assert codec_of(Pick).encode(data, is_json=True) == codec_of(Pick).encode(data)


# Hostile schemas and data

JSON_SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
ANY_JSON = st.recursive(
    JSON_SCALARS | st.sampled_from(["\ud800", "#", "#/$defs/a", "integer", "base64", 10**30]),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4)
    ),
    max_leaves=10,
)
KEYWORDS = [
    *COMPARISONS,
    *PARTS,
    *LISTS_OF_PARTS,
    *REFERENCES,
    "$id",
    "$schema",
    "$anchor",
    "pattern",
    "uniqueItems",
    "default",
    "if",
]


def schemas_of(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """Schemas that have real keywords, with the right values or with any."""
    fields = st.dictionaries(st.sampled_from(["a", "b"]), inner, max_size=2)
    some = st.lists(inner, max_size=3)
    names = st.sampled_from(["integer", "string", "object", "array", "null", "nonsense"])
    right: dict[str, st.SearchStrategy[Any]] = {
        "$ref": st.sampled_from(["#", "#/$defs/a", "#/$defs/b", "#/properties/a", "file:///etc"]),
        "$defs": fields,
        "properties": fields,
        "anyOf": some,
        "allOf": some,
        "oneOf": some,
        "prefixItems": some,
        "not": inner,
        "items": inner,
        "additionalProperties": inner,
        "propertyNames": inner,
        "type": names | st.lists(names, max_size=2),
        "default": ANY_JSON,
        "multipleOf": st.sampled_from([1, 0.01, 5e-324, 10**400]),
        "minimum": st.integers(-3, 3),
        "contentEncoding": st.just("base64"),
    }
    wrong = st.dictionaries(st.sampled_from(KEYWORDS), ANY_JSON, max_size=2)
    return st.fixed_dictionaries({}, optional=right) | wrong


SCHEMAS = st.recursive(ANY_JSON | st.booleans(), schemas_of, max_leaves=12)


@given(SCHEMAS, ANY_JSON)
def test_any_value_is_a_schema_or_an_error_and_so_is_any_message(schema: Any, data: Any) -> None:
    try:
        JsonCodec(schema).encode(data)
    except PayloadError as error:
        assert all(len(problem) < 2000 for problem in error.problems)  # noqa: PT017 - either is right


def nested(levels: int, key: str | None = None) -> Any:
    value: Any = None
    for _ in range(levels):
        value = [value] if key is None else {key: value}
    return value


REMOTE = "refers to {}, which is outside of it; only references such as"
FATAL = {"$defs": {"a": {"anyOf": [{"allOf": [{"$ref": "#/$defs/a"}] * 2}]}}}


@pytest.mark.parametrize(
    ("schema", "message"),
    [
        ({"$ref": "http://127.0.0.1:9/x"}, REMOTE.format('"http://127.0.0.1:9/x"')),
        ({"items": {"$ref": "file:///etc/passwd"}}, REMOTE.format('"file:///etc/passwd"')),
        ({"$dynamicRef": "http://h/x"}, REMOTE.format('"http://h/x"')),
        ({"$id": "http://h/", "$ref": "x.json"}, REMOTE.format('"x.json"')),
        ({"$ref": "#anchor", "$anchor": "anchor"}, REMOTE.format('"#anchor"')),
        ({"$ref": "#/$defs/a"}, 'refers to "#/$defs/a", which is not in it'),
        ({"anyOf": [True], "$ref": "#/anyOf/1"}, 'refers to "#/anyOf/1", which is not in it'),
        ({"$ref": "#"}, 'refers to itself without end, by "#"'),
        (
            {"$ref": "#/$defs/a", "$defs": {"a": {"$ref": "#/$defs/b"}, "b": {"$ref": "#"}}},
            "refers to itself without end, by ",
        ),
        ({"type": 5}, 'is malformed: "type" cannot be 5'),
        ({"items": [1]}, "is malformed: [1] is not a schema"),
        ({"properties": {1: {}}}, "is malformed: 1 is not the name of a field"),
        ([], "is malformed: [] is not a schema"),
        ({"anyOf": [{}] * 20_000}, "has more than 20,000 parts"),
    ],
)
def test_a_schema_that_cannot_be_used_is_an_error_at_once(schema: Any, message: str) -> None:
    with pytest.raises(PayloadError) as caught:
        JsonCodec(schema)

    assert str(caught.value).startswith(f"the schema of the goal {message}")


@pytest.mark.parametrize(
    ("schema", "data", "message"),
    [
        ({"anyOf": [{"$ref": "#"}, {"$ref": "#"}]}, 1, "nests deeper than 200 levels"),
        ({**FATAL, "$ref": "#/$defs/a"}, 1, "nests deeper than 200 levels"),
        ({"$defs": {"a": {"anyOf": [{"$ref": "#/$defs/a"}]}}, "$ref": "#/$defs/a"}, {}, "nests"),
        (
            {
                "$ref": "#/$defs/0",
                "$defs": {
                    **{str(i): {"allOf": [{"$ref": f"#/$defs/{i + 1}"}] * 2} for i in range(60)},
                    "60": {},
                },
            },
            5,
            "is too complex: a check by it takes over 20,050 steps",
        ),
        (
            {"items": {"default": 0, "properties": {"a": {"default": [0] * 10_000}}}},
            [{}] * 1000,
            "has too many defaults: in this message they take",
        ),
        ({"properties": {"a": {"default": nested(200)}}}, {}, "has a default that nests deeper"),
    ],
)
def test_a_schema_that_takes_too_long_is_an_error_soon(
    schema: Any, data: Any, message: str
) -> None:
    with pytest.raises(PayloadError, match=f"the schema of the goal {message}"):
        JsonCodec(schema).complete(data)


def test_no_regular_expression_of_a_schema_is_run() -> None:
    endless = "^(a+)+$"
    schema = {
        "properties": {"a": {"type": "string", "pattern": endless}},
        "patternProperties": {endless: False},
        "propertyNames": {"pattern": endless},
        "additionalProperties": False,
    }
    data = {"a": "a" * 50 + "b", "a" * 50 + "b": 1}

    assert JsonCodec(schema).complete(data) == data


def test_data_that_nests_deeply_is_an_error() -> None:
    schema = {"items": {"$ref": "#"}, "additionalProperties": {"$ref": "#"}}

    assert JsonCodec(schema).complete(nested(100)) == nested(100)
    for data in (nested(101), nested(101, "a")):
        with pytest.raises(PayloadError, match="the goal nests deeper than 100 levels"):
            JsonCodec(schema).complete(data)


def test_a_recursive_type_may_nest_as_deeply_as_data_may() -> None:
    data: dict[str, Any] = {"value": 1}
    for _ in range(49):
        data = {"value": 1, "children": [data]}

    assert arrived(Tree, data).children[0].children[0].value == 1


def test_a_large_message_of_a_plain_type_is_not_too_complex() -> None:
    many = [{"value": 1, "pair": [1, {}]}] * 10_000

    assert len(arrived(Tree, {"value": 1, "children": many}).children) == 10_000


@pytest.mark.parametrize("data", ["\ud800", {"\ud800": 1}, ["a\udfff"]])
def test_text_with_a_lone_surrogate_is_rejected(data: Any) -> None:
    for schema in ({}, {"type": ["string", "object", "array"]}, {"type": "integer"}):
        with pytest.raises(PayloadError) as caught:
            JsonCodec(schema).complete(data)
        assert str(caught.value).isprintable()


def test_a_default_that_msgpack_cannot_express_is_an_error_of_the_message() -> None:
    with pytest.raises(PayloadError, match="the goal cannot be encoded: "):
        JsonCodec({"properties": {"a": {"default": 10**30}}}).complete({})


def test_at_most_a_hundred_mismatches_are_kept() -> None:
    with pytest.raises(PayloadError, match="and 95 more") as caught:
        codec_of(list[int]).complete(["x" * i for i in range(5000)])

    assert len(caught.value.problems) == 100


def test_what_a_message_leaves_to_the_server_is_named_up_to_a_hundred_fields() -> None:
    codec = JsonCodec({"properties": {f"a{i}": {"type": "object"} for i in range(200)}})

    assert codec.left_out({}) == [f"a{i}" for i in range(100)]
    assert JsonCodec({}).left_out({"a": 1}) == []


def test_what_a_large_message_leaves_to_the_server_is_named() -> None:
    point = {"properties": {name: {"type": "number"} for name in "xyz"}}
    points = {"type": "array", "items": point}
    trajectory = {"points": [{"x": 1.0, "y": 2.0, "z": 3.0}] * 5000}

    codec = JsonCodec({"properties": {"points": points, "speed": {"type": "number"}}})

    assert codec.left_out(trajectory) == ["speed"]


def test_all_defaults_of_a_schema_are_checked_within_one_bound(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    granted = list[int]()
    grant = CheckSteps._grant

    def counted(self: CheckSteps) -> None:
        grant(self)
        granted.append(TURN)

    monkeypatch.setattr(CheckSteps, "_grant", counted)
    doubled: Any = {"type": "string"}
    for _ in range(10):
        doubled = {"allOf": [doubled, doubled]}
    fields = {f"f{number}": {**doubled, "default": 0} for number in range(100)}

    with pytest.raises(PayloadError, match=r"goal\.f0 must be text, not 0"):
        JsonCodec({"properties": fields}).complete({})

    assert sum(granted) < 100_000


def test_what_is_wrong_is_told_before_that_a_schema_takes_too_long() -> None:
    endless = {"anyOf": [{"$ref": "#/$defs/a"}]}
    fields = {"a": {"type": "null"}, "b": {"$ref": "#/$defs/a"}}
    codec = JsonCodec({"properties": fields, "$defs": {"a": endless}})
    with pytest.raises(PayloadError, match=r"^goal\.a must be null, not 1$"):
        codec.encode({"a": 1, "b": 2})


@pytest.mark.parametrize(
    ("schema", "goal", "payload"),
    [
        ({"type": "object", "properties": {}}, None, {}),
        ({"type": "object", "properties": {"x": {"default": 1}}}, None, {"x": 1}),
        ({"type": "null"}, {}, None),
        ({"anyOf": [{"type": "integer"}, {"type": "null"}]}, {}, None),
        ({"anyOf": [{"type": "object"}, {"type": "null"}]}, None, None),
        ({}, {}, {}),
        ({}, None, None),
    ],
)
def test_a_goal_that_is_not_given_is_what_the_schema_has_for_it(
    schema: dict[str, Any], goal: object, payload: object
) -> None:
    goals = GoalCodec(schema)
    assert not goals.needs_goal
    assert msgspec.msgpack.decode(goals.encode(goal)) == payload
    goals.check(goal)


def test_a_goal_that_is_needed_and_not_given_is_an_error_that_names_it() -> None:
    goals = GoalCodec({"type": "object", "properties": {"x": {}}, "required": ["x"]})
    assert goals.needs_goal
    with pytest.raises(PayloadError, match=r"goal\.x is missing"):
        goals.encode({})
    with pytest.raises(PayloadError, match="goal must be a map of fields, not null"):
        goals.encode(None)
