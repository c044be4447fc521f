"""`FunctionAction`: an action that is made of a plain function, which is its executor."""

from __future__ import annotations

import inspect
from collections import OrderedDict
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from copy import copy
from functools import partial, update_wrapper
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, cast, overload

from anyio import CapacityLimiter, to_thread
from anyio.lowlevel import RunVar

from fibaction.server.functions.report import DONE, Report, RunningGoal
from fibaction.server.functions.signature import FunctionSignature, innermost, is_async
from fibaction.server.goal_handle import GoalHandle
from fibaction.types.action import Action, Codec, FeedbackT, ResultT
from fibaction.types.arguments import Arguments, P
from fibaction.words.progress import Return

CallT = TypeVar("CallT", covariant=True)
ObjectT = TypeVar("ObjectT")
Q = ParamSpec("Q")

MOST_THREADS = 64
"""Goals of one function that run in threads at once, in one event loop; more wait."""


class FunctionAction(Action[Any, FeedbackT, ResultT], Generic[P, FeedbackT, ResultT, CallT]):
    """An action that `action` has made of a function, which is its executor.

    `connect` and `call` take it like any other action, and `serve` takes it without an
    `ActionServer`. For a server with settings, write `ActionServer(drive, schedule=...)`.

    It can be called as the function that it was, for example by tests: `await drive(meters=3)`.

    For a method, `Robot.move` is the definition for clients, and `robot.move` is the action that is
    bound to the object `robot`, for servers:

        class Robot:
            @action
            async def move(self, report: Report[float], meters: float) -> str: ...

        async with serve(Robot().move, url):
            await call(url, Robot.move, 3.0)
    """

    goal: Codec[Arguments[P]]

    def __init__(
        self,
        name: str,
        function: Callable[..., CallT],
        *,
        checkpoint: type[Any] | None = None,
        type_name: str = "",
        names: Mapping[str, Any] | None = None,
    ) -> None:
        """Make an action of a function; see `action`. It has the name of the function if `name` is
        empty. `names` are those of the block that the function is defined in, for its types.

        Raises:
            TypeError: The signature is not that of an executor, or a type cannot be encoded.
            ValueError: The name or the type name breaks the rule for names.
        """
        self._signature = signature = FunctionSignature(function, names)
        super().__init__(
            name or signature.name,
            goal=signature.goal.type,
            feedback=signature.feedback,
            result=signature.result,
            checkpoint=checkpoint,
            type_name=type_name,
        )
        self.parameters = frozenset(signature.fields)
        self.description = inspect.getdoc(innermost(function)) or ""
        self._function = function
        self._call_text = f"{signature.name}()"
        self._is_async = is_async(function)
        self._threads: RunVar[CapacityLimiter] = RunVar(f"threads of {self.name}")
        self.is_bound = not signature.is_method
        """False for a method whose object is not known; then it cannot be served."""
        update_wrapper(self, function, updated=())

    # For type checkers. The last one is for those that cannot follow the first two.

    @overload
    def __get__(
        self: FunctionAction[Concatenate[ObjectT, Q], FeedbackT, ResultT, CallT],
        instance: None,
        owner: type[ObjectT],
    ) -> FunctionAction[Q, FeedbackT, ResultT, CallT]: ...
    @overload
    def __get__(
        self: FunctionAction[Concatenate[ObjectT, Q], FeedbackT, ResultT, CallT],
        instance: ObjectT,
        owner: type[ObjectT],
    ) -> FunctionAction[Q, FeedbackT, ResultT, CallT]: ...
    @overload
    def __get__(
        self, instance: object, owner: Any
    ) -> FunctionAction[..., FeedbackT, ResultT, CallT]: ...
    def __get__(self, instance: object, owner: Any) -> FunctionAction[Any, Any, Any, Any]:
        """Return the action of a method of this object; without one, the action itself."""
        if instance is None or self.is_bound:
            return self
        bound = copy(self)
        bound._function = self._function.__get__(instance, owner)
        bound.is_bound = True
        vars(bound)["__wrapped__"] = bound._function  # for `inspect.signature`
        return bound

    def __call__(self, *args: Any, **kwargs: Any) -> CallT:
        """Call the function itself, with or without its report, wherever that stands.

        A `report` that is not given discards the feedback, and one that is not a `Report`, such as
        `print`, is called with it.
        """
        name = self._signature.report
        if not name:
            return self._function(*args, **kwargs)
        called = inspect.signature(self._function)
        others = [one for one in called.parameters.values() if one.name != name]
        given = kwargs.pop(name, None)
        try:
            if any(isinstance(one, Report) for one in args):
                raise TypeError("the report is given by its place")
            found = called.replace(parameters=others).bind(*args, **kwargs).arguments
        except TypeError as exc:
            try:
                found = called.bind(*args, **kwargs).arguments
            except TypeError:
                raise exc from None
            given = found.pop(name)
        bound = inspect.BoundArguments(called, OrderedDict(found, **{name: _as_report(given)}))
        return self._function(*bound.args, **bound.kwargs)

    def goal_of(self, /, *args: P.args, **kwargs: P.kwargs) -> Arguments[P]:
        """Return the goal with which a server calls the function with these arguments.

        Use it to give options in addition to several arguments:

            await call(url, drive, drive.goal_of(3, speed=0.5), on_feedback=print)

        Raises:
            TypeError: The arguments do not fit the parameters of the function.
        """
        return cast("Arguments[P]", self._signature.goal.goal_of(args, kwargs))

    def goal_from(self, args: tuple[Any, ...], fields: Mapping[str, Any]) -> Any:
        """Return the goal that a caller gives, as the arguments of the function.

        Raises:
            TypeError: The arguments do not fit the parameters of the function.
        """
        return self._signature.goal.goal_of(args, fields)

    async def executor(
        self, goal: GoalHandle[Any]
    ) -> AsyncGenerator[FeedbackT | ResultT | Return[ResultT], None]:
        """Run the function for one goal: the executor of this action.

        A server calls `run` instead. As a generator, it is for executors that iterate over it.
        """
        assert goal.running is not None
        yield Return(await self._returned(goal.running, goal))

    async def run(self, running: RunningGoal, goal: GoalHandle[Any]) -> None:
        """Run the function for one goal, in a server: the `Runner` of this function."""
        running.keep_result(await self._returned(running, goal), self._call_text)

    async def _returned(self, running: RunningGoal, goal: GoalHandle[Any]) -> ResultT:
        report: Report[FeedbackT] = Report(running)
        try:
            args, kwargs = self._signature.arguments(goal.request, goal, report)
            if self._is_async:
                return await cast("Awaitable[ResultT]", self._function(*args, **kwargs))
            function = partial(self._function, *args, **kwargs)
            return cast("ResultT", await to_thread.run_sync(function, limiter=self._limiter()))
        finally:
            report.close()

    def _limiter(self) -> CapacityLimiter:
        try:
            return self._threads.get()
        except LookupError:
            limiter = CapacityLimiter(MOST_THREADS)
            self._threads.set(limiter)
            return limiter


