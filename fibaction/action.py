"""`Action`: a name and three message types, each with its encoding.

Payloads are msgpack, decoded strictly. This module does not depend on goals, servers or transports.
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

from fibaction._text import excerpt
from fibaction.exceptions import ProtocolError, TransportError, text_of

GoalT = TypeVar("GoalT")
FeedbackT = TypeVar("FeedbackT")
ResultT = TypeVar("ResultT")
T = TypeVar("T")

INTERFACES = "fibaction.interfaces"
"""The entry-point group of functions that make message types. Such a function takes the name of a
ROS 2 type, and returns the types of the goal, the feedback and the result, or raises
TransportError."""

# ROS 2's rule for names (REP 144, `rmw/validate_full_topic_name.h`), so that an action can be
# served over ROS under the same name: tokens that do not start with a digit, a `~` only in front.
_NAME = re.compile(r"(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_TYPE_NAME = re.compile(r"[a-z][a-z0-9_]*/action/[A-Z][A-Za-z0-9]*", re.ASCII)

_encode = msgspec.msgpack.Encoder().encode


class Codec(Generic[T]):
    """The encoding of one message type of an action, from values to bytes and back."""

    __slots__ = ("_decoder", "_sent", "classes", "type")

    def __init__(self, message_type: type[T], sent: str = "") -> None:
        """Make a codec.

        `sent` names the messages that servers send with it, for the text of errors, for example
        `feedback of action 'dock'`; it is empty for messages of clients.

        Raises:
            TypeError: msgspec cannot encode and decode such a type.
        """
        self.type = message_type
        """The message type, unchanged."""
        self._sent = sent
        self._decoder = msgspec.msgpack.Decoder(message_type)
        info = inspect.type_info(message_type)
        _check_can_be_encoded(info, set())
        self.classes = tuple(_runtime_classes(info))
        """The classes that a value of this type is an instance of; `object` for any."""

    def holds(self, value: object) -> TypeGuard[T]:
        """Return whether the value is of this type, judging by its class alone."""
        return isinstance(value, self.classes)

    def encode(self, value: T) -> bytes:
        """Turn a value into bytes.

        Raises:
            TypeError: It contains an object that msgpack cannot express.
            OverflowError: It contains an integer of more than 64 bits.
            ValueError: It contains text that is not valid Unicode.
            RecursionError: It contains itself.
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
            # msgspec raises TypeError for a set of unhashable values.
            text = excerpt(str(exc))
        except Exception as exc:  # of the type's own, for instance in its `__post_init__`
            raise self._misread(text_of(exc)) from exc
        # Raised here, so that it does not keep msgspec's error, which may hold the whole payload.
        raise self._misread(text)

    def _misread(self, text: str) -> ProtocolError:
        # Without the sender, the reader of the text would look for the fault in the client's code.
        if self._sent:
            text = f"{self._sent} is not of its type, as its server sent it: {text}"
        return ProtocolError(text)

    def schema(self) -> dict[str, Any]:
        """Return the type's JSON Schema.

        It is empty, which allows any value, if msgspec cannot make a schema of the type.
        """
        try:
            return msgspec.json.schema(self.type)
        except TypeError:
            return {}


class ActionInfo(msgspec.Struct, frozen=True):
    """The description of an action without its Python types, for generic clients and gateways."""

    name: str
    type_name: str = ""
    goal: dict[str, Any] = {}
    """The JSON Schema of a goal; feedback and result likewise."""
    feedback: dict[str, Any] = {}
    result: dict[str, Any] = {}


