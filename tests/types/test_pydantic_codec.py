"""Types with pydantic models in them: what is sent, what is accepted, and their schemas."""

from __future__ import annotations

import base64
import dataclasses
import datetime
import decimal
import enum
import ipaddress
import pathlib
import uuid
from collections.abc import AsyncIterator, Callable
from typing import Annotated, Any, Generic, Literal, NewType, TypeVar

import msgspec
import pydantic
import pytest
from pydantic import BaseModel, ConfigDict, Field, HttpUrl
from typing_extensions import TypeAliasType, TypedDict

from fibaction import Action, ActionServer, GoalHandle, GoalRejected, connect, serve
from fibaction.schema.payload import JsonCodec, PayloadError
from fibaction.types.action import Codec
from fibaction.words.errors import ProtocolError
from tests.test_init import modules_after

T = TypeVar("T")


class Goal(BaseModel):
    order: int = Field(ge=0)


class Feedback(BaseModel):
    partial: list[int]


class Result(BaseModel):
    sequence: list[int] = []


SUM: Action[Goal, Feedback, Result] = Action("sum", goal=Goal, feedback=Feedback, result=Result)


async def executor(goal: GoalHandle[Goal]) -> AsyncIterator[Feedback | Result]:
    numbers = [0, 1]
    for _ in range(goal.request.order):
        numbers.append(numbers[-1] + numbers[-2])
        yield Feedback(partial=numbers)
    yield Result(sequence=numbers)


class Colour(enum.Enum):
    RED = "red"


class Cat(BaseModel):
    kind: Literal["cat"] = "cat"
    photo: bytes = b"\xff\xfe"


class Dog(BaseModel):
    kind: Literal["dog"] = "dog"
    age: int


class Everything(BaseModel):
    """A model with a field of each kind that is encoded in its own way."""

    data: bytes
    at: datetime.datetime
    day: datetime.date
    lasts: datetime.timedelta
    key: uuid.UUID
    colour: Colour
    file: pathlib.Path
    price: decimal.Decimal
    some: set[int]
    pair: tuple[int, str]
    url: HttpUrl
    ip: ipaddress.IPv4Address
    pet: Annotated[Cat | Dog, Field(discriminator="kind")]
    pets: list[Cat | Dog] = [Cat()]
    named: int = Field(alias="theName")
    me: Everything | None = None


EVERYTHING = Everything(
    data=b"\xff",
    at=datetime.datetime(2024, 2, 29, tzinfo=datetime.UTC),
    day=datetime.date(2024, 2, 29),
    lasts=datetime.timedelta(seconds=1.5),
    key=uuid.UUID(int=1),
    colour=Colour.RED,
    file=pathlib.Path("/x"),
    price=decimal.Decimal("1.50"),
    some={1, 2},
    pair=(1, "one"),
    url=HttpUrl("http://robot/"),
    ip=ipaddress.IPv4Address("127.0.0.1"),
    pet=Dog(age=3),
    theName=1,
)


class Strict(BaseModel):
    model_config = ConfigDict(strict=True)
    key: uuid.UUID
    pair: tuple[int, int]


class Numbers(pydantic.RootModel[list[int]]):
    """A model that is a list."""


class Box(BaseModel, Generic[T]):
    content: T


@pydantic.dataclasses.dataclass
class Checked:
    age: Annotated[int, Field(lt=10)]


@dataclasses.dataclass
class Kennel:
    pets: list[Cat | Dog]


class Card(TypedDict):
    pet: Dog


@dataclasses.dataclass
class Tree:
    """A type that contains itself."""

    parts: list[Tree]
    pet: Dog | None = None


DogLike = NewType("DogLike", Dog)
Pet = TypeAliasType("Pet", Cat | Dog)


VALUES: list[tuple[Any, Any, tuple[type, ...]]] = [
    (Everything, EVERYTHING, (Everything,)),
    (Strict, Strict(key=uuid.UUID(int=2), pair=(1, 2)), (Strict,)),
    (Numbers, Numbers([1, 2]), (Numbers,)),
    (Box[int], Box[int](content=1), (Box[int],)),
    (Checked, Checked(3), (Checked,)),
    (Kennel, Kennel([Cat(), Dog(age=1)]), (Kennel,)),
    (Card, {"pet": Dog(age=1)}, (dict,)),
    (Tree, Tree([Tree([], Dog(age=1))]), (Tree,)),
    (list[Dog], [Dog(age=1)], (list,)),
    (dict[str, Dog], {"rex": Dog(age=1)}, (dict,)),
    (Cat | Dog, Dog(age=1), (Cat, Dog)),
    (Dog | None, None, (Dog, type(None))),
    (Dog | float, 1.5, (Dog, float, int)),
    (Dog | Literal["none"], "none", (Dog, str)),
    (Annotated[Cat | Dog, Field(discriminator="kind")], Cat(), (Cat, Dog)),
    (DogLike, DogLike(Dog(age=1)), (Dog,)),
    (Pet, Cat(), (Cat, Dog)),
    (Dog | Any, 1, (Dog, object)),
]
NAMES = [str(message_type) for message_type, _, _ in VALUES]


