"""`action`: the decorator that makes an action of a plain function."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Coroutine
from functools import partial
from types import FrameType
from typing import Any, Concatenate, TypeAlias, TypeVar, overload

from fibaction.server.functions.function_action import FunctionAction
from fibaction.server.functions.report import Report
from fibaction.server.functions.signature import innermost
from fibaction.server.goal_handle import GoalHandle
from fibaction.types.action import FeedbackT, ResultT
from fibaction.types.arguments import P

OneT = TypeVar("OneT")
OtherT = TypeVar("OtherT")
ThirdT = TypeVar("ThirdT")
SelfT = TypeVar("SelfT")
FourthT = TypeVar("FourthT")

Async: TypeAlias = Coroutine[Any, Any, ResultT]
"""The value of a call of an async function."""


class ActionDecorator:
    """Makes an action of a function: see `action`."""

    def __init__(
        self, name: str = "", checkpoint: type[Any] | None = None, type_name: str = ""
    ) -> None:
        self._name = name
        self._checkpoint = checkpoint
        self._type_name = type_name

    # For type checkers. An order from the special to the general: a parameter of any type may be a
    # report or a handle, and what an async function returns may be the result of another one. That
    # is the overlap which mypy would report; the first that fits is the right one. A partial
    # function fits all of them for mypy. Python's types can leave out only the first parameters of
    # a function, so the others keep their names behind a report that is the first, or the second
    # one of a method; with a report at the end, they are known by their places.

    @overload
    def __call__(
        self, function: str = "", *, checkpoint: type[Any] | None = None, type_name: str = ""
    ) -> ActionDecorator: ...
    @overload
    def __call__(
        self, function: partial[Async[ResultT]]
    ) -> FunctionAction[..., Any, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(
        self, function: Callable[[GoalHandle[None]], Async[ResultT]]
    ) -> FunctionAction[[], None, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(
        self, function: Callable[[GoalHandle[OneT]], Async[ResultT]]
    ) -> FunctionAction[[OneT], None, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[Report[FeedbackT], GoalHandle[None]], Async[ResultT]]
    ) -> FunctionAction[[], FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self,
        function: Callable[Concatenate[Report[FeedbackT], GoalHandle[object], P], Async[ResultT]],
    ) -> FunctionAction[P, FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[Report[FeedbackT], GoalHandle[OneT]], Async[ResultT]]
    ) -> FunctionAction[[OneT], FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[GoalHandle[OneT], Report[FeedbackT]], Async[ResultT]]
    ) -> FunctionAction[[OneT], FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[Concatenate[Report[FeedbackT], P], Async[ResultT]]
    ) -> FunctionAction[P, FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-cannot-match, overload-overlap]
        self, function: Callable[Concatenate[GoalHandle[object], P], Async[ResultT]]
    ) -> FunctionAction[P, None, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[SelfT, GoalHandle[None]], Async[ResultT]]
    ) -> FunctionAction[[SelfT], None, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[SelfT, GoalHandle[object], Report[FeedbackT]], Async[ResultT]]
    ) -> FunctionAction[[SelfT], FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[Concatenate[SelfT, GoalHandle[object], P], Async[ResultT]]
    ) -> FunctionAction[Concatenate[SelfT, P], None, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[SelfT, GoalHandle[OneT]], Async[ResultT]]
    ) -> FunctionAction[[SelfT, OneT], None, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[SelfT, Report[FeedbackT], GoalHandle[None]], Async[ResultT]]
    ) -> FunctionAction[[SelfT], FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self,
        function: Callable[
            Concatenate[SelfT, Report[FeedbackT], GoalHandle[object], P], Async[ResultT]
        ],
    ) -> FunctionAction[Concatenate[SelfT, P], FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[SelfT, Report[FeedbackT], GoalHandle[OneT]], Async[ResultT]]
    ) -> FunctionAction[[SelfT, OneT], FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[Concatenate[SelfT, Report[FeedbackT], P], Async[ResultT]]
    ) -> FunctionAction[Concatenate[SelfT, P], FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[OneT, OtherT, Report[FeedbackT]], Async[ResultT]]
    ) -> FunctionAction[[OneT, OtherT], FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[OneT, OtherT, ThirdT, Report[FeedbackT]], Async[ResultT]]
    ) -> FunctionAction[[OneT, OtherT, ThirdT], FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[[OneT, OtherT, ThirdT, FourthT, Report[FeedbackT]], Async[ResultT]]
    ) -> FunctionAction[[OneT, OtherT, ThirdT, FourthT], FeedbackT, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[P, Async[ResultT]]
    ) -> FunctionAction[P, None, ResultT, Async[ResultT]]: ...
    @overload
    def __call__(
        self, function: partial[ResultT]
    ) -> FunctionAction[..., Any, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[GoalHandle[None]], ResultT]
    ) -> FunctionAction[[], None, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[GoalHandle[OneT]], ResultT]
    ) -> FunctionAction[[OneT], None, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[Report[FeedbackT], GoalHandle[None]], ResultT]
    ) -> FunctionAction[[], FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[Concatenate[Report[FeedbackT], GoalHandle[object], P], ResultT]
    ) -> FunctionAction[P, FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[Report[FeedbackT], GoalHandle[OneT]], ResultT]
    ) -> FunctionAction[[OneT], FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[GoalHandle[OneT], Report[FeedbackT]], ResultT]
    ) -> FunctionAction[[OneT], FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[Concatenate[Report[FeedbackT], P], ResultT]
    ) -> FunctionAction[P, FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(  # type: ignore[overload-cannot-match, overload-overlap]
        self, function: Callable[Concatenate[GoalHandle[object], P], ResultT]
    ) -> FunctionAction[P, None, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[SelfT, GoalHandle[None]], ResultT]
    ) -> FunctionAction[[SelfT], None, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[SelfT, GoalHandle[object], Report[FeedbackT]], ResultT]
    ) -> FunctionAction[[SelfT], FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[Concatenate[SelfT, GoalHandle[object], P], ResultT]
    ) -> FunctionAction[Concatenate[SelfT, P], None, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[SelfT, GoalHandle[OneT]], ResultT]
    ) -> FunctionAction[[SelfT, OneT], None, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[SelfT, Report[FeedbackT], GoalHandle[None]], ResultT]
    ) -> FunctionAction[[SelfT], FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self,
        function: Callable[Concatenate[SelfT, Report[FeedbackT], GoalHandle[object], P], ResultT],
    ) -> FunctionAction[Concatenate[SelfT, P], FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[SelfT, Report[FeedbackT], GoalHandle[OneT]], ResultT]
    ) -> FunctionAction[[SelfT, OneT], FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, function: Callable[Concatenate[SelfT, Report[FeedbackT], P], ResultT]
    ) -> FunctionAction[Concatenate[SelfT, P], FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[OneT, OtherT, Report[FeedbackT]], ResultT]
    ) -> FunctionAction[[OneT, OtherT], FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[OneT, OtherT, ThirdT, Report[FeedbackT]], ResultT]
    ) -> FunctionAction[[OneT, OtherT, ThirdT], FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[[OneT, OtherT, ThirdT, FourthT, Report[FeedbackT]], ResultT]
    ) -> FunctionAction[[OneT, OtherT, ThirdT, FourthT], FeedbackT, ResultT, ResultT]: ...
    @overload
    def __call__(
        self, function: Callable[P, ResultT]
    ) -> FunctionAction[P, None, ResultT, ResultT]: ...
    def __call__(
        self,
        function: Callable[..., Any] | str = "",
        *,
        checkpoint: type[Any] | None = None,
        type_name: str = "",
    ) -> FunctionAction[Any, Any, Any, Any] | ActionDecorator:
        """Make an action of the function, or a decorator with a name and settings that does.

        Raises:
            TypeError: Its signature is not that of an executor, or a type cannot be encoded; the
                text is one sentence.
            ValueError: The name or the type name breaks the rule for names.
        """
        if isinstance(function, str):
            return ActionDecorator(function, checkpoint, type_name)
        return FunctionAction(
            self._name,
            function,
            checkpoint=self._checkpoint,
            type_name=self._type_name,
            names=_names_around(function, sys._getframe(1)),  # pyright: ignore[reportPrivateUsage]  # as namedtuple does
        )


def _names_around(function: Callable[..., Any], frame: FrameType | None) -> dict[str, Any]:
    """Return the names of the block that a function is defined in, for its types.

    They are those of a class and of the function around it, too. A function of another module has
    its types there.
    """
    names: dict[str, Any] = {}
    module = getattr(innermost(function), "__globals__", None)
    while frame is not None and frame.f_globals is module:
        names = {**frame.f_locals, **names}
        if frame.f_code.co_flags & inspect.CO_OPTIMIZED:  # a function, and not the body of a class
            break
        frame = frame.f_back
    return names


action = ActionDecorator()
"""Make an action of a function, which becomes its executor.

    @action
    async def drive(report: Report[int], meters: int, speed: float = 1.0) -> str:
        for done in range(meters):
            await report(done)
        return f"drove {meters} m"

The types of the action are those of the signature, and its description is the docstring:

- Each parameter is a field of the goal, with its name, its default, and the text of
  `Annotated[int, "the way in meters"]`. A new parameter with a default keeps older clients working.
  A single parameter that has fields itself, such as a struct, a dataclass or a model, is the goal.
- The feedback is that of the parameter of type `Report`, the first one; None if there is none.
- The result is what the function returns.
- A parameter of type `GoalHandle` gets the handle of the goal. If there is no other one, the goal
  is its `request`.

Clients give the arguments: `await call(url, drive, 3)` or `call(url, drive, meters=3)`. A method is
an action of each object of its class: see `FunctionAction`.

A plain `def` runs in a thread; there, `report` and `GoalHandle.check` raise `GoalCanceled` if the
goal is to stop. The action has the name of the function, or another one, with the settings of
`Action`: `@action("arm/drive", checkpoint=int, type_name="my_robot/action/Drive")`.
"""
