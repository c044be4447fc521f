"""`OpenQuestions`: the questions to users that wait for their answers."""

from __future__ import annotations

from typing import Generic, TypeVar

import anyio

QUESTION_TIMEOUT = 600.0
"""Seconds that a user has to answer a question."""
MOST_QUESTIONS = 1000
"""Questions that wait for their answers at once; the oldest of more is forgotten."""

QuestionT = TypeVar("QuestionT")


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
