"""What clients and servers say to one another about goals, apart from their payloads.

Plain values: they know nothing of who sends them or how.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from enum import IntEnum
from typing import Any, Generic, TypeVar

import msgspec

from fibaction.exceptions import WHY_UNKNOWN
from fibaction.states import GoalStatus

T = TypeVar("T")


class GoalID(bytes):
    """The 16 bytes that name one goal for ever. The client makes them.

    All zeros name no goal: in a cancel they mean "any" (`action_msgs/srv/CancelGoal`).
    """

    __slots__ = ()

    def __new__(cls, value: bytes) -> GoalID:
        """Take 16 bytes.

        Raises:
            ValueError: It is not 16 bytes.
        """
        if len(value) != 16:
            raise ValueError(f"a goal ID has 16 bytes, not {len(value)}")
        return super().__new__(cls, value)

    @classmethod
    def random(cls) -> GoalID:
        """A new ID, 16 random bytes, which no other goal has."""
        return super().__new__(cls, os.urandom(16))

    @classmethod
    def parse(cls, text: str) -> GoalID:
        """Read what `str()` wrote: 32 hexadecimal digits, with or without the dashes of a UUID.

        Raises:
            ValueError: It is something else.
        """
        try:
            return cls(bytes.fromhex(text.replace("-", "")))
        except ValueError:
            raise ValueError(f"a goal ID has 32 hexadecimal digits, unlike {text!r}") from None

    def __str__(self) -> str:
        return self.hex()

    def __repr__(self) -> str:
        return f"GoalID.parse('{self.hex()}')"


NO_GOAL = GoalID(bytes(16))
"""The ID that names no goal; in a cancel it means that no goal is named."""


class Sender(msgspec.Struct, frozen=True):
    """The client that sends a goal, as its transport knows it."""

    name: str = ""
    """Its name, for people to read; empty if it is unknown."""
    owner: bytes = b""
    """A digest that is the same on each connection of that client, and of no other client; empty if
    the transport cannot recognise its clients."""


UNKNOWN_SENDER = Sender()
"""A client of which the transport knows nothing."""


class GoalInfo(msgspec.Struct, frozen=True):
    """One line of a server's list of goals."""

    goal_id: GoalID
    stamp: int
    """When the goal was accepted: nanoseconds since 1970. Each goal of a server has another one."""
    status: GoalStatus
    """UNKNOWN says that the server has forgotten the goal."""
    feedback_count: int = 0
    """How many feedback messages there have been by then; 0 also where that is not carried."""
    client: str = ""
    """Who sent the goal, as its transport names clients; empty where nobody knows."""


class Outcome(msgspec.Struct, Generic[T], frozen=True):
    """How a goal ended: bytes as result between endpoints, the action's type for users."""

    status: GoalStatus
    """SUCCEEDED, CANCELED or ABORTED; UNKNOWN if the server knows no such goal."""
    result: T | None = None
    """All of it when SUCCEEDED; what there was, or None, when CANCELED or ABORTED."""
    reason: str = ""
    """Why it was aborted or canceled, or what may be why it is UNKNOWN, for a person to read."""


UNKNOWN_OUTCOME: Outcome[Any] = Outcome(GoalStatus.UNKNOWN, reason=WHY_UNKNOWN)
"""The answer for a goal that the server does not know, or not any more."""


class ActionPeers(msgspec.Struct, frozen=True):
    """Who serves an action, and who uses it, as their transport names them."""

    servers: tuple[str, ...] = ()
    clients: tuple[str, ...] = ()


class CancelCode(IntEnum):
    """The return codes of `action_msgs/srv/CancelGoal`."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL_ID = 2
    GOAL_TERMINATED = 3


class CancelAnswer(msgspec.Struct, frozen=True):
    """What a server says to a cancel."""

    return_code: CancelCode
    """NONE also when a cancel of all, or by time, found no goal."""
    goals_canceling: tuple[GoalInfo, ...] = ()
    """The goals whose cancel was accepted, each with the status it had just after."""
    reason: str = ""
    """Why a cancel was rejected; several reasons are joined with `; `."""

    @property
    def accepted(self) -> bool:
        """True if any goal is canceling because of it."""
        return bool(self.goals_canceling)

    @classmethod
    def merged(cls, answers: Iterable[CancelAnswer]) -> CancelAnswer:
        """Return one answer for one cancel that several servers have answered.

        A goal that is canceling anywhere makes it NONE; otherwise a rejection counts most, then a
        goal that has ended, then a cancel of all that found no goal. Only if no server knows the
        goal, it is unknown. Without any answer it is NONE, as if there were no goals.
        """
        answers = tuple(answers)
        goals = tuple(info for answer in answers for info in answer.goals_canceling)
        reasons = "; ".join(dict.fromkeys(answer.reason for answer in answers if answer.reason))
        codes = {answer.return_code for answer in answers}
        weights = (
            CancelCode.REJECTED,
            CancelCode.GOAL_TERMINATED,
            CancelCode.NONE,
            CancelCode.UNKNOWN_GOAL_ID,
        )
        code = next((code for code in weights if code in codes), CancelCode.NONE)
        return cls(CancelCode.NONE if goals else code, goals, reasons)
