"""`Action`: a name, three message types, and how each becomes bytes and comes back.

Payloads are msgpack, decoded strictly. This module knows nothing of goals, servers or transports.
"""

from __future__ import annotations

import datetime
import decimal
import re
import uuid
from collections.abc import Iterator
from typing import Any, Generic, TypeGuard, TypeVar, cast, get_origin

import msgspec
from msgspec import inspect

from fibaction.exceptions import ProtocolError, TransportError, text_of

GoalT = TypeVar("GoalT")
FeedbackT = TypeVar("FeedbackT")
ResultT = TypeVar("ResultT")
T = TypeVar("T")

INTERFACES = "fibaction.interfaces"
"""The entry-point group of what makes message types: called with the name of a type, it gives
those of the goal, the feedback and the result, or raises TransportError."""

# ROS 2's rule for names (REP 144, `rmw/validate_full_topic_name.h`), so that an action can be
# served over ROS under the same name: tokens that do not start with a digit, a `~` only in front.
_NAME = re.compile(r"(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_TYPE_NAME = re.compile(r"[a-z][a-z0-9_]*/action/[A-Z][A-Za-z0-9]*", re.ASCII)

_encode = msgspec.msgpack.Encoder().encode


class Codec(Generic[T]):
    """One message type of an action: a value to bytes, and bytes to a value."""

    __slots__ = ("_decoder", "_sent", "classes", "type")

    def __init__(self, message_type: type[T], sent: str = "") -> None:
        """Make a codec. `sent` is what servers send with it, for the text of errors: `feedback of
        action 'dock'`; empty for what clients send.

        Raises:
            TypeError: msgspec cannot encode and decode such a type.
        """
        self.type = message_type
        """The type, as it was given."""
        self._sent = sent
        self._decoder = msgspec.msgpack.Decoder(message_type)
        info = inspect.type_info(message_type)
        _check_can_be_encoded(info, set())
        self.classes = tuple(_runtime_classes(info))
        """The classes that a value of this type is an instance of; `object` for any."""

    def holds(self, value: object) -> TypeGuard[T]:
        """Whether it is a value of this type, as far as its class tells."""
        return isinstance(value, self.classes)

    def encode(self, value: T) -> bytes:
        """Turn a value into bytes.

        Raises:
            TypeError: It holds something that msgpack cannot express.
            OverflowError: It holds an integer of more than 64 bits.
            ValueError: It holds text that is no Unicode.
            RecursionError: It holds itself.
        """
        return _encode(value)

    def decode(self, payload: bytes) -> T:
        """Turn bytes into a value, with no conversion from one type to another.

        Raises:
            ProtocolError: They are not a value of this type; the text names the field.
        """
        try:
            return self._decoder.decode(payload)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, TypeError) as exc:
            # A TypeError is msgspec's for a set of what cannot be in one.
            raise self._misread(str(exc)) from exc
        except Exception as exc:  # of the type's own, for instance in its `__post_init__`
            raise self._misread(text_of(exc)) from exc

    def _misread(self, text: str) -> ProtocolError:
        # The field alone would be looked for in the code that reads, where it is not to be found.
        if self._sent:
            text = f"{self._sent} is not of its type, as its server sent it: {text}"
        return ProtocolError(text)

    def schema(self) -> dict[str, Any]:
        """The type's JSON Schema; empty, which allows anything, where msgspec can make none."""
        try:
            return msgspec.json.schema(self.type)
        except TypeError:
            return {}


class ActionInfo(msgspec.Struct, frozen=True):
    """An action described without its Python types: enough for a generic client or a gateway."""

    name: str
    type_name: str = ""
    goal: dict[str, Any] = {}
    """The JSON Schema of a goal; feedback and result likewise."""
    feedback: dict[str, Any] = {}
    result: dict[str, Any] = {}


class Action(Generic[GoalT, FeedbackT, ResultT]):
    """A name, and the types of the goal, the feedback and the result.

    A type is anything that msgspec can encode and decode strictly: a `msgspec.Struct`, a
    dataclass, an attrs class, a `TypedDict`, a builtin. The types of feedback and result must
    differ at run time, because an executor yields both.
    """

    def __init__(
        self,
        name: str,
        *,
        goal: type[GoalT],
        feedback: type[FeedbackT],
        result: type[ResultT],
        type_name: str = "",
    ) -> None:
        """Define an action.

        `name` follows ROS 2's rule: letters, digits and `_`, in parts parted by `/`, none of which
        starts with a digit. `type_name` is the ROS 2 type, `package/action/Type`, if there is one.

        Raises:
            ValueError: The name or the type name breaks that rule.
            TypeError: One of them is no text, msgspec cannot handle a type, or feedback and result
                cannot be told apart.
        """
        self.name = _checked(_NAME, name, "an action's name is like `arm/pick_up`")
        self.type_name = type_name
        if type_name != "":
            _checked(
                _TYPE_NAME, type_name, "a type name is like `example_interfaces/action/Fibonacci`"
            )
        self.goal: Codec[GoalT] = Codec(goal)
        self.feedback: Codec[FeedbackT] = Codec(feedback, f"feedback of action {name!r}")
        self.result: Codec[ResultT] = Codec(result, f"the result of action {name!r}")
        self._info: ActionInfo | None = None
        for one in self.feedback.classes:
            for other in self.result.classes:
                if issubclass(one, other) or issubclass(other, one):
                    raise TypeError(
                        f"action {name!r}: an executor yields feedback and result, and a value of"
                        f" {one.__name__!r} could be either; give them types of their own"
                    )

    @property
    def info(self) -> ActionInfo:
        """The description that travels: name, type name and JSON Schemas."""
        if self._info is None:
            schemas = (codec.schema() for codec in (self.goal, self.feedback, self.result))
            self._info = ActionInfo(self.name, self.type_name, *schemas)
        return self._info

    @classmethod
    def untyped(cls, info: ActionInfo) -> Action[Any, Any, Any]:
        """An action of plain data (dicts, lists, numbers, text), for clients without the types.

        It cannot be given to an `ActionServer`, which needs types to tell a result from feedback.
        """
        action = cast("Action[Any, Any, Any]", object.__new__(cls))
        anything = cast("type[Any]", Any)
        action.name, action.type_name, action._info = info.name, info.type_name, info
        action.goal = Codec(anything)
        action.feedback = Codec(anything, f"feedback of action {info.name!r}")
        action.result = Codec(anything, f"the result of action {info.name!r}")
        return action

    @classmethod
    def from_ros(cls, type_name: str, *, name: str) -> Action[Any, Any, Any]:
        """An action whose types are made from a ROS 2 type, for those who have only that.

        They are structs with ROS's fields, defaults and constants: `action.goal.type(order=3)`.
        The type is looked for where Python imports from, so ROS 2 and the package must be there.

        Raises:
            TransportError: The type cannot be had; the text says what is missing.
            ValueError: The name breaks the rule for names.
        """
        goal, feedback, result = _interface(type_name)
        return cls(name, goal=goal, feedback=feedback, result=result, type_name=type_name)

    def __repr__(self) -> str:
        return f"<Action {self.name!r}>"


