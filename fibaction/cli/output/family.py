"""The parents and the children among goals that are listed, for `goals` and `top`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from fibaction.cli.arguments.action_names import shown
from fibaction.cli.output.escape import excerpt
from fibaction.words.goals import GoalID, GoalInfo, Parent

if TYPE_CHECKING:
    from fibaction.observe.monitor import GoalSnapshot, Monitor


class Family:
    """The parents and the children of the goals of a list; those elsewhere are not known."""

    def __init__(self, infos: Iterable[GoalInfo]) -> None:
        self._children: dict[GoalID, list[GoalID]] = {}
        for info in infos:
            if info.parent is not None:
                self._children.setdefault(info.parent.goal_id, []).append(info.goal_id)

    def __bool__(self) -> bool:
        return bool(self._children)

    @property
    def parents(self) -> Iterator[str]:
        """The IDs of all parents, as text; some may be of goals that are not listed."""
        return map(str, self._children)

    def text(self, info: GoalInfo, digits: int) -> str:
        """Return the step that a goal is, and the number of its children, with IDs cut to so many
        digits.
        """
        parts = [step_of(info.parent, digits)] if info.parent else []
        if count := len(self.children(info.goal_id)):
            parts.append("1 child" if count == 1 else f"{count} children")
        return ", ".join(parts)

    def children(self, goal_id: GoalID) -> list[str]:
        """Return the IDs of the children of a goal, as text."""
        return [str(child) for child in self._children.get(goal_id, ())]


def step_of(parent: Parent, digits: int = 32) -> str:
    """Return the name of a step and its goal; `step of` without a name."""
    return f"{excerpt(parent.step) or 'step'} of {str(parent.goal_id)[:digits]}"


def parent_json(parent: Parent | None) -> dict[str, str] | None:
    """Return the parent of a goal for a program."""
    return None if parent is None else {"goal_id": str(parent.goal_id), "step": parent.step}


def family_of(monitor: Monitor, goal: GoalSnapshot) -> str:
    """Return the parent and the children of a goal with their statuses; empty if it has none."""
    lines: list[str] = []
    if goal.info.parent is not None:
        parent = monitor.find(goal.info.parent.goal_id)
        state = "of another server, or forgotten" if parent is None else _state_of(parent)
        lines.append(f"Parent: {step_of(goal.info.parent)}, {state}")
    children = monitor.children(goal.info.goal_id)
    lines += ["Children:"] if children else []
    for child in children:
        step = excerpt(child.info.parent.step) if child.info.parent else ""
        lines.append(f"  {step or 'step'}: {child.info.goal_id}, {_state_of(child)}")
    return "\n".join(lines)


def _state_of(goal: GoalSnapshot) -> str:
    return f"{excerpt(shown(goal.action))} {goal.info.status.name}"