def actions_of(instance: object) -> list[FunctionAction[..., Any, Any, Any]]:
    """Return the actions that are methods of an object, in the order of their definition; for one
    that is an action of a function itself, that one.

    Raises:
        TypeError: Its class has a method without `@action` in place of an action of another class.
    """
    cls = type(instance)
    if issubclass(cls, FunctionAction):
        return [cast("FunctionAction[..., Any, Any, Any]", instance)]
    found: list[FunctionAction[..., Any, Any, Any]] = []
    for name in dict.fromkeys(name for one in reversed(cls.__mro__) for name in vars(one)):
        method = getattr(cls, name, None)
        if issubclass(type(method), FunctionAction):
            found.append(getattr(instance, name))
        elif inspect.isfunction(method):
            for base in cls.__mro__:
                if issubclass(type(vars(base).get(name)), FunctionAction):
                    raise TypeError(
                        f"{cls.__name__}.{name} takes the place of the action"
                        f" {base.__name__}.{name}: write @action above it"
                    )
    return found


def _as_report(given: Any) -> Any:
    """Return what a function that is called by itself gets as its report."""
    if isinstance(given, Report):
        return given  # pyright: ignore[reportUnknownVariableType]  # mypy knows it as Report[Any]

    def report(feedback: object) -> Awaitable[None]:
        if given is not None:
            answer = given(feedback)
            if isinstance(answer, Awaitable):
                return cast("Awaitable[None]", answer)
        return DONE

    return report
