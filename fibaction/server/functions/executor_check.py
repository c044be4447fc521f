"""`check_is_executor`: a check of what a user gives as an executor, before the first goal."""

from __future__ import annotations

import inspect
from functools import partial

from fibaction.server.execution.executor import Executor
from fibaction.server.functions.function_action import FunctionAction
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT


def executor_of(
    action: Action[GoalT, FeedbackT, ResultT],
) -> Executor[GoalT, FeedbackT, ResultT]:
    """Return the function that an action is made of, as its executor.

    Raises:
        TypeError: It is not made of one.
    """
    if isinstance(action, FunctionAction):
        return action.executor
    raise TypeError(
        f"{action!r} has no executor: write ActionServer(action, executor), or make an action of a"
        f" function with @action"
    )


def check_is_executor(executor: object) -> None:
    """Raise TypeError for a function that is not an async generator function.

    This finds a forgotten `async` or `yield` before the first goal. The value that a lambda returns
    is known only when it is called, so a goal checks that.
    """
    while isinstance(executor, partial):
        executor = executor.func
    if not callable(executor):
        raise TypeError(f"the executor is an async generator function, and not {executor!r}")
    name = getattr(executor, "__name__", type(executor).__name__)
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