def _interface(type_name: str) -> tuple[type[Any], type[Any], type[Any]]:
    """The types of a ROS 2 action, from whatever package knows how to make them."""
    from importlib.metadata import entry_points  # takes longer than all other imports

    found = tuple(entry_points(group=INTERFACES, name="ros2"))
    if not found:
        raise TransportError(
            f"no package that makes message types from ROS 2 is installed, so {type_name!r}"
            " cannot be had"
        )
    try:
        make = found[0].load()
    except TransportError:
        raise  # it says by itself what it needs
    except Exception as exc:  # whatever somebody else's module does when it is imported
        raise TransportError(
            f"message types cannot be made from {type_name!r}, because {found[0].value}"
            f" cannot be imported: {exc}"
        ) from exc
    goal, feedback, result = make(type_name)
    return goal, feedback, result


def _checked(rule: re.Pattern[str], text: object, meaning: str) -> str:
    if not isinstance(text, str):
        raise TypeError(f"{meaning}, and not {text!r}")
    if not rule.fullmatch(text):
        raise ValueError(f"{meaning}, unlike {text!r}")
    return text


_CLASSES: dict[type[inspect.Type], tuple[type, ...]] = {
    inspect.NoneType: (type(None),),
    inspect.BoolType: (bool,),
    inspect.IntType: (int,),
    inspect.FloatType: (float, int),  # as for type checkers, an int will do for a float
    inspect.StrType: (str,),
    inspect.BytesType: (bytes,),
    inspect.ByteArrayType: (bytearray,),
    inspect.MemoryViewType: (memoryview,),
    inspect.ListType: (list,),
    inspect.TupleType: (tuple,),
    inspect.VarTupleType: (tuple,),
    inspect.SetType: (set,),
    inspect.FrozenSetType: (frozenset,),
    inspect.DictType: (dict,),
    inspect.TypedDictType: (dict,),
    inspect.DateTimeType: (datetime.datetime,),
    inspect.DateType: (datetime.date,),
    inspect.TimeType: (datetime.time,),
    inspect.TimeDeltaType: (datetime.timedelta,),
    inspect.UUIDType: (uuid.UUID,),
    inspect.DecimalType: (decimal.Decimal,),
    inspect.RawType: (msgspec.Raw,),
    inspect.ExtType: (msgspec.msgpack.Ext,),
}


def _check_can_be_encoded(info: object, seen: set[int]) -> None:
    """Look for a class that msgspec would hand to a hook, wherever it is nested.

    Raises:
        TypeError: There is one.
    """
    if id(info) in seen:  # a type may contain itself
        return
    seen.add(id(info))
    if isinstance(info, inspect.CustomType) and info.cls is not object:
        raise TypeError(
            f"{info.cls.__qualname__} cannot be encoded: make it a msgspec.Struct, a dataclass, an"
            f" attrs class or a TypedDict"
        )
    if isinstance(info, inspect.Field):
        _check_can_be_encoded(info.type, seen)
    elif isinstance(info, inspect.Type):
        for name in info.__struct_fields__:
            value = getattr(info, name)
            for part in value if isinstance(value, tuple) else (value,):
                _check_can_be_encoded(part, seen)


def _runtime_classes(info: inspect.Type) -> Iterator[type]:
    """The classes of the values of a type; `object` for a type that says nothing."""
    if isinstance(info, inspect.Metadata):
        yield from _runtime_classes(info.type)
    elif isinstance(info, inspect.UnionType):
        for part in info.types:
            yield from _runtime_classes(part)
    elif isinstance(info, inspect.LiteralType):
        yield from {type(value) for value in info.values}
    elif type(info) in _CLASSES:
        yield from _CLASSES[type(info)]
    else:
        cls = getattr(info, "cls", object)
        yield get_origin(cls) or cls  # a generic class comes with its arguments
