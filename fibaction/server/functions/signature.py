"""`FunctionSignature`: the types of an action, read from the signature of a plain function."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from inspect import Parameter
from typing import Any, NoReturn, get_args, get_origin, get_type_hints

import msgspec

from fibaction.server.functions.report import Report
from fibaction.server.goal_handle import GoalHandle

NO_FIELDS = (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)


class GoalFields(msgspec.Struct, kw_only=True):
    """The goal of a function of several parameters, each of which is a field.

    `FunctionAction.goal_of` makes one.
    """


class FunctionSignature:
    """The parameters of a function, and the types of the goal, the feedback and the result."""

    def __init__(self, function: Callable[..., Any]) -> None:
        """Read the signature.

        Raises:
            TypeError: It is not that of an executor; the text is one sentence.
        """
        self._name: str = getattr(function, "__name__", type(function).__name__)
        self._check_kind(function)
        parameters = inspect.signature(function).parameters
        hints = self._hints_of(function)
        self.report = ""
        """The name of the parameter that is the report; empty if there is none."""
        self._handle = ""
        self.feedback: Any = type(None)
        """The type of the feedback; that of None without a `Report`."""
        if "return" not in hints:
            self._fail("has no type for what it returns: write `-> str`, or `-> None`")
        self.result: Any = hints["return"]
        """The type of the result."""
        self._fields: dict[str, Parameter] = {}
        request: Any = None
        for name, parameter in parameters.items():
            hint = self._hint_of(name, parameter, hints)
            origin = get_origin(hint) or hint
            if origin is Report:
                self._take_once(name, self.report, "a Report")
                if not get_args(hint):
                    what = f"has no type of feedback for {name!r}: write `{name}: Report[int]`"
                    self._fail(what)
                self.report, (self.feedback,) = name, get_args(hint)
            elif origin is GoalHandle:
                self._take_once(name, self._handle, "a GoalHandle")
                self._handle, request = name, (get_args(hint) or (None,))[0]
            else:
                self._fields[name] = parameter.replace(annotation=hint)
        self.goal: Any = self._goal_of(request)
        """The type of the goal."""
        self._positional = [
            name for name, one in parameters.items() if one.kind is Parameter.POSITIONAL_ONLY
        ]
        self._bound = inspect.Signature(list(self._fields.values()))

    def arguments(
        self, request: Any, handle: GoalHandle[Any], report: Report[Any]
    ) -> tuple[list[Any], dict[str, Any]]:
        """Return the arguments with which the function is called for a goal."""
        names = self._fields
        if len(names) == 1:
            given = dict.fromkeys(names, request)
        else:
            given = {name: getattr(request, name) for name in names}
        if self.report:
            given[self.report] = report
        if self._handle:
            given[self._handle] = handle
        return [given.pop(name) for name in self._positional], given

    def goal_of(self, *args: Any, **kwargs: Any) -> Any:
        """Return the goal that calls the function with these arguments.

        Raises:
            TypeError: They do not fit the parameters.
        """
        bound = self._bound.bind(*args, **kwargs)
        if len(self._fields) > 1:
            return self.goal(**bound.arguments)
        bound.apply_defaults()
        return next(iter(bound.arguments.values()), None)

    def _check_kind(self, function: Callable[..., Any]) -> None:
        called: Any = getattr(function, "__call__", None)  # noqa: B004  # of an object with the method
        for one in (function, called):
            if inspect.isasyncgenfunction(one) or inspect.isgeneratorfunction(one):
                self._fail(
                    "is a generator function, and @action is for functions that report and return:"
                    " give a generator to ActionServer(action, executor)"
                )

    def _hints_of(self, function: Callable[..., Any]) -> dict[str, Any]:
        read: Any = function if hasattr(function, "__annotations__") else type(function).__call__
        try:
            return get_type_hints(read, include_extras=True)
        except NameError as exc:
            self._fail(f"has a type that its module does not define: {exc}", exc)

    def _hint_of(self, name: str, parameter: Parameter, hints: dict[str, Any]) -> Any:
        if parameter.kind in NO_FIELDS:
            self._fail(f"takes {parameter}, and the fields of a goal have names")
        if name in hints:
            return hints[name]
        if name == "report":
            self._fail("has no type for `report`: write `report: Report[int]`")
        self._fail(f"has no type for its parameter {name!r}: write `{name}: int`")

    def _take_once(self, name: str, before: str, what: str) -> None:
        if before:
            self._fail(f"has {what} twice, {before!r} and {name!r}")

    def _goal_of(self, request: Any) -> Any:
        if not self._fields:
            if self._handle and request is None:
                self._fail(f"has no type for its goal: write `{self._handle}: GoalHandle[int]`")
            return type(None) if request is None else request
        if len(self._fields) == 1:
            return next(iter(self._fields.values())).annotation
        name = "".join(part.title() for part in self._name.split("_")) + "Goal"
        try:
            return msgspec.defstruct(
                name, list(self._struct_fields()), bases=(GoalFields,), kw_only=True
            )
        except TypeError as exc:
            self._fail(f"cannot have its parameters as fields of a goal: {exc}", exc)

    def _struct_fields(self) -> Iterator[tuple[str, Any] | tuple[str, Any, Any]]:
        for name, field in self._fields.items():
            if field.default is Parameter.empty:
                yield name, field.annotation
            else:
                yield name, field.annotation, field.default

    def _fail(self, what: str, cause: Exception | None = None) -> NoReturn:
        raise TypeError(f"{self._name}() {what}") from cause
