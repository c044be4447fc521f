"""`Action`: a name and three message types, each with its encoding.

Payloads are msgpack, decoded strictly. This module does not depend on goals, servers or transports.
"""

from __future__ import annotations

import gc
import re
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from inspect import formatannotation
from types import NoneType
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeGuard, TypeVar, cast, get_origin

import msgspec

from fibaction._runtime.text import excerpt
from fibaction.types.encodings import encoding_of
from fibaction.types.ros_classes import is_message, load
from fibaction.words.errors import FAILURES, ProtocolError, text_of
from fibaction.words.plain_data import is_map

if TYPE_CHECKING:
    from typing_extensions import TypeForm

GoalT = TypeVar("GoalT")
FeedbackT = TypeVar("FeedbackT")
ResultT = TypeVar("ResultT")
T = TypeVar("T")

NO_VALUE: Any = object()
"""The default of a goal that a caller does not give."""
LARGE = 2**16
"""Bytes of a payload that may have very many values."""

NIL, EMPTY_MAP = b"\xc0", b"\x80"  # in msgpack
NOTHING = {NIL: EMPTY_MAP, EMPTY_MAP: NIL}
"""The two goals of a client that has none to give. If a type does not take one, the other counts:
so a client that knows an action without a goal and one that knows a goal without fields agree."""
WITHOUT_FIELDS: dict[str, Any] = {"type": "object", "properties": {}, "additionalProperties": False}
"""The JSON Schema of the goal of an action without a goal, which is `{}` in JSON."""
_FROM_SERVERS = ("feedback", "the result")
_UNTYPED: frozenset[Any] = frozenset({Any, object, dict, Mapping, msgspec.Raw})
# ROS 2's rule for names (REP 144, `rmw/validate_full_topic_name.h`), so that an action can be
# served over ROS under the same name: tokens that do not start with a digit, a `~` only in front.
_NAME = re.compile(r"(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_TYPE_NAME = re.compile(r"[a-z][a-z0-9_]*/action/[A-Z][A-Za-z0-9]*", re.ASCII)


class Codec(Generic[T]):
    """The encoding of one message type of an action, from values to bytes and back."""

    __slots__ = (
        "_decode",
        "_encode",
        "_encoding",
        "_is_goal",
        "_messages",
        "_sent",
        "classes",
        "is_typed",
        "type",
    )

    def __init__(
        self,
        message_type: TypeForm[T],
        sent: str = "",
        ros_type: str = "",
        *,
        is_goal: bool = False,
    ) -> None:
        """Make a codec.

        `sent` names the messages that servers send with it, for the text of errors, for example
        `feedback of action 'dock'`; it is empty for messages of clients. `ros_type` is the type of
        the ROS messages that may be encoded instead of a value; if it is empty, those with the same
        fields may. Goals have the rule of `NOTHING`.

        Raises:
            TypeError: Such a type cannot be encoded and decoded.
        """
        self.type: type[T] = cast("type[T]", message_type)
        """The message type, unchanged. It may be a form such as `int | None`, and not a class."""
        self._sent = sent
        self._is_goal = is_goal
        self._encoding = encoding_of(message_type)
        self.is_typed = (get_origin(message_type) or message_type) not in _UNTYPED
        """True if the type says which fields its values have."""
        self._encode: Callable[[T], bytes] = self._encoding.encode
        self._decode: Callable[[bytes], T] = self._encoding.decode
        self.classes = self._encoding.classes
        """The classes that a value of this type is an instance of; `object` for any."""
        self._messages = ros_type

    @property
    def type_text(self) -> str:
        """The type as it is written, for the text of an error."""
        kind: Any = self.type
        if isinstance(kind, type) and get_origin(kind) is None:
            return "None" if kind is NoneType else kind.__name__
        return excerpt(formatannotation(kind))

    def holds(self, value: object) -> TypeGuard[T]:
        """Return whether the value is of this type, judging by its class alone."""
        return isinstance(value, self.classes)

    def accepts(self, value: object) -> TypeGuard[T]:
        """Return whether the value is of this type, or is a ROS message that `encode` takes."""
        if isinstance(value, self.classes):
            return True
        if not is_message(value):
            return False
        from fibaction.types.ros_messages import reader_of

        try:
            reader_of(value, self.type, self._messages, encoding=self._encoding)
        except TypeError:
            return False
        return True

    def encode(self, value: T) -> bytes:
        """Turn a value into bytes.

        It may also be a ROS message, or contain some, and arrays of numpy or of `array`.

        Raises:
            TypeError: It contains an object that msgpack cannot express, or a ROS message of
                another type.
            OverflowError: It contains an integer of more than 64 bits; the text says where.
            ValueError: It contains text that is not valid Unicode; the text says where.
            RecursionError: It contains itself.
        """
        try:
            try:
                return self._encode(value)
            except (TypeError, ValueError):
                from fibaction.types.ros_messages import encoded

                payload = encoded(value, self.type, self._messages, self._encoding)
                if payload is None:
                    raise
                return payload
        except (OverflowError, UnicodeEncodeError) as exc:
            from fibaction.types.unsendable import unsendable

            kind = OverflowError if isinstance(exc, OverflowError) else ValueError
            raise kind(unsendable(value, exc)) from None

    def decode(self, payload: bytes) -> T:
        """Turn bytes into a value; only pydantic models convert from one type to another.

        Raises:
            ProtocolError: They are not a value of this type; the text names the field.
        """
        try:
            if len(payload) <= LARGE:
                return self._decode(payload)
            with collector_paused():
                return self._decode(payload)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, TypeError) as exc:
            # msgspec raises TypeError for a set of unhashable values.
            text = excerpt(str(exc))
        except FAILURES as exc:  # of the type's own, for instance in its `__post_init__`
            raise self._misread(text_of(exc)) from exc
        if (goal := self._goal_of_nothing(payload)) is not NO_VALUE:
            return goal
        # Raised here, so that it does not keep msgspec's error, which may hold the whole payload.
        raise self._misread(text)

    def _goal_of_nothing(self, payload: bytes) -> T:
        """Return the goal that a payload of `NOTHING` stands for; NO_VALUE if it is none."""
        if self._is_goal and payload in NOTHING:
            with suppress(Exception):  # any, of the type's own
                return self._decode(NOTHING[payload])
        return cast("T", NO_VALUE)

    def _misread(self, text: str) -> ProtocolError:
        # Without the sender, the reader of the text would look for the fault in the client's code.
        if self._sent:
            text = f"{self._sent} is not of its type, as its server sent it: {text}"
        return ProtocolError(text)

    def schema(self) -> dict[str, Any]:
        """Return the type's JSON Schema.

        It is empty, which allows any value, if there is none for the type.
        """
        schema = self._encoding.schema()
        return schema | WITHOUT_FIELDS if self._is_goal and schema.get("type") == "null" else schema


