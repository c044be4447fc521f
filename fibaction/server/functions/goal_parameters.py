"""`GoalParameters`: the goal of a function, made of its parameters."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import field, make_dataclass
from functools import partial
from inspect import Parameter, Signature
from pathlib import PurePath
from typing import Annotated, Any, cast, get_args, get_origin

import msgspec

from fibaction.types.action import EMPTY_MAP, Codec
from fibaction.types.encodings import has_pydantic
from fibaction.words.errors import ProtocolError


class GoalParameters:
    """The parameters of a function that are the goal: each a field of it, or one that is all of it.

    A single parameter whose type has fields itself, such as a struct, a dataclass or a model, is
    the goal itself.
    """

    def __init__(self, function: str, parameters: Sequence[Parameter], *, is_whole: bool) -> None:
        """Make the goal's type; `is_whole` says that the one parameter is the goal in any case.

        Raises:
            TypeError: The parameters cannot be fields of a goal.
        """
        self._function = function
        self._signature = Signature(parameters)
        self.is_whole = is_whole or (len(parameters) == 1 and _has_fields(parameters[0].annotation))
        """True if the one parameter is the goal itself."""
        self._can_be_called = not self.is_whole and all(
            one.kind is Parameter.POSITIONAL_OR_KEYWORD for one in parameters
        )
        self.names = [one.name for one in parameters]
        """The names of the parameters."""
        for one in parameters:
            self._check_default(one)
        self.type: Any = parameters[0].annotation if self.is_whole else self._made(parameters)
        """The type of the goal."""

    def goal_of(self, args: tuple[Any, ...], fields: Mapping[str, Any]) -> Any:
        """Return the goal that calls the function with these arguments.

        Raises:
            TypeError: They do not fit the parameters.
        """
        if self._can_be_called:  # which is fast; the signature tells what is wrong
            try:
                return self.type(*args, **fields)
            except TypeError:
                pass
        try:
            bound = self._signature.bind(*args, **fields)
        except TypeError as exc:
            raise TypeError(f"{self._function}{self._signature}: {exc}") from None
        if not self.is_whole:
            return self.type(**bound.arguments)
        bound.apply_defaults()
        return bound.arguments[self.names[0]]

    def arguments(self, goal: Any) -> dict[str, Any]:
        """Return the arguments with which a goal calls the function."""
        if self.is_whole:
            return {self.names[0]: goal}
        return {name: getattr(goal, name) for name in self.names}

    def _check_default(self, parameter: Parameter) -> None:
        default, name = parameter.default, parameter.name
        if default is Parameter.empty:
            return
        if type(default).__name__ in ("Field", "FieldInfo"):
            raise TypeError(
                f"the default of {name!r} is a field of a class, and a function has the value"
                f" itself: write `{name}: Annotated[int, Field(ge=1)] = 5`"
            )
        codec = Codec(parameter.annotation)
        try:
            codec.decode(codec.encode(default))
            fits = codec.holds(default)
        except Exception:  # a type may run code of its own
            fits = False
        if not fits:
            raise TypeError(f"the default of {name!r}, {default!r}, is not {codec.type_text}")
        if self.is_whole and default is not None and default != _without_fields(codec):
            raise TypeError(
                f"{name!r} is the goal itself, and has a default: give defaults to its fields"
            )

    def _made(self, parameters: Sequence[Parameter]) -> Any:
        name = "".join(part.title() for part in self._function.split("_")) + "Goal"
        if "pydantic" in sys.modules and any(_is_of_pydantic(one.annotation) for one in parameters):
            return make_dataclass(name, _fields(parameters, _pydantic_mark, field), kw_only=True)
        is_ordered = all(one.kind is not Parameter.KEYWORD_ONLY for one in parameters)
        fields = _fields(parameters, None, msgspec.field)
        return msgspec.defstruct(name, fields, kw_only=not is_ordered)


def _has_fields(kind: Any) -> bool:
    """Return whether each value of a type is a map of fields with names."""
    try:
        schema = Codec(kind).schema()
    except TypeError:
        return False  # the check of the whole goal tells what is wrong
    definitions: dict[str, dict[str, Any]] = schema.get("$defs", {})

    def has_fields(part: dict[str, Any]) -> bool:
        if "$ref" in part:
            part = definitions[part["$ref"].rpartition("/")[2]]
        several: list[dict[str, Any]] = part.get("anyOf") or part.get("oneOf") or []
        return "properties" in part or (bool(several) and all(map(has_fields, several)))

    return has_fields(schema)


def _without_fields(codec: Codec[Any]) -> Any:
    """Return the goal of a client that gives no fields; None if it needs some."""
    try:
        return codec.decode(EMPTY_MAP)
    except ProtocolError:
        return None


def _is_of_pydantic(annotation: Any) -> bool:
    """Return whether a type has a model in it, or a mark of pydantic."""
    marks = get_args(annotation)[1:] if get_origin(annotation) is Annotated else ()
    return has_pydantic(annotation) or any(
        type(mark).__module__.startswith("pydantic") for mark in marks
    )


def _fields(parameters: Sequence[Parameter], mark_of: Any, field_of: Any) -> list[Any]:
    """Return the fields of a goal, as one of `msgspec` or of `dataclasses` for each default."""
    fields: list[Any] = []
    for one in parameters:
        kind = _described(one.annotation, mark_of)
        if one.default is Parameter.empty:
            fields.append((one.name, kind))
        elif _is_shared(one.default):
            fields.append((one.name, kind, field_of(default=one.default)))
        else:
            make: Callable[[], Any] = partial(deepcopy, one.default)
            if one.default in ([], {}):  # which a schema has as the default of these two functions
                make = cast("Callable[[], Any]", type(one.default))
            fields.append((one.name, kind, field_of(default_factory=make)))
    return fields


def _is_shared(default: Any) -> bool:
    """Return whether all goals may have one object as their default: what cannot be changed."""
    try:
        hash(default)
    except TypeError:
        return False
    return not isinstance(default, PurePath)  # of which msgspec has no schema


_MARKS = (
    *("gt", "ge", "lt", "le", "multiple_of", "pattern", "min_length", "max_length"),
    *("title", "description", "examples"),
)
"""The settings that a `msgspec.Meta` and a `pydantic.Field` have by the same name."""


def _pydantic_mark(meta: msgspec.Meta) -> Any:
    """Return the mark of pydantic that says the same."""
    from pydantic import Field

    said = {name: value for name in _MARKS if (value := getattr(meta, name)) is not None}
    return Field(**said, json_schema_extra=meta.extra_json_schema)


def _described(annotation: Any, mark_of: Callable[[msgspec.Meta], Any] | None) -> Any:
    """Return a type whose descriptions, texts in `Annotated`, are marks that its encoding reads;
    `mark_of` makes these of the marks of msgspec.

    PEP 727 has such a text in an object.
    """
    if get_origin(annotation) is not Annotated:
        return annotation
    kind, *marks = get_args(annotation)
    texts = [getattr(mark, "documentation", mark) for mark in marks]
    made = [
        msgspec.Meta(description=text) if isinstance(text, str) else mark
        for mark, text in zip(marks, texts, strict=True)
    ]
    if mark_of is not None:
        made = [mark_of(mark) if isinstance(mark, msgspec.Meta) else mark for mark in made]
    return cast("Any", Annotated)[(kind, *made)]
