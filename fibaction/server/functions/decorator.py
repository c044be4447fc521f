"""`action`: the decorator that makes an action of a plain function."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any, TypeAlias, TypeVar, TypeVarTuple, overload

from fibaction.server.functions.function_action import FunctionAction
from fibaction.server.functions.report import Report
from fibaction.server.functions.signature import GoalFields
from fibaction.server.goal_handle import GoalHandle
from fibaction.types.action import FeedbackT, GoalT, ResultT

OneT = TypeVar("OneT")
OtherT = TypeVar("OtherT")
MoreTs = TypeVarTuple("MoreTs")

Async: TypeAlias = Coroutine[Any, Any, ResultT]
"""The value of a call of an async function."""


class ActionDecorator:
    """Makes an action of a function; `action` returns it."""

    def __init__(self, name: str, checkpoint: type[Any] | None, type_name: str) -> None:
        self._name = name
        self._checkpoint = checkpoint
        self._type_name = type_name

    # For type checkers. An order from the special to the general: a parameter of any type may be a
    # report or a handle, and what an async function returns may be the result of another one. That
    # is the overlap which mypy would report; the first that fits is the right one.

    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[GoalHandle[GoalT], Report[FeedbackT]], Async[ResultT]]
    ) -> FunctionAction[GoalT, FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[GoalT, GoalHandle[Any], Report[FeedbackT]], Async[ResultT]]
    ) -> FunctionAction[GoalT, FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[OneT, OtherT, *MoreTs, Report[FeedbackT]], Async[ResultT]]
    ) -> FunctionAction[GoalFields, FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[GoalT, Report[FeedbackT]], Async[ResultT]]
    ) -> FunctionAction[GoalT, FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[Report[FeedbackT]], Async[ResultT]]
    ) -> FunctionAction[None, FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(
        self, function: Callable[[GoalHandle[GoalT]], Async[ResultT]]
    ) -> FunctionAction[GoalT, None, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[GoalT, GoalHandle[Any]], Async[ResultT]]
    ) -> FunctionAction[GoalT, None, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(
        self, function: Callable[[OneT, OtherT, *MoreTs], Async[ResultT]]
    ) -> FunctionAction[GoalFields, None, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[GoalT], Async[ResultT]]
    ) -> FunctionAction[GoalT, None, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(
        self, function: Callable[[], Async[ResultT]]
    ) -> FunctionAction[None, None, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(
        self, function: Callable[[GoalHandle[GoalT], Report[FeedbackT]], ResultT]
    ) -> FunctionAction[GoalT, FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[GoalT, GoalHandle[Any], Report[FeedbackT]], ResultT]
    ) -> FunctionAction[GoalT, FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[OneT, OtherT, *MoreTs, Report[FeedbackT]], ResultT]
    ) -> FunctionAction[GoalFields, FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[GoalT, Report[FeedbackT]], ResultT]
    ) -> FunctionAction[GoalT, FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[Report[FeedbackT]], ResultT]
    ) -> FunctionAction[None, FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[GoalHandle[GoalT]], ResultT]
    ) -> FunctionAction[GoalT, None, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[GoalT, GoalHandle[Any]], ResultT]
    ) -> FunctionAction[GoalT, None, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[OneT, OtherT, *MoreTs], ResultT]
    ) -> FunctionAction[GoalFields, None, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[GoalT], ResultT]
    ) -> FunctionAction[GoalT, None, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[], ResultT]
    ) -> FunctionAction[None, None, ResultT, ResultT]: ...
    def __call__(self, function: Callable[..., Any]) -> FunctionAction[Any, Any, Any, Any]:
        """Make an action of the function.

        Raises:
            TypeError: Its signature is not that of an executor, or a type cannot be encoded; the
                text is one sentence.
        """
        return FunctionAction(
            self._name, function, checkpoint=self._checkpoint, type_name=self._type_name
        )


def action(
    name: str, *, checkpoint: type[Any] | None = None, type_name: str = ""
) -> ActionDecorator:
    """Make an action of a function, which becomes its executor.

        @action("drive")
        async def drive(report: Report[int], meters: int) -> str:
            for done in range(meters):
                await report(done)
            return f"drove {meters} m"

    The types of the action are those of the signature:

    - The goal is the one parameter of any other type than the following; several are its fields.
      Without one there is no goal: clients send None.
    - The feedback is that of a last parameter of type `Report`; None if there is none.
    - The result is what the function returns.
    - A parameter of type `GoalHandle`, before the report, gets the handle of the goal. If it is the
      only other one, the goal is its `request`.

    A plain `def` runs in a thread; there, `report` and `GoalHandle.check` raise `GoalCanceled` if
    the goal is to stop. `name`, `checkpoint` and `type_name` are those of `Action`.

    Raises:
        TypeError: The name is missing.
        ValueError: The name or the type name breaks the rule for names.
    """
    if callable(name):
        raise TypeError('@action takes the name of the action: write `@action("drive")`')
    return ActionDecorator(name, checkpoint, type_name)
