"""The questions to users before goals are sent: their texts, and `OpenQuestions`, which wait."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any, Generic, TypeVar

import anyio

from fibaction.border.peer_text import with_escapes
from fibaction.schema.payload import JsonCodec, PayloadError, to_json
from fibaction_transports._agents.robot_actions import RobotAction

QUESTION_TIMEOUT = 600.0
"""Seconds that a user has to answer a question."""
MOST_QUESTIONS = 1000
"""Questions that wait for their answers at once; the oldest of more is forgotten."""

QuestionT = TypeVar("QuestionT")
LONGEST_GOAL = 4000
"""Characters of a goal that a user is asked about. The user must see all of what is sent."""
MOST_LINES = 40
"""Lines of a goal that is shown with one field on a line."""


class OpenQuestions(Generic[QuestionT]):
    """Questions by their keys, in the order in which they were asked."""

    def __init__(self) -> None:
        self._questions: dict[str, tuple[QuestionT, float]] = {}

    def add(self, key: str, question: QuestionT) -> None:
        """Begin to wait for an answer; a question that is asked again is the newest."""
        self._questions.pop(key, None)
        while len(self._questions) >= MOST_QUESTIONS:
            del self._questions[next(iter(self._questions))]
        self._questions[key] = question, anyio.current_time() + QUESTION_TIMEOUT

    def find(self, key: str) -> QuestionT | None:
        """Return a question; None if there is none, or it was asked too long ago."""
        question, expires = self._questions.get(key, (None, 0.0))
        return question if expires > anyio.current_time() else None

    def close(self, key: str) -> None:
        """Wait for the answer no longer."""
        self._questions.pop(key, None)


class UnshownGoal(Exception):
    """A goal that cannot be shown to the user, so that it is not sent; the text says why."""


def goal_text(message: Mapping[str, Any] | Any, goals: JsonCodec) -> str:
    """Return a goal as the user is to see it: JSON, and the names of the fields that are left to
    the server, without characters that could deceive.

    Raises:
        UnshownGoal: It is too long to be shown, or cannot be.
    """
    try:
        line = to_json(message)
    except PayloadError as exc:
        raise UnshownGoal(f"The goal was not sent, because the user cannot see it: {exc}") from exc
    lines = json.dumps(json.loads(line), indent=2, ensure_ascii=False).split("\n")
    shown = [line] if len(lines) > MOST_LINES else lines
    text = _without_deceit(shown)
    if len(text) > LONGEST_GOAL:
        raise UnshownGoal(
            f"The goal was not sent: it has {len(text)} characters, and the user, who must agree to"
            f" it, can be shown {LONGEST_GOAL}. Send a shorter one."
        )
    if left_out := goals.left_out(message):
        text += "\n\n" + _without_deceit([f"The server fills in: {', '.join(left_out)}"])
    return text


def question_about(action: RobotAction, goal: Any) -> str:
    """Return the question to the user whether a goal may be sent.

    Raises:
        UnshownGoal: It cannot be shown, as for `goal_text`.
    """
    return f"Send this goal to the action {action.title}?\n\n{goal_text(goal, action.goals)}"


def _without_deceit(lines: Iterable[str]) -> str:
    return "\n".join(with_escapes(line, lambda c: json.dumps(c)[1:-1]) for line in lines)
