"""`Return`: the mark of a result among the values that an executor yields."""

from __future__ import annotations

from typing import Generic, TypeVar

T_co = TypeVar("T_co", covariant=True)


class Return(Generic[T_co]):
    """The result of a goal, as an async generator yields it, whatever the type of its feedback.

    Python has no `return` with a value in an async generator: it is a SyntaxError. A generator
    yields its result last. If feedback and result have one type, it marks the result:

        async def count(goal: GoalHandle[int]) -> AsyncIterator[int | Return[int]]:
            for number in range(goal.request):
                yield number
            yield Return(goal.request)

    Clients get the value alone.
    """

    __slots__ = ("value",)

    def __init__(self, value: T_co) -> None:
        self.value = value
        """The result."""

    def __repr__(self) -> str:
        return f"Return({self.value!r})"
