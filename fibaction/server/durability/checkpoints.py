"""`Checkpoints`: the states that executors keep in the store of their server."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from fibaction._runtime.text import excerpt
from fibaction.words.errors import ProtocolError

if TYPE_CHECKING:
    from fibaction.border.goal_store import StoredGoal
    from fibaction.server.durability.keeper import Keeper
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.types.action import Codec


class Checkpoints:
    """The checkpoints of the goals of one server."""

    def __init__(self, action: str, codec: Codec[Any] | None, keeper: Keeper) -> None:
        self._action = action
        self._codec = codec
        self._keeper = keeper

    async def keep(self, goal: GoalRecord, state: object) -> None:
        """Keep the state of a goal, and wait until it is kept.

        Raises:
            TypeError: The action has no type for checkpoints, or the state is not of it.
            RuntimeError: The goal has ended.
            StoreError: It cannot be kept, or the goal belongs to another server by now.
        """
        codec = self._codec
        if codec is None:
            raise TypeError(
                f"action {self._action!r} has no checkpoints: give their type to its Action, as"
                f" `checkpoint=`"
            )
        if not codec.accepts(state):
            raise TypeError(
                f"a checkpoint of action {self._action!r} is of type"
                f" {_name_of(codec.type)}, not {excerpt(repr(state))}"
            )
        await self._keeper.keep_state(goal, partial(codec.encode, state))

    def restored(self, stored: StoredGoal) -> Any:
        """Return the last checkpoint of a goal; None if there is none.

        Raises:
            ProtocolError: It is not of the type of checkpoints.
        """
        if stored.checkpoint is None:
            return None
        if self._codec is None:
            raise ProtocolError(f"action {self._action!r} has no checkpoints any more")
        return self._codec.decode(stored.checkpoint)


def _name_of(kind: object) -> str:
    return getattr(kind, "__qualname__", None) or str(kind)