class ActionInfo(msgspec.Struct, frozen=True):
    """The description of an action without its Python types, for generic clients and gateways."""

    name: str
    type_name: str = ""
    goal: dict[str, Any] = {}
    """The JSON Schema of a goal; feedback and result likewise."""
    feedback: dict[str, Any] = {}
    result: dict[str, Any] = {}

    @property
    def description(self) -> str:
        """The purpose of the action, in the words of its author: the description of the goal,
        which is the docstring of its type; empty if it has none.
        """
        root: Any = self.goal  # a peer may send anything
        definitions = root.get("$defs") if is_map(root) else None
        name = str(root.get("$ref", "")).removeprefix("#/$defs/") if is_map(definitions) else ""
        target = definitions.get(name) if is_map(definitions) else None
        texts = (part.get("description") for part in (root, target) if is_map(part))
        return next((text for text in texts if isinstance(text, str)), "")


class Action(Generic[GoalT, FeedbackT, ResultT]):
    """A name, and the types of the goal, the feedback and the result.

    Each type is one that msgspec can encode and decode strictly: a `msgspec.Struct`, a dataclass,
    an attrs class, a `TypedDict`, a builtin. It may also be a pydantic model, or contain models,
    which validate by their own rules. If feedback and result have one type, an executor that yields
    both marks the result with `Return`.

    For example:

        DRIVE = Action("drive", goal=float, feedback=int, result=str)
    """

    description = ""
    """The docstring of the function that it is made of; empty for any other."""
    parameters: frozenset[str] = frozenset()
    """The names of the parameters of the function that it is made of; empty for any other."""

    def __init__(
        self,
        name: str,
        *,
        goal: TypeForm[GoalT],
        feedback: TypeForm[FeedbackT],
        result: TypeForm[ResultT],
        checkpoint: TypeForm[Any] | None = None,
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
            TypeError: One of them is not text, or a type cannot be encoded.
        """
        self.name = _checked(_NAME, name, "an action's name is like `arm/pick_up`")
        self.type_name = type_name
        if type_name != "":
            _checked(
                _TYPE_NAME, type_name, "a type name is like `example_interfaces/action/Fibonacci`"
            )
        of_it = f"of action {name!r}"
        goal_type, feedback_type, result_type = (
            f"{type_name}_{part}" if type_name else "" for part in ("Goal", "Feedback", "Result")
        )
        self.goal: Codec[GoalT] = _codec(goal, f"the goal {of_it}", goal_type, is_goal=True)
        self.feedback: Codec[FeedbackT] = _codec(feedback, f"feedback {of_it}", feedback_type)
        self.result: Codec[ResultT] = _codec(result, f"the result {of_it}", result_type)
        self.checkpoint: Codec[Any] | None = None
        if checkpoint is not None:
            self.checkpoint = _codec(checkpoint, f"the checkpoint {of_it}")
        self._info: ActionInfo | None = None
        self.is_ambiguous = any(
            issubclass(one, other) or issubclass(other, one)
            for one in self.feedback.classes
            for other in self.result.classes
        )
        """True if a value may be of the type of the feedback and of the result. Then a generator
        marks its result with `Return`."""

    def goal_from(self, args: tuple[Any, ...], fields: Mapping[str, Any]) -> GoalT:
        """Return the goal that a caller gives, as one argument; `NO_VALUE` if there is none.

        Raises:
            TypeError: There are several arguments, or some that have names.
        """
        if fields or len(args) > 1:
            wrong = f"{min(fields)!r} is no option of the call" if fields else "there are several"
            raise TypeError(
                f"the goal of the action {self.name!r} is one value, and is given as one argument:"
                f" {wrong}"
            )
        return args[0] if args else cast("GoalT", NO_VALUE)

    def default_goal(self) -> bytes:
        """Return the bytes of the goal of a client that gives none: None, or a goal whose fields
        all have defaults.

        Raises:
            TypeError: The action needs a goal.
        """
        if object in self.goal.classes:
            return NIL if self.info.goal.get("type") == "null" else EMPTY_MAP
        if self.goal.holds(None):
            return NIL
        try:
            return self.goal.encode(self.goal.decode(EMPTY_MAP))
        except ProtocolError:
            raise TypeError(f"the action {self.name!r} needs a goal, and none was given") from None

    @property
    def info(self) -> ActionInfo:
        """The description that is sent to clients: name, type name and JSON Schemas."""
        if self._info is None:
            goal, *answers = (one.schema() for one in (self.goal, self.feedback, self.result))
            if self.description:
                goal = goal | {"description": self.description}
            self._info = ActionInfo(self.name, self.type_name, goal, *answers)
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
        action.is_ambiguous = True
        return action

    @classmethod
    def from_ros(
        cls, type_name: str, *, name: str, classes: Literal["structs", "ros"] = "structs"
    ) -> Action[Any, Any, Any]:
        """Make an action whose types are those of an installed ROS 2 type.

        They are structs with ROS's fields, defaults and constants: `action.goal.type(order=3)`.
        With `classes="ros"` they are the classes of ROS itself, such as `Fibonacci.Goal`, so that
        executors and clients get ROS messages. Without ROS, structs are made from its interface
        file.

        Raises:
            TransportError: The type cannot be imported; the text says what is missing.
            ValueError: The name breaks the rule for names, or `classes` is neither of the two.
        """
        if classes not in ("structs", "ros"):
            raise ValueError(f"classes must be 'structs' or 'ros', not {classes!r}")
        made = load("ros2" if classes == "structs" else "ros2_classes", type_name)
        goal, feedback, result = made(type_name)
        return cls(name, goal=goal, feedback=feedback, result=result, type_name=type_name)

    def __repr__(self) -> str:
        return f"<Action {self.name!r}>"


def _codec(
    message_type: TypeForm[T], message: str, ros_type: str = "", *, is_goal: bool = False
) -> Codec[T]:
    """Return the codec of a message of an action.

    Raises:
        TypeError: Its type cannot be encoded; the text names the message.
    """
    try:
        sent = message if message.startswith(_FROM_SERVERS) else ""
        return Codec(message_type, sent, ros_type, is_goal=is_goal)
    except TypeError as exc:
        raise TypeError(f"{message}: {exc}") from exc


def _checked(rule: re.Pattern[str], text: object, meaning: str) -> str:
    if not isinstance(text, str):
        raise TypeError(f"{meaning}, not {text!r}")
    if not rule.fullmatch(text):
        raise ValueError(f"{meaning}, not {text!r}")
    return text


@contextmanager
def collector_paused() -> Generator[None, None, None]:
    """Keep the garbage collector from looking at all objects while one call makes very many.

    It would do so several times, which takes longer than the call itself, and finds nothing.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