@pytest.mark.parametrize(("message_type", "value", "classes"), VALUES, ids=NAMES)
def test_a_value_becomes_bytes_and_comes_back(
    message_type: Any, value: Any, classes: tuple[type, ...]
) -> None:
    codec: Codec[Any] = Codec(message_type)
    back = codec.decode(codec.encode(value))
    assert back == value
    assert type(back) is type(value)
    assert codec.holds(back)
    assert codec.classes == classes


def test_a_message_is_as_that_of_any_other_class_with_such_fields() -> None:
    class Plain(msgspec.Struct):
        data: bytes
        at: datetime.datetime
        key: uuid.UUID
        price: decimal.Decimal
        the_name: int = msgspec.field(name="theName")

    sent = Codec(Everything).encode(EVERYTHING)
    assert Codec(Plain).decode(sent) == Plain(
        b"\xff", EVERYTHING.at, EVERYTHING.key, EVERYTHING.price, 1
    )


@pytest.mark.parametrize(("message_type", "value", "classes"), VALUES[:-1], ids=NAMES[:-1])
def test_json_data_becomes_a_value_by_the_schema(
    message_type: Any, value: Any, classes: tuple[type, ...]
) -> None:
    codec: Codec[Any] = Codec(message_type)
    payloads = JsonCodec(codec.schema())
    data = payloads.decode(codec.encode(value))
    assert codec.decode(payloads.encode(data)) == value


def test_defaults_are_filled_in_from_the_schema() -> None:
    codec: Codec[Any] = Codec(Everything)
    payloads = JsonCodec(codec.schema())
    data = payloads.decode(codec.encode(EVERYTHING))
    del data["pets"], data["me"]
    data["pet"] = {"kind": "cat"}
    assert payloads.complete(data)["pet"]["photo"] == b"\xff\xfe"
    whole = codec.decode(payloads.encode(data))
    assert whole == EVERYTHING.model_copy(update={"pet": Cat()})


def test_a_schema_has_bytes_in_base64_and_alternatives_in_the_way_of_all_types() -> None:
    schema = Codec(Everything).schema()["$defs"]["Everything"]["properties"]
    assert schema["data"]["contentEncoding"] == "base64"
    assert "oneOf" not in schema["pet"]
    assert schema["pets"]["default"] == [
        {"kind": "cat", "photo": base64.b64encode(b"\xff\xfe").decode()}
    ]
    with pytest.raises(PayloadError, match=r'goal must be "cat" or "dog"|goal.kind must be'):
        JsonCodec(Codec[Any](VALUES[14][0]).schema()).encode({"kind": "cow"})


def test_a_goal_that_a_model_rejects_names_its_fields() -> None:
    wrong = msgspec.msgpack.encode(
        {"data": "x", "at": [], "pet": {"kind": "dog", "age": "old"}, "pets": [{"kind": "cow"}]}
    )
    with pytest.raises(ProtocolError) as caught:
        Codec(Everything).decode(wrong)
    first, second, third, more = str(caught.value).split("; ")
    assert first == "Input should be a valid datetime - at `$.at`"
    assert second == "Field required - at `$.day`"
    assert third == "Field required - at `$.lasts`"
    assert more.startswith("and ")
    assert caught.value.__cause__ is caught.value.__context__ is None  # may hold the payload

    with pytest.raises(ProtocolError) as caught:
        Codec(Kennel).decode(msgspec.msgpack.encode({"pets": [{"kind": "cat", "photo": 1}]}))
    assert "at `$.pets[0].Cat.photo`" in str(caught.value)
    with pytest.raises(ProtocolError, match=r"^Input should be an object$"):
        Codec(Goal).decode(msgspec.msgpack.encode(1))


def test_what_a_model_itself_raises_is_an_error_of_what_was_sent() -> None:
    class Unfinished(BaseModel):
        name: str

        @pydantic.field_validator("name")
        @classmethod
        def check(cls, name: str) -> str:
            if name == "legs":
                raise ValueError("the robot has no legs")
            raise KeyError(name)

    with pytest.raises(ProtocolError, match=r"the robot has no legs - at `\$\.name`"):
        Codec(Unfinished).decode(msgspec.msgpack.encode({"name": "legs"}))
    with pytest.raises(ProtocolError, match=r"^KeyError: 'arm'$"):
        Codec(Unfinished).decode(msgspec.msgpack.encode({"name": "arm"}))


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\x92\x01", b"\x81\x80\x01"], ids=bytes.hex)
def test_malformed_bytes_are_a_protocol_error(payload: bytes) -> None:
    with pytest.raises(ProtocolError):
        Codec(Goal).decode(payload)


def test_a_model_converts_unless_it_is_strict() -> None:
    assert Codec(Goal).decode(msgspec.msgpack.encode({"order": "3"})) == Goal(order=3)
    key = str(uuid.UUID(int=2))
    with pytest.raises(ProtocolError, match=r"^Input should be a valid integer - at `\$\.pair"):
        Codec(Strict).decode(msgspec.msgpack.encode({"key": key, "pair": ["1", 2]}))


