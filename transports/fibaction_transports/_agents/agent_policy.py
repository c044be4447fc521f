"""`AgentPolicy`: the rules for what an agent may do with the actions of a robot."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from typing import ClassVar

import msgspec

from fibaction.border.settings import TransportSettings


class AgentPolicy(TransportSettings, frozen=True, kw_only=True):
    """The rules for what an agent may do: a language model, or a program that has one.

    By default it may send goals to all actions, and the user is asked before each goal. A client
    that cannot ask its user gets an error in place of the goal.

    A pattern is the name of an action without a slash in front, in which `*` stands for any
    characters: `arm/*`. With several servers, `left:arm/*` is for the server of that name only.

    For example:

        AgentPolicy(allow=("arm/*", "camera/look"), unasked=("camera/look",))
    """

    for_clients: ClassVar[bool] = False

    allow: Sequence[str] = ("*",)
    """Patterns of the actions that are shown to the agent; all others do not exist for it."""
    unasked: Sequence[str] = ()
    """Patterns of the actions whose goals are sent without a question to the user."""
    read_only: bool = False
    """Show the actions and their goals, and let nothing be sent or canceled."""
    patience: float = 50.0
    """Seconds after which a tool, or a message of A2A, is answered that its goal still runs. Many
    clients give up after 60 s, and that would cancel the goal of a tool."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: The patience is not a number of seconds, or a pattern is empty.
        """
        for name in ("allow", "unasked"):  # an iterator would be used up by the check
            msgspec.structs.force_setattr(self, name, tuple(getattr(self, name)))
        if not 0 < self.patience < math.inf:
            raise ValueError(
                f"patience must be finite and more than 0 seconds, not {self.patience}"
            )
        if not all((*self.allow, *self.unasked)):
            raise ValueError("a pattern is the name of an action, and cannot be empty")

    def allows(self, server: str, action: str) -> bool:
        """Return whether the agent may know the action."""
        return _matches(self.allow, server, action)

    def asks(self, server: str, action: str) -> bool:
        """Return whether the user is asked before a goal of that action."""
        return not _matches(self.unasked, server, action)


def _matches(patterns: Iterable[str], server: str, action: str) -> bool:
    name = action.lstrip("/")
    for pattern in patterns:
        wanted, colon, rest = pattern.rpartition(":")
        if colon and wanted != server:
            continue
        if fnmatchcase(name, rest.lstrip("/")):
            return True
    return False
