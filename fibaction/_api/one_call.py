"""`call`: one goal, from the connection to the result."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, Unpack, overload

from fibaction._api.connections import check_is_action, connect
from fibaction.border.abc import Transport
from fibaction.client.retry import Retry
from fibaction.types.action import NO_VALUE, FeedbackT, GoalT, ResultT

if TYPE_CHECKING:
    from fibaction_transports.keywords import ConnectKeywords


T_co = TypeVar("T_co", covariant=True)
T_contra = TypeVar("T_contra", contravariant=True)
FeedbackT_co = TypeVar("FeedbackT_co", covariant=True)


class Encodes(Protocol[T_contra]):
    """A codec, as it is used for what is sent."""

    def encode(self, value: T_contra, /) -> bytes:
        """Turn a value into bytes."""
        ...


class Decodes(Protocol[T_co]):
    """A codec, as it is used for what is received."""

    def decode(self, payload: bytes, /) -> T_co:
        """Turn bytes into a value."""
        ...


class CalledAction(Protocol[T_contra, FeedbackT_co, T_co]):
    """An action, by the types of its goal, its feedback and its result."""

    @property
    def goal(self) -> Encodes[T_contra]:
        """The codec of the goal."""
        ...

    @property
    def feedback(self) -> Decodes[FeedbackT_co]:
        """The codec of the feedback."""
        ...

    @property
    def result(self) -> Decodes[T_co]:
        """The codec of the result."""
        ...


@overload
async def call(
    where: str | Transport,
    action: CalledAction[None, FeedbackT, ResultT],
    goal: None = None,
    *,
    on_feedback: Callable[[FeedbackT], Awaitable[object] | object] | None = None,
    timeout: float | None = None,
    retry: Retry | None = None,
    labels: Mapping[str, str] | None = None,
    **settings: Unpack[ConnectKeywords],
) -> ResultT: ...


@overload
async def call(
    where: str | Transport,
    action: CalledAction[GoalT, FeedbackT, ResultT],
    goal: GoalT,
    *,
    on_feedback: Callable[[FeedbackT], Awaitable[object] | object] | None = None,
    timeout: float | None = None,
    retry: Retry | None = None,
    labels: Mapping[str, str] | None = None,
    **settings: Unpack[ConnectKeywords],
) -> ResultT: ...


async def call(
    where: str | Transport,
    action: Any,
    goal: Any = NO_VALUE,
    *,
    on_feedback: Callable[[Any], Awaitable[object] | object] | None = None,
    timeout: float | None = None,
    retry: Retry | None = None,
    labels: Mapping[str, str] | None = None,
    **settings: Unpack[ConnectKeywords],
) -> Any:
    """Connect to a URL, or by a transport, send one goal, and return its result.

        print(await call("tcp://127.0.0.1:7400", DRIVE, 3, on_feedback=print))

    A program that sends several goals keeps a connection: see `connect`, whose `settings` these
    are. `on_feedback`, `timeout`, `retry` and `labels` are those of `ActionClient.call`; neither
    the timeout nor the retry counts the time to connect.

    Raises:
        ActionError, TypeError, ValueError: As for `connect`, and for `ActionClient.call`.
    """
    check_is_action(action, "call")
    async with connect(where, action, **settings) as client:
        return await client.call(
            goal, on_feedback=on_feedback, timeout=timeout, retry=retry, labels=labels
        )
