"""`check_is_executor`: a check of what a user gives as an executor, before the first goal."""

from __future__ import annotations

import inspect
from collections.abc import AsyncIterable, AsyncIterator, Callable
from functools import partial
from types import FunctionType
from typing import Any, cast

from fibaction.server.execution.executor import Execution, Executor, Runner
from fibaction.server.functions.function_action import FunctionAction
from fibaction.server.goal_handle import GoalHandle
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT


def executor_of(
    action: Action[GoalT, FeedbackT, ResultT],
) -> Executor[GoalT, FeedbackT, ResultT]:
    """Return the function that an action is made of, as its executor.

    Raises:
        TypeError: It is not made of one.
    """
    if isinstance(action, FunctionAction):
        if not action.is_bound:
            raise TypeError(
                f"{action!r} is a method, and runs with an object of its class: serve the action of"
                f" one, as in `serve(Robot().{action.name}, url)`"
            )
        return action.executor
    raise TypeError(
        f"{action!r} has no executor: write ActionServer(action, executor), or make an action of a"
        f" function with @action"
    )


def runner_of(executor: Callable[[GoalHandle[Any]], AsyncIterator[Any]]) -> Runner:
    """Return what runs an executor: the function that it is made of, or an iteration over its
    generators.
    """
    function: Any = getattr(executor, "__self__", None)
    # `isinstance` would leave its types unknown.
    if issubclass(type(function), FunctionAction) and executor == function.executor:
        return cast("Runner", function.run)
    return partial(Execution[Any, Any, Any].iterate, executor=executor)


def check_is_served(action: Any) -> None:
    """Raise TypeError for a first argument of `ActionServer` that is not an action with types."""
    if issubclass(type(action), Action):  # `isinstance` would leave its types unknown
        if object not in action.feedback.classes:
            return
        raise TypeError(
            f"{action!r} is untyped, and a server needs types: define an Action with the types"
            f" of goal, feedback and result"
        )
    order = ": write ActionServer(action, executor)"
    if inspect.isfunction(action):
        order = f": write ActionServer(action, {action.__name__}), the executor last"
    raise TypeError(f"the first argument of ActionServer is an Action, and not {action!r}{order}")


def check_is_executor(executor: object) -> None:
    """Raise TypeError for a function that is not an async generator function.

    This finds a forgotten `yield` in an async function before the first goal. The value that any
    other function returns is known only when it is called, so a goal checks that, unless the
    function says its type.
    """
    while isinstance(executor, partial):
        executor = executor.func
    name = getattr(executor, "__name__", type(executor).__name__)
    if isinstance(executor, FunctionAction):
        raise TypeError(f"{executor!r} has its executor: write ActionServer({name})")
    if not callable(executor):
        raise TypeError(f"the executor is an async generator function, and not {executor!r}")
    for function in (executor, executor.__call__):
        if inspect.iscoroutinefunction(function):
            raise TypeError(
                f"the executor {name!r} is a coroutine function: yield its feedback, and yield its"
                f" result last, instead of returning it, or make an action of it with @action"
            )
        if inspect.isgeneratorfunction(function):
            raise TypeError(
                f"the executor {name!r} is a generator function that is not async: write"
                f" `async def`, and await what takes time"
            )
    if inspect.isfunction(executor) and _returns_other(executor):
        raise TypeError(
            f"the executor {name!r} is not an async generator function, and returns its result:"
            f" yield it, in an `async def`, or make an action of the function with @action"
        )


def _returns_other(function: FunctionType) -> bool:
    """Return whether a function is known to return something else than an async iterator."""
    if inspect.isasyncgenfunction(function):
        return False
    try:
        said = inspect.get_annotations(function, eval_str=True).get("return")
    except Exception:  # of any kind: a type may be known to type checkers only
        said = None
    return isinstance(said, type) and not issubclass(said, AsyncIterable)
