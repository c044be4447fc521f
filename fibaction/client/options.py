"""The options of a call, and how they are told from the arguments of an action's function.

The arguments and the options stand beside each other: `client.call(3, speed=1.5, timeout=10)`. A
name is that of an option, or that of a parameter. Where it could be both, it is refused, and the
goal is made with `goal_of`.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Generic, TypedDict

from fibaction.client.retry import Retry
from fibaction.types.action import Action, FeedbackT
from fibaction.words.goal_steps import GoalStep
from fibaction.words.goals import GoalID


class GoalOptions(TypedDict, total=False):
    """The options of `send_goal`; `ActionClient.send_goal` describes them."""

    goal_id: GoalID | str | None
    timeout: float | None
    labels: Mapping[str, str] | None


class GoalOrStepOptions(GoalOptions, total=False):
    """The options of `ActionClient.send_goal`."""

    step: GoalStep | None


class AttemptOptions(TypedDict, total=False):
    """The options of every `call` but its feedback; `ActionClient.call` describes them."""

    timeout: float | None
    retry: Retry | None
    labels: Mapping[str, str] | None


class CallOptions(AttemptOptions, Generic[FeedbackT], total=False):
    """The options of the asyncio `call`."""

    on_feedback: Callable[[FeedbackT], Awaitable[object] | object] | None


class CallOrStepOptions(CallOptions[FeedbackT], total=False):
    """The options of `ActionClient.call`."""

    step: GoalStep | None


class BlockingCallOptions(AttemptOptions, Generic[FeedbackT], total=False):
    """The options of the blocking `call`."""

    on_feedback: Callable[[FeedbackT], object] | None


CALL_OPTIONS = frozenset(CallOrStepOptions.__annotations__)
"""The names of the options of `call`."""
GOAL_OPTIONS = frozenset(GoalOrStepOptions.__annotations__)
"""The names of the options of `send_goal`."""


def goal_of(
    action: Action[Any, Any, Any],
    args: tuple[Any, ...],
    given: dict[str, Any],
    options: frozenset[str],
) -> Any:
    """Return the goal that is given as arguments; `given` keeps those that are options.

    Raises:
        TypeError: The arguments do not fit the action, or a name is that of an option and that of
            a parameter.
    """
    fields = {name: given.pop(name) for name in given.keys() - options}
    if args and action.goal.holds(args[0]):
        if len(args) == 1 and not fields:
            return args[0]
        if action.parameters:
            raise TypeError(
                f"{args[0]!r} is a whole goal of {action.name!r}, and stands alone: give the other"
                f" arguments to what made it"
            )
    for name in given.keys() & action.parameters:
        made = f"{getattr(action, '__qualname__', action.name)}.goal_of({name}=...)"
        raise TypeError(
            f"{name!r} is an option of the call, and a parameter of {action.name!r}: make the goal"
            f" with `{made}`, and give options beside it"
        )
    return action.goal_from(args, fields)
