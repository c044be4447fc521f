"""`GoalSpan`: the notes of a client about one of its goals, for traces."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, Protocol

from fibaction.border.abc import GoalStream, Meta
from fibaction.words.goals import GoalID, Outcome, Parent


class GoalSpan:
    """The notes about one goal. Those of this class do nothing; one object serves all goals.

    The first of `failed`, `ended` and `left` counts. None of the methods raises an error.
    """

    meta: Meta | None = None
    """The text that goes with the goal."""

    def accepted(self, stream: GoalStream) -> None:
        """Note that the server has accepted the goal."""

    def failed(self, error: BaseException) -> None:
        """Note the error of a wait for the goal."""

    def ended(self, outcome: Outcome[Any]) -> None:
        """Note the outcome."""

    def left(self, stream: GoalStream, error: BaseException | None = None) -> None:
        """Note that the client leaves an accepted goal, because of that error if there is one."""


NO_SPAN = GoalSpan()


class GoalTracer(Protocol):
    """A maker of spans for goals that are sent, such as `fibaction.observe.Tracing`."""

    @abstractmethod
    def sending(self, action: str, goal_id: GoalID, parent: Parent | None = None) -> GoalSpan:
        """Return the span of a goal that is about to be sent, perhaps by the executor of a parent.
        It raises no error.
        """
