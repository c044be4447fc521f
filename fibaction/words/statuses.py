"""The goal state machine, as one table.

This module alone says which status may follow which. It does not depend on clients, servers, tasks
or time. Numbers and edges are those of ROS 2: `action_msgs/msg/GoalStatus`, `rcl_action/types.h`
and `rcl_action/goal_state_machine.c`.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from types import MappingProxyType
from typing import Any, Final

from fibaction.words.action_error import ActionError

NUMBER_TYPES: Final = frozenset("bcdoxXneEfFgG%")
"""The last characters of format specifications that only numbers take."""


class NamedNumber(IntEnum):
    """A number of ROS 2 that is printed by its name."""

    def __str__(self) -> str:
        return self.name

    def __format__(self, spec: str, /) -> str:
        """Format the name; the number if the specification is one of numbers, such as `03d`."""
        is_of_numbers = spec[-1:] in NUMBER_TYPES
        return int.__format__(self, spec) if is_of_numbers else format(self.name, spec)

    @classmethod
    def __get_pydantic_core_schema__(cls, _source: Any, _handler: Any) -> Any:
        """Write the name in JSON, and read the name or the number; pydantic calls this."""
        from pydantic_core import core_schema

        words = core_schema.literal_schema([one.name for one in cls])
        named = core_schema.no_info_after_validator_function(cls.__getitem__, words)
        return core_schema.union_schema(
            [named, core_schema.enum_schema(cls, [*cls], sub_type="int")],
            serialization=core_schema.plain_serializer_function_ser_schema(
                str, return_schema=words, when_used="json"
            ),
        )


class GoalStatus(NamedNumber):
    """The status of a goal, which prints its name. UNKNOWN is only an answer, never stored."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6

    is_active: bool
    """True if the goal was accepted and has not ended."""
    is_terminal: bool
    """True if the goal has ended."""

    def __init__(self, number: int) -> None:
        # Attributes, and not properties: they are read at each step of each goal.
        self.is_active = 1 <= number <= 3
        self.is_terminal = number >= 4


class GoalEvent(NamedNumber):
    """The events that change a goal's status: clients cause CANCEL_GOAL, the server all others."""

    EXECUTE = 0
    CANCEL_GOAL = 1
    SUCCEED = 2
    ABORT = 3
    CANCELED = 4


class InvalidTransition(ActionError):
    """An event that a status does not allow: a bug in fibaction, not in the code that uses it."""

    def __init__(self, status: GoalStatus, event: GoalEvent) -> None:
        super().__init__(status, event)
        self.status = status
        self.event = event

    def __str__(self) -> str:
        return f"a goal that is {self.status.name} cannot {self.event.name}"


INITIAL: Final = GoalStatus.ACCEPTED
"""The status of a goal at the moment of its acceptance. A rejected goal does not have a status."""

TRANSITIONS: Final[Mapping[tuple[GoalStatus, GoalEvent], GoalStatus]] = MappingProxyType(
    {
        (GoalStatus.ACCEPTED, GoalEvent.EXECUTE): GoalStatus.EXECUTING,
        (GoalStatus.ACCEPTED, GoalEvent.CANCEL_GOAL): GoalStatus.CANCELING,
        (GoalStatus.EXECUTING, GoalEvent.CANCEL_GOAL): GoalStatus.CANCELING,
        (GoalStatus.EXECUTING, GoalEvent.SUCCEED): GoalStatus.SUCCEEDED,
        (GoalStatus.EXECUTING, GoalEvent.ABORT): GoalStatus.ABORTED,
        (GoalStatus.CANCELING, GoalEvent.SUCCEED): GoalStatus.SUCCEEDED,
        (GoalStatus.CANCELING, GoalEvent.CANCELED): GoalStatus.CANCELED,
        (GoalStatus.CANCELING, GoalEvent.ABORT): GoalStatus.ABORTED,
    }
)
"""Every legal edge; all others are illegal."""


def transition(status: GoalStatus, event: GoalEvent) -> GoalStatus:
    """Return the status that follows `status` when `event` happens.

    Raises:
        InvalidTransition: The table has no such edge.
    """
    try:
        return TRANSITIONS[status, event]
    except KeyError:
        raise InvalidTransition(status, event) from None
