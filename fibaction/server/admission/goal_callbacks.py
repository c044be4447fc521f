"""`GoalCallbacks`: the decisions of a user on goals and cancels, `on_goal` and `on_cancel`."""

from __future__ import annotations

from collections.abc import Coroutine
from typing import TYPE_CHECKING, Any, Generic

from fibaction.server.admission.callbacks import Callbacks
from fibaction.server.admission.sender_argument import with_sender
from fibaction.types.action import GoalT
from fibaction.words.errors import CancelRejected, GoalRejected

if TYPE_CHECKING:
    from contextvars import Context

    from fibaction.server.goal_handle import GoalHandle
    from fibaction.server.settings import ActionServerSettings
    from fibaction.words.goals import GoalID, Sender


class GoalCallbacks(Generic[GoalT]):
    """The decisions of a user on goals and cancels; without a callback, each is accepted."""

    def __init__(self, action: str, settings: ActionServerSettings[GoalT]) -> None:
        """Make the callbacks of an action from the settings.

        Raises:
            TypeError: `on_goal` takes neither one argument nor two.
        """
        on_goal = settings.on_goal
        self._on_goal = None if on_goal is None else with_sender("on_goal", on_goal)
        self._on_cancel = settings.on_cancel
        self.are_goals_decided = on_goal is not None
        """True if a goal may be rejected."""
        self.are_cancels_decided = settings.on_cancel is not None
        """True if a cancel may be rejected."""
        self._callbacks = Callbacks(action)

    def ask_goal(
        self, request: GoalT, sender: Sender, goal_id: GoalID, context: Context | None
    ) -> Coroutine[Any, Any, None] | None:
        """Call `on_goal`: return None if it accepts, or a coroutine that waits for its answer.

        Raises:
            GoalRejected: It rejects the goal, or has failed, here or in the coroutine.
        """
        on_goal, ask = self._on_goal, self._callbacks.ask
        assert on_goal is not None  # else no goal is decided
        asked = (request, sender)
        if context is None:
            return ask("on_goal", on_goal, asked, GoalRejected, goal_id)
        return context.run(ask, "on_goal", on_goal, asked, GoalRejected, goal_id)

    def ask_cancel(self, handle: GoalHandle[GoalT]) -> Coroutine[Any, Any, None] | None:
        """Call `on_cancel`, in the same way.

        Raises:
            CancelRejected: It rejects the cancel, or has failed, here or in the coroutine.
            RuntimeError: `on_cancel` itself cancels the goal that it decides upon.
        """
        on_cancel, goal_id = self._on_cancel, handle.goal_id
        assert on_cancel is not None  # else no cancel is decided
        self._callbacks.check_not_within("on_cancel", goal_id, "cancels")
        return self._callbacks.ask("on_cancel", on_cancel, (handle,), CancelRejected, about=goal_id)

    def check_not_deciding(self, goal_id: GoalID) -> None:
        """Raise RuntimeError if this is called by the `on_goal` that decides on that goal: it would
        wait for itself.
        """
        self._callbacks.check_not_within("on_goal", goal_id, "cancels, or sends again,")

    def stop(self) -> None:
        """Cancel all callbacks that are awaited now; each counts as a rejection."""
        self._callbacks.stop()