@pytest.mark.parametrize("data", [{"pair": [b"\xff", 1]}, {"pair": msgspec.msgpack.Ext(1, b"")}])
def test_what_json_does_not_express_is_not_valid_as_json(data: Any) -> None:
    with pytest.raises(ProtocolError, match="should be an instance of UUID"):
        Codec(Strict).decode(msgspec.msgpack.encode({"key": str(uuid.UUID(int=2)), **data}))


def test_a_value_that_does_not_fit_its_model_is_not_sent() -> None:
    with pytest.raises(ValueError, match="Expected `int`"):
        Codec(Goal).encode(Goal.model_construct(order="three"))


def test_a_secret_is_not_sent_as_asterisks() -> None:
    class Login(BaseModel):
        password: pydantic.SecretStr

    with pytest.raises(TypeError, match="a SecretStr is not sent: give its field a serializer"):
        Codec(Login).encode(Login(password=pydantic.SecretStr("x")))


# Types that cannot be used


class Foreign:
    """A class of which pydantic knows nothing."""


class Arbitrary(BaseModel):
    model_config = ConfigDict(arbitrary_types_allowed=True)
    foreign: Foreign


class WithFunction(BaseModel):
    function: Callable[[], int]


class Undefined(BaseModel):
    there: Nowhere  # type: ignore[name-defined]  # noqa: F821  # pydantic tells so


class Mixed(msgspec.Struct):
    pet: Dog


@pytest.mark.parametrize(
    ("message_type", "text"),
    [
        (Arbitrary, "Cannot generate a JsonSchema for core_schema.IsInstanceSchema"),
        (WithFunction, "Cannot generate a JsonSchema for core_schema.CallableSchema"),
        (Undefined, "is not fully defined; you should define"),
        (Mixed, "Unable to generate pydantic-core schema for <class "),
        (Dog | Foreign, "Unable to generate pydantic-core schema for <class "),
    ],
    ids=["arbitrary", "function", "undefined", "struct", "union"],
)
def test_a_type_that_cannot_be_encoded_is_rejected_when_the_action_is_made(
    message_type: Any, text: str
) -> None:
    with pytest.raises(TypeError) as caught:
        Action("sum", goal=message_type, feedback=int, result=str)
    start = "the goal of action 'sum': a type with pydantic models cannot be encoded: "
    assert str(caught.value).startswith(f"{start}{text}" if text[0] == "C" else start)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
    assert ("a msgspec.Struct cannot hold models" in str(caught.value)) is (message_type is Mixed)


# In programs


@pytest.mark.asyncio
@pytest.mark.parametrize("url", ["inproc://models", "tcp://127.0.0.1:0"])
async def test_models_go_from_a_client_to_a_server_and_back(url: str) -> None:
    async with serve(ActionServer(SUM, executor), url) as (found,):
        async with connect(found, SUM) as client:
            async with client.send_goal(Goal(order=2)) as goal:
                assert [one async for one in goal] == [
                    Feedback(partial=[0, 1, 1]),
                    Feedback(partial=[0, 1, 1, 2]),
                ]
                assert await goal.result() == Result(sequence=[0, 1, 1, 2])
            with pytest.raises(GoalRejected, match="order: -1 is less than the minimum of 0"):
                await client.call(Goal.model_construct(order=-1))
        async with connect(found) as connection:
            (info,) = await connection.actions()
            assert info.goal["properties"]["order"]["minimum"] == 0
            plain = connection.client(Action.untyped(info))
            assert await plain.call({"order": 0}) == {"sequence": [0, 1]}


def test_pydantic_is_not_imported_unless_the_program_has_done_so() -> None:
    program = "from fibaction import Action; Action('sum', goal=int, feedback=float, result=str)"
    modules = modules_after(program)
    assert not {"pydantic", "pydantic_core", "fibaction.types.pydantic_codec"} & modules


def test_other_types_are_left_to_msgspec_though_pydantic_is_there() -> None:
    with pytest.raises(TypeError, match=r"^Foreign cannot be encoded: use a msgspec\.Struct, "):
        Codec(Foreign)


class Place(BaseModel):
    """A model in a model."""

    x: float = 0


class Ride(BaseModel):
    """A model with a default of each kind."""

    to: Place = Field(default_factory=lambda: Place(x=2))
    id: uuid.UUID = Field(default_factory=uuid.uuid4)
    by: str = "me"


def test_models_of_pydantic_have_the_defaults_that_functions_make() -> None:
    codec = JsonCodec(Action("ride", goal=Ride, feedback=int, result=str).info.goal)
    message = codec.complete({})
    assert message == {"to": {"x": 2.0}, "by": "me"}
    assert codec.left_out(message) == ["id"]


def test_a_model_of_defaults_is_the_goal_of_a_client_that_gives_none() -> None:
    action = Action("sum", goal=Result, feedback=Feedback, result=Result)
    assert action.goal.decode(b"\xc0") == action.goal.decode(b"\x80") == Result()
