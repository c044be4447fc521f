"""JSON data to the payloads of an action and back, by the action's JSON Schemas.

With it, a program that has no Python types of an action can send goals that come from a form, a
file or another protocol. For example, with the description that a server sends of an action:

    from fibaction.schema.payload import GoalCodec

    goals = GoalCodec(info.goal)
    payload = goals.encode({"order": 3})  # defaults are filled in

The data is compared with the schema and completed with its defaults in one pass, and the result is
encoded as msgpack. The types of the action's server check the goal once more.

The schema and the data may be hostile: nothing is fetched, no regular expression of a schema is
run, data nests to 100 levels at most, and the length of errors and the work are limited: to 20,000
steps and 50 more for each value, see `check`. Who takes documents of strangers works on large ones
in a thread: see `turns`.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, TypeAlias

import msgspec

from fibaction.schema.check import (
    MAX_DEPTH,
    MAX_MISMATCHES,
    MAX_PARTS,
    Check,
    EnoughMismatches,
    Extent,
    JsonSchema,
    Path,
    SchemaError,
)
from fibaction.schema.mismatch_texts import field_name, sentences
from fibaction.schema.parts import SchemaPart, SchemaParts
from fibaction.types.unsendable import unsendable

__all__ = [
    "MAX_PARTS",
    "GoalCodec",
    "JsonCodec",
    "JsonSchema",
    "PayloadError",
    "SchemaError",
    "to_json",
]

MAX_PROBLEMS = 5
"""Problems of one message that the text of an error names; later ones often follow from them."""

Pause: TypeAlias = Callable[[], None]


class PayloadError(ValueError):
    """An error for data that is not a message of the expected type.

    The text is one sentence, which names the fields: `goal.order must be a whole number, not "x"`.
    """

    def __init__(self, *problems: str) -> None:
        more = len(problems) - MAX_PROBLEMS
        shown = [*problems[:MAX_PROBLEMS], *([f"and {more} more"] if more > 0 else [])]
        super().__init__("; ".join(shown))
        self.problems = problems
        """The problems, one sentence each: all of them, or the first hundred or so."""


class JsonCodec:
    """A converter between JSON data and the payloads of one message type.

    In JSON data, bytes are base64 text, and times and durations are ISO 8601 text. Data that is to
    be sent may have a list of numbers from 0 to 255 in place of base64 text.
    """

    def __init__(self, schema: Mapping[str, Any], name: str = "goal") -> None:
        """Make a codec from a JSON Schema of `ActionInfo`. An empty schema allows any data.

        The schema must not be changed later. `name` is what errors call the message.

        Raises:
            PayloadError: The schema is malformed, too large, or refers to something outside of it.
        """
        self._name = name
        with self._errors():
            self._root = None if schema == {} else SchemaParts(JsonSchema(schema)).root

    def complete(self, data: Any, pause: Pause | None = None) -> Any:
        """Return the message as plain data that can be sent, for example by an untyped client.

        Fields that are missing get their defaults, base64 text becomes bytes where the schema asks
        for bytes, and 3.0 becomes 3 where it asks for a whole number. `data` stays as it is; it may
        hold bytes already. In a thread, `pause` is called about once in a millisecond of the check.

        Raises:
            PayloadError: The data does not match the schema, has a field that it does not name, or
                nests deeper than 100 levels; or msgpack cannot express it; or the schema is so
                complex that the check takes too long.
        """
        if self._root is None:
            self.encode(data)
            return data
        return msgspec.msgpack.decode(self.encode(data, pause=pause))

    def left_out(self, message: Any) -> list[str]:
        """Return the names of the fields that a message of `complete` leaves to the server: those
        that may be missing, and whose defaults only the server knows. At most a hundred.

        Raises:
            PayloadError: The schema is so complex that the search takes too long.
        """
        if self._root is None:
            return []
        paths: list[Path] = []
        with self._errors(), suppress(EnoughMismatches):
            check = Check(Extent.of(message).size, fills=False)
            check.left_out = paths
            self._root.visit(check, message)
        return [field_name("", path).removeprefix(".") for path in paths[:MAX_MISMATCHES]]

    def encode(self, data: Any, *, is_json: bool = False, pause: Pause | None = None) -> bytes:
        """Return the payload of a message; see `complete`.

        With `is_json`, the data has just been read from JSON, and takes no preparation.

        Raises:
            PayloadError: As `complete`.
        """
        with self._errors(data):
            if self._root is not None:
                if not is_json:  # without tuples and sets, and without parts that are the same
                    data = msgspec.to_builtins(data, builtin_types=(bytes, datetime.datetime))
                data = self._checked(data, self._root, pause)
            return msgspec.msgpack.encode(data)

    def check(self, message: Any, pause: Pause | None = None) -> None:
        """Compare a message that was read from msgpack with the schema; `pause` as in `complete`.

        Raises:
            PayloadError: As `complete`.
        """
        with self._errors():
            if self._root is not None:
                self._checked(message, self._root, pause)

    def decode(self, payload: bytes) -> Any:
        """Return the message in a payload as JSON data; see `to_json`.

        Raises:
            PayloadError: The payload is not msgpack, or JSON cannot express what it holds.
        """
        return msgspec.json.decode(self.to_text(payload))

    def to_text(self, payload: bytes) -> str:
        """Return the message in a payload as JSON text on one line; see `to_json`.

        Raises:
            PayloadError: As `decode`.
        """
        try:
            message = msgspec.msgpack.decode(payload)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, TypeError) as exc:
            raise PayloadError(f"the {self._name} is not a valid payload: {exc}") from exc
        return to_json(message)

    @contextmanager
    def _errors(self, data: Any = None) -> Generator[None, None, None]:
        try:
            yield
        except PayloadError:
            raise
        except SchemaError as exc:
            raise PayloadError(f"the schema of the {self._name} {exc}") from exc
        except (OverflowError, UnicodeEncodeError) as exc:
            text = unsendable(data, exc, self._name)
            raise PayloadError(f"the {self._name} cannot be encoded: {text}") from exc
        except (TypeError, ValueError, RecursionError) as exc:
            raise PayloadError(f"the {self._name} cannot be encoded: {exc}") from exc

    def _checked(self, data: Any, root: SchemaPart, pause: Pause | None) -> Any:
        extent = Extent.of(data)
        if extent.levels > MAX_DEPTH:
            raise PayloadError(f"the {self._name} nests deeper than {MAX_DEPTH} levels")
        check, made = Check(extent.size, pause), data
        try:
            made = root.visit(check, data)
        except EnoughMismatches:
            pass
        except SchemaError:
            if not check.found:
                raise
        if not check.found:
            return made
        # Each missing field is a mismatch, whose sentences name all of them.
        problems = (text for one in check.found for text in sentences(one, self._name))
        raise PayloadError(*dict.fromkeys(problems))


class GoalCodec(JsonCodec):
    """A converter of goals, in which no goal is `{}`.

    So an action that needs no goal is called without one in the same way everywhere: a request
    without a body, a call without arguments, an empty text. `{}` is null for a goal that may be
    null and is not an object, and null is `{}` for one that is an object.
    """

    @property
    def needs_goal(self) -> bool:
        """True if `{}` is not a goal."""
        try:
            self.encode({})
        except PayloadError:
            return True
        return False

    def _checked(self, data: Any, root: SchemaPart, pause: Pause | None) -> Any:
        try:
            return super()._checked(data, root, pause)
        except PayloadError:
            if data is None or data == {}:
                with suppress(PayloadError):
                    return super()._checked({} if data is None else None, root, pause)
            raise


def to_json(value: Any) -> str:
    """Return plain data, as an untyped client receives it, as JSON text on one line.

    Bytes become base64 text, times ISO 8601 text, NaN and infinities null, and an extension of
    msgpack a map of its code and its data.

    Raises:
        PayloadError: JSON cannot express the value.
    """
    try:
        return msgspec.json.encode(value, enc_hook=_without_extension).decode()
    except (TypeError, ValueError, RecursionError) as exc:
        raise PayloadError(f"the value cannot be written as JSON: {exc}") from exc


def _without_extension(value: Any) -> Any:
    if isinstance(value, msgspec.msgpack.Ext):
        return {"ext": value.code, "data": value.data}
    raise TypeError(f"JSON has no {type(value).__name__}")
