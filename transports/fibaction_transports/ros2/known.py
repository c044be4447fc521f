"""The goals of a server, as its status list tells: what has changed since the list before."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from fibaction.goals import GoalInfo
from fibaction.states import TRANSITIONS, GoalStatus
from fibaction_transports.ros2.cdr import Line, info_of, unpack_statuses


def _shortest_ways() -> dict[tuple[GoalStatus, GoalStatus], tuple[GoalStatus, ...]]:
    """How to get from one status to another; EXECUTING before CANCELING if both would do."""
    ways: dict[tuple[GoalStatus, GoalStatus], tuple[GoalStatus, ...]] = {}
    for start in GoalStatus:
        todo: deque[tuple[GoalStatus, ...]] = deque([(start,)])
        while todo:
            way = todo.popleft()
            for (before, _), after in TRANSITIONS.items():
                if before is way[-1] and (start, after) not in ways:
                    ways[start, after] = (*way[1:], after)
                    todo.append((*way, after))
    return ways


_WAYS = _shortest_ways()


class KnownGoals:
    """What the last status list said.

    The list is kept only in its last version, so some statuses are never seen; those that a goal
    must have had are told all the same, so that every change is a legal one.
    """

    def __init__(self) -> None:
        self._infos: dict[bytes, GoalInfo] = {}
        self._lines: set[Line] = set()
        self._first = True

    def __iter__(self) -> Iterator[GoalInfo]:
        return iter(self._infos.values())

    def get(self, goal_id: bytes) -> GoalInfo | None:
        """What is known of a goal."""
        return self._infos.get(goal_id)

    @property
    def has_come(self) -> bool:
        """Whether there has been a list."""
        return not self._first

    def clear(self) -> None:
        """The server has gone, and the next list will be another one's."""
        self._infos.clear()
        self._lines.clear()
        self._first = True

    def update(self, message: bytes) -> list[GoalInfo]:
        """Take a list; gives the changes in order, UNKNOWN for a goal that has left it.

        Raises:
            ProtocolError: It is no list.
        """
        lines = unpack_statuses(message)
        changed = [info_of(line) for line in lines if line not in self._lines]
        gone = self._infos.keys() - {line[0] for line in lines}
        steps = [step for info in changed for step in self._steps(info)]
        for goal_id in gone:
            info = self._infos.pop(goal_id)
            steps.append(GoalInfo(info.goal_id, info.stamp, GoalStatus.UNKNOWN))
        self._infos.update((info.goal_id, info) for info in changed)
        self._lines = set(lines)
        self._first = False
        return steps

    def _steps(self, info: GoalInfo) -> Iterator[GoalInfo]:
        before = self._infos.get(info.goal_id)
        if before is not None:
            way = _WAYS.get((before.status, info.status), (info.status,))
        elif self._first:
            way = (info.status,)  # nobody was here when it had another one
        else:
            way = (GoalStatus.ACCEPTED, *_WAYS.get((GoalStatus.ACCEPTED, info.status), ()))
        return (GoalInfo(info.goal_id, info.stamp, status) for status in way)