class Action(Generic[GoalT, FeedbackT, ResultT]):
    """A name, and the types of the goal, the feedback and the result.

    A type is any that msgspec can encode and decode strictly: a `msgspec.Struct`, a dataclass, an
    attrs class, a `TypedDict`, a builtin. The types of feedback and result must differ at run time,
    because an executor yields both.
    """

    def __init__(
        self,
        name: str,
        *,
        goal: type[GoalT],
        feedback: type[FeedbackT],
        result: type[ResultT],
        checkpoint: type[Any] | None = None,
        type_name: str = "",
    ) -> None:
        """Define an action.

        `checkpoint` is the type of the states that its executor keeps in the server's store, to go
        on from after a crash; None if it keeps none. Clients do not see it.

        `name` follows ROS 2's rule: parts of letters, digits and `_`, separated by `/`; a part does
        not start with a digit. `type_name` is the ROS 2 type, `package/action/Type`; empty if the
        action has none.

        Raises:
            ValueError: The name or the type name breaks that rule.
            TypeError: One of them is not text, msgspec cannot handle a type, or feedback and result
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
        self.checkpoint: Codec[Any] | None = None if checkpoint is None else Codec(checkpoint)
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
        """The description that is sent to clients: name, type name and JSON Schemas."""
        if self._info is None:
            schemas = (codec.schema() for codec in (self.goal, self.feedback, self.result))
            self._info = ActionInfo(self.name, self.type_name, *schemas)
        return self._info

    @classmethod
    def untyped(cls, info: ActionInfo) -> Action[Any, Any, Any]:
        """Make an action of plain data (dicts, lists, numbers, text), for clients without the
        types.

        An `ActionServer` rejects it, because it needs types to tell a result from feedback.
        """
        action = cast("Action[Any, Any, Any]", object.__new__(cls))
        anything = cast("type[Any]", Any)
        action.name, action.type_name, action._info = info.name, info.type_name, info
        action.goal = Codec(anything)
        action.feedback = Codec(anything, f"feedback of action {info.name!r}")
        action.result = Codec(anything, f"the result of action {info.name!r}")
        action.checkpoint = None
        return action

    @classmethod
    def from_ros(cls, type_name: str, *, name: str) -> Action[Any, Any, Any]:
        """Make an action whose types are those of an installed ROS 2 type.

        They are structs with ROS's fields, defaults and constants: `action.goal.type(order=3)`.
        The type is imported as a Python module, so ROS 2 and the type's package must be importable.

        Raises:
            TransportError: The type cannot be imported; the text says what is missing.
            ValueError: The name breaks the rule for names.
        """
        goal, feedback, result = _interface(type_name)
        return cls(name, goal=goal, feedback=feedback, result=result, type_name=type_name)

    def __repr__(self) -> str:
        return f"<Action {self.name!r}>"


def _interface(type_name: str) -> tuple[type[Any], type[Any], type[Any]]:
    """Return the types of a ROS 2 action, made by the package that declares the entry point."""
    from importlib.metadata import entry_points  # slow to import, and needed here only

    found = tuple(entry_points(group=INTERFACES, name="ros2"))
    if not found:
        raise TransportError(
            f"cannot make message types from {type_name!r}: install a package with an entry point"
            f" 'ros2' in the group {INTERFACES!r}, such as fibaction itself"
        )
    try:
        make = found[0].load()
    except TransportError:
        raise  # its text already says what is missing
    except Exception as exc:  # importing another package may raise anything
        raise TransportError(
            f"cannot make message types from {type_name!r}: {found[0].value} cannot be imported:"
            f" {exc}"
        ) from exc
    goal, feedback, result = make(type_name)
    return goal, feedback, result


def _checked(rule: re.Pattern[str], text: object, meaning: str) -> str:
    if not isinstance(text, str):
        raise TypeError(f"{meaning}, not {text!r}")
    if not rule.fullmatch(text):
        raise ValueError(f"{meaning}, not {text!r}")
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
    """Check that no class, however deeply nested, is one that msgspec would give to a hook.

    Raises:
        TypeError: A class is.
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
            value: object = getattr(info, name)
            parts = cast("tuple[object, ...]", value if isinstance(value, tuple) else (value,))
            for part in parts:
                _check_can_be_encoded(part, seen)


def _runtime_classes(info: inspect.Type) -> Iterator[type]:
    """Yield the classes of the values of a type; `object` for a type that allows any value."""
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
