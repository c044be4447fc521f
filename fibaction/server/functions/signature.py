"""`FunctionSignature`: the types of an action, read from the signature of a plain function.

`GoalParameters` makes the goal of the function's parameters.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import field, make_dataclass
from functools import partial
from inspect import Parameter, Signature
from pathlib import PurePath
from types import SimpleNamespace
from typing import Annotated, Any, NoReturn, cast, get_args, get_origin, get_type_hints

import msgspec

from fibaction.server.functions.report import Report
from fibaction.server.goal_handle import GoalHandle
from fibaction.types.action import EMPTY_MAP, Codec
from fibaction.types.encodings import has_pydantic
from fibaction.words.errors import ProtocolError

NO_FIELDS = (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)


class FunctionSignature:
    """The parameters of a function, and the types of the goal, the feedback and the result."""

    def __init__(
        self, function: Callable[..., Any], names: Mapping[str, Any] | None = None
    ) -> None:
        """Read the signature; `names` are those of the block that the function is defined in.

        Raises:
            TypeError: It is not that of an executor; the text is one sentence.
        """
        self.name = name_of(function)
        """The name of the function."""
        self._check_kind(function)
        parameters = _parameters_of(function)
        self.is_method = _is_method(function, parameters)
        """True if the first parameter is the object that the function is a method of."""
        if self.is_method:
            first = next(iter(parameters))
            if first == "cls":
                self._fail("is a classmethod: an action is a method of an object, or a function")
            del parameters[first]
        hints = self._hints_of(function, parameters, names)
        if "return" not in hints:
            self._fail("has no type for what it returns: write `-> str`, or `-> None`")
        self.result: Any = hints["return"]
        """The type of the result."""
        self.report = ""
        """The name of the parameter that is the report; empty if there is none."""
        self.feedback: Any = type(None)
        """The type of the feedback; that of None without a `Report`."""
        self._handle = ""
        request: Any = None
        fields: list[Parameter] = []
        for name, parameter in parameters.items():
            hint = self._hint_of(name, parameter, hints)
            plain = get_args(hint)[0] if get_origin(hint) is Annotated else hint
            origin = get_origin(plain) or plain
            if origin is Report:
                self._take_once(name, self.report, "a Report")
                if not get_args(plain):
                    what = f"has no type of feedback for {name!r}: write `{name}: Report[int]`"
                    self._fail(what)
                self.report, (self.feedback,) = name, get_args(plain)
            elif origin is GoalHandle:
                self._take_once(name, self._handle, "a GoalHandle")
                self._handle, request = name, (get_args(plain) or (None,))[0]
            else:
                self._check_is_field(name, hint)
                fields.append(parameter.replace(annotation=hint))
        self.goal = self._goal_of(fields, request)
        """The parameters that are the goal."""
        self.fields = [one.name for one in fields]
        """The names of the parameters that a client gives."""
        self._positional = [
            name for name, one in parameters.items() if one.kind is Parameter.POSITIONAL_ONLY
        ]

    def arguments(
        self, request: Any, handle: GoalHandle[Any], report: Report[Any]
    ) -> tuple[Sequence[Any], dict[str, Any]]:
        """Return the arguments with which the function is called for a goal."""
        given = self.goal.arguments(request) if self.fields else {}
        if self.report:
            given[self.report] = report
        if self._handle:
            given[self._handle] = handle
        if not self._positional:
            return (), given
        return [given.pop(name) for name in self._positional], given

    def _check_kind(self, function: Callable[..., Any]) -> None:
        if inspect.isclass(function):
            self._fail("is a class: write @action above its methods")
        if isinstance(function, staticmethod):
            self._fail("is a staticmethod: write @action below @staticmethod, next to the function")
        if isinstance(function, classmethod):
            self._fail("is a classmethod: an action is a method of an object, or a function")
        called: Any = getattr(function, "__call__", None)  # noqa: B004  # of an object with the method
        for one in (function, called):
            if inspect.isasyncgenfunction(one) or inspect.isgeneratorfunction(one):
                self._fail(
                    "is a generator function, and @action is for functions that report and return:"
                    " give a generator to ActionServer(action, executor)"
                )

    def _hints_of(
        self,
        function: Callable[..., Any],
        parameters: Mapping[str, Parameter],
        names: Mapping[str, Any] | None,
    ) -> dict[str, Any]:
        read: Any = innermost(function)
        if not hasattr(read, "__annotations__"):
            read = type(read).__call__
        module: dict[str, Any] = getattr(inspect.unwrap(read), "__globals__", {})
        given = inspect.get_annotations(read)
        wanted = {name: given[name] for name in (*parameters, "return") if name in given}
        try:
            return get_type_hints(
                SimpleNamespace(__annotations__=wanted), module, dict(names or {}), True
            )
        except NameError as exc:
            self._fail(f"has a type that is not defined here: {exc}", exc)
        except Exception as exc:  # evaluating a type runs whatever it says
            self._fail(f"has a type that cannot be read: {exc}", exc)

    def _hint_of(self, name: str, parameter: Parameter, hints: dict[str, Any]) -> Any:
        if parameter.kind in NO_FIELDS:
            self._fail(f"takes {parameter}, and the fields of a goal have names")
        if name in hints:
            return hints[name]
        if name == "report":
            self._fail("has no type for `report`: write `report: Report[int]`")
        self._fail(f"has no type for its parameter {name!r}: write `{name}: int`")

    def _check_is_field(self, name: str, hint: Any) -> None:
        if any((get_origin(part) or part) is Report for part in get_args(hint)):
            self._fail(f"may be called without {name!r}: a server always gives it a `Report[int]`")
        if name.startswith("__"):
            self._fail(
                f"has the parameter {name!r}, and a field does not begin with two underscores"
            )
        if (get_origin(hint) or hint) is Callable:
            self._fail(
                f"takes a function as {name!r}, and a goal is data: write `{name}: Report[int]` for"
                f" what sends feedback"
            )

    def _take_once(self, name: str, before: str, what: str) -> None:
        if before:
            self._fail(f"has {what} twice, {before!r} and {name!r}")

    def _goal_of(self, fields: list[Parameter], request: Any) -> GoalParameters:
        is_whole = not fields and bool(self._handle)
        if is_whole:
            if request is None:
                self._fail(f"has no type for its goal: write `{self._handle}: GoalHandle[int]`")
            default = None if request is type(None) else Parameter.empty
            fields = [
                Parameter("goal", Parameter.POSITIONAL_ONLY, annotation=request, default=default)
            ]
        try:
            goal = GoalParameters(self.name, fields, is_whole=is_whole)
        except TypeError as exc:
            self._fail(f"cannot have its parameters as fields of a goal: {exc}", exc)
        if request not in (None, object, Any, goal.type):
            self._fail(
                f"has its goal in the other parameters, and not in {self._handle!r}: write"
                f" `{self._handle}: GoalHandle[object]`"
            )
        return goal

    def _fail(self, what: str, cause: Exception | None = None) -> NoReturn:
        raise TypeError(f"{self.name}() {what}") from cause


def name_of(function: Callable[..., Any]) -> str:
    """Return the name of a function, or of the class of an object that can be called."""
    read = innermost(function)
    name: str = getattr(read, "__name__", type(read).__name__)
    return name


def innermost(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function that a `functools.partial` is made of; any other as it is."""
    while isinstance(function, partial):
        function = function.func
    return function


def is_async(function: Callable[..., Any]) -> bool:
    """Return whether a call of a function is to be awaited, also behind a wrapper of it."""
    read = inspect.unwrap(innermost(function))
    return inspect.iscoroutinefunction(read) or inspect.iscoroutinefunction(type(read).__call__)


def _parameters_of(function: Callable[..., Any]) -> dict[str, Parameter]:
    """Return the parameters that a caller of a function gives."""
    parameters = dict(inspect.signature(function).parameters)
    while isinstance(function, partial):
        for name in function.keywords:  # these are given already, and could be given again
            parameters.pop(name, None)
        function = function.func
    return parameters


def _is_method(function: Callable[..., Any], parameters: Mapping[str, Parameter]) -> bool:
    """Return whether a function is one of the methods of a class that is being defined."""
    if not inspect.isfunction(function) or not parameters:
        return False
    place = function.__qualname__.rpartition(".")[0]
    if not place or place.endswith("<locals>"):
        return False
    first = next(iter(parameters.values()))
    return first.name == "self" or first.annotation is Parameter.empty


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
