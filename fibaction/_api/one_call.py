"""`call`: one goal, from the connection to the result."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Concatenate, TypeVar, Unpack, overload

from fibaction._api.connections import check_is_action, connect
from fibaction.border.abc import Transport
from fibaction.client.options import CALL_OPTIONS, goal_of
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.types.arguments import CalledAction, P, TakesArguments, TakesNone, TakesOne

if TYPE_CHECKING:
    from fibaction.client.options import CallOptions
    from fibaction.server.functions.function_action import FunctionAction
    from fibaction_transports.keywords import ConnectKeywords

    class OneCallOptions(CallOptions[FeedbackT], ConnectKeywords, total=False):
        """The options of `call`, and the settings of `connect`."""


OneT = TypeVar("OneT")


# For type checkers: as for `ActionClient.call`.


@overload
async def call(
    where: str | Transport,
    action: TakesArguments[P, FeedbackT, ResultT],
    /,
    *args: P.args,
    **kwargs: P.kwargs,
) -> ResultT: ...


@overload
async def call(
    where: str | Transport,
    action: TakesNone[FeedbackT, ResultT],
    /,
    **options: Unpack[OneCallOptions[FeedbackT]],
) -> ResultT: ...


@overload
async def call(
    where: str | Transport,
    action: TakesOne[OneT, FeedbackT, ResultT],
    first: OneT,
    /,
    **options: Unpack[OneCallOptions[FeedbackT]],
) -> ResultT: ...


@overload
async def call(
    where: str | Transport,
    action: FunctionAction[Concatenate[OneT, P], FeedbackT, ResultT, Any],
    first: OneT,
    /,
    **options: Unpack[OneCallOptions[FeedbackT]],
) -> ResultT: ...


@overload
async def call(
    where: str | Transport,
    action: CalledAction[None, FeedbackT, ResultT],
    goal: None = None,
    /,
    **options: Unpack[OneCallOptions[FeedbackT]],
) -> ResultT: ...


@overload
async def call(
    where: str | Transport,
    action: CalledAction[GoalT, FeedbackT, ResultT],
    goal: GoalT,
    /,
    **options: Unpack[OneCallOptions[FeedbackT]],
) -> ResultT: ...


async def call(where: str | Transport, action: Any, /, *args: Any, **given: Any) -> Any:
    """Connect to a URL, or by a transport, send one goal, and return its result.

        print(await call("tcp://127.0.0.1:7400", drive, 3, on_feedback=print))

    The goal is the arguments of the action's function, or one value: see `ActionClient.call`, whose
    options these are. Other names are settings of `connect`. Neither `timeout` nor `retry` counts
    the time to connect. A program that sends several goals keeps a connection: see `connect`.

    Raises:
        ActionError, TypeError, ValueError: As for `connect`, and for `ActionClient.call`.
    """
    check_is_action(action, "call")
    goal, opening = goal_and_connection(connect, where, action, args, given)
    async with opening as client:
        return await client.call(goal, **given)


def goal_and_connection(
    connecting: Callable[..., Any],
    where: str | Transport,
    action: Action[Any, Any, Any],
    args: tuple[Any, ...],
    given: dict[str, Any],
) -> tuple[Any, Any]:
    """Return the goal that `call` was given, and a connection; `given` keeps the options.

    Raises:
        TypeError: Something is neither an argument, nor an option, nor a setting.
    """
    others = {name: given.pop(name) for name in given.keys() - CALL_OPTIONS}
    fields: dict[str, Any] = {}
    if not (args and action.goal.holds(args[0])):
        fields = {name: others.pop(name) for name in others.keys() & action.parameters}
    if fields:
        from fibaction_transports.keywords import ConnectKeywords  # here, since few calls need it

        for name in fields.keys() & ConnectKeywords.__annotations__.keys():
            raise TypeError(
                f"{name!r} is a setting of connections, and a parameter of {action.name!r}: give it"
                f" to goal_of for the parameter, or to connect() for the setting"
            )
    given |= fields
    goal = goal_of(action, args, given, CALL_OPTIONS)
    try:
        return goal, connecting(where, action, **others)
    except TypeError as exc:
        if not any(f"{name!r}" in str(exc) for name in others):
            raise
        takes = f"the goal of {action.name!r} is one value, given as one argument"
        if action.parameters:
            takes = f"the parameters of {action.name!r} are {', '.join(sorted(action.parameters))}"
        raise TypeError(f"{exc}; {takes}") from None
