"""The JSON Schemas of types, with the defaults that functions make."""

from __future__ import annotations

import itertools
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, time
from types import GenericAlias
from typing import Annotated, Any, Generic, NamedTuple, NotRequired, TypedDict, TypeVar

import msgspec
import pytest

from fibaction.schema.payload import JsonCodec
from fibaction.types.schemas import schema_of

T = TypeVar("T")


class Point(msgspec.Struct):
    """A place."""

    x: float = 0.0
    y: float = 0.0


class Square(msgspec.Struct, tag="square"):
    """A shape."""

    side: float = 1.0


class Circle(msgspec.Struct, tag="circle"):
    """Another shape."""

    radius: float = 1.0


class Drive(msgspec.Struct, rename="camel"):
    """A goal with a default of each kind."""

    max_speed: float
    target: Point = msgspec.field(default_factory=lambda: Point(2.0, 1.0))
    shape: Circle | Square = msgspec.field(default_factory=lambda: Square(3.0))
    stops: list[Point] = msgspec.field(default_factory=lambda: [Point(1.0)])
    names: list[str] = []
    note: str = "none"


class Box(msgspec.Struct, Generic[T]):
    """A type with a parameter."""

    item: T
    tags: list[str] = msgspec.field(default_factory=lambda: ["new"])


@dataclass
class Plan:
    """A dataclass that holds the other kinds of types with fields."""

    boxes: dict[str, tuple[Box[int], ...]]
    text: Box[str]
    self_made: Annotated[list[int], msgspec.Meta(max_length=3)] = field(default_factory=lambda: [1])
    inner: Plan | None = None


class Pair(NamedTuple):
    """A type whose schema has no names of fields."""

    one: Box[int]
    other: Point = Point()


class Part(TypedDict):
    """A type whose fields may be missing, without a default."""

    name: str
    size: NotRequired[int]


def completed(message_type: Any, data: Any) -> tuple[Any, list[str]]:
    """Return the message that a client without the type sends, and what it leaves out."""
    codec = JsonCodec(schema_of(message_type))
    message = codec.complete(data)
    return message, codec.left_out(message)


def test_a_client_without_the_type_sends_the_defaults_that_functions_make() -> None:
    message, left_out = completed(Drive, {"maxSpeed": 1})
    assert msgspec.convert(message, Drive) == Drive(1.0)
    assert message["shape"] == {"type": "square", "side": 3.0}
    assert left_out == []


def test_the_schema_is_that_of_msgspec_and_its_defaults() -> None:
    for kind in (int, list[Point], Point, Plan, Pair, Part, Box[int], None, dict[str, Any]):
        schema = schema_of(kind)
        for part in schema.get("$defs", {}).values():
            for made in ("tags", "self_made"):
                part.get("properties", {}).get(made, {}).pop("default", None)
        assert schema == msgspec.json.schema(kind)


def test_types_with_fields_are_found_at_any_depth_and_once() -> None:
    plan = {"boxes": {"a": [{"item": 1}]}, "text": {"item": ""}, "inner": None}
    message, left_out = completed(Plan, plan)
    assert message["boxes"]["a"] == [{"item": 1, "tags": ["new"]}]
    assert message["self_made"] == [1]
    assert left_out == []


def test_types_of_the_same_name_have_their_own_defaults() -> None:
    def box(value: int) -> Any:
        def values() -> list[int]:
            return [value]

        made: Any = msgspec.field(default_factory=values)
        return msgspec.defstruct("Same", [("of", list[int], made)], module=f"m{value}")

    both = msgspec.defstruct("Both", [("one", box(1)), ("two", box(2))])
    message, _ = completed(both, {"one": {}, "two": {}})
    assert message == {"one": {"of": [1]}, "two": {"of": [2]}}


def fail() -> int:
    raise RuntimeError("no default today")


def depend(other: object) -> object:
    return other


@pytest.mark.parametrize("factory", [uuid.uuid4, itertools.count().__next__, fail, object, depend])
def test_a_default_that_differs_or_fails_is_left_to_the_server(factory: Callable[[], Any]) -> None:
    made: Any = msgspec.field(default_factory=factory)
    kind = msgspec.defstruct("Made", [("id", Any, made), ("stops", list[Any], [])])
    message, left_out = completed(GenericAlias(list, (kind,)), [{}, {"id": 3}])
    assert message == [{"stops": []}, {"id": 3, "stops": []}]
    assert left_out == ["[0].id"]


def test_a_field_that_may_be_missing_has_no_default() -> None:
    assert completed(Part, {"name": "a"}) == ({"name": "a"}, ["size"])


class Told(TypedDict):
    """
    A shape.

        Indented.
    """

    x: Annotated[int, "How far."]
    y: Annotated[int, "Shadowed.", msgspec.Meta(description="How high.")]
    place: Annotated[Point, "Where."]


def test_a_field_and_a_type_have_their_descriptions() -> None:
    (told,) = (part for name, part in schema_of(Told)["$defs"].items() if name == "Told")
    assert told["description"] == "A shape.\n\n    Indented."
    described = {name: part.get("description") for name, part in told["properties"].items()}
    assert described == {"x": "How far.", "y": "How high.", "place": "Where."}


class Times(msgspec.Struct):
    any: datetime
    naive: Annotated[datetime, msgspec.Meta(tz=False)] | None
    first: Annotated[datetime, msgspec.Meta(description="When.")] | Point | None
    listed: list[time]
    named: dict[str, datetime]
    pair: tuple[datetime, int]
    own: Annotated[datetime, msgspec.Meta(extra_json_schema={"format": "mine"})]
    zoned: Annotated[time, msgspec.Meta(tz=True)]
    bare: Annotated[time, msgspec.Meta(tz=False)]


def test_times_have_a_format_with_an_offset_from_utc_and_without() -> None:
    fields = schema_of(Times)["$defs"]["Times"]["properties"]
    pair, _ = fields["pair"]["prefixItems"]
    found = {
        **fields,
        "naive": fields["naive"]["anyOf"][0],
        "first": fields["first"]["anyOf"][0],
        "listed": fields["listed"]["items"],
        "named": fields["named"]["additionalProperties"],
        "pair": pair,
    }
    assert {name: one["format"] for name, one in found.items()} == {
        "any": "iso-date-time",
        "naive": "date-time-local",
        "first": "iso-date-time",
        "listed": "iso-time",
        "named": "iso-date-time",
        "pair": "iso-date-time",
        "own": "mine",
        "zoned": "time",
        "bare": "partial-time",
    }
    assert schema_of(datetime) == {"type": "string", "format": "iso-date-time"}
