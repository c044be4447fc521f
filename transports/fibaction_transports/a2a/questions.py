"""`Questions`: the consent of a user before a goal is sent.

A question is a task that requires input. Its ID is that of the goal, which is sent once the agent
has answered with a message to the task: the text `yes`, or the data `{"consent": true}`. A goal
that the user declines is a rejected task. A question belongs to the client that asked, by its
token, and to the goal that was shown: the same ID with another goal is an error, and other clients
know no task of that ID. An agent that answers in place of its user is not noticed: that is a matter
of trust, as with every protocol for agents.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from a2a.utils.errors import InvalidParamsError

from fibaction.words.goals import GoalID
from fibaction.words.plain_data import is_map
from fibaction_transports._agents.questions import OpenQuestions
from fibaction_transports.a2a.agent_card import Skill
from fibaction_transports.a2a.documents import Document

_ANSWERS = {"yes": True, "no": False}


class Question(NamedTuple):
    """A goal about which a user is asked."""

    goal_id: GoalID
    skill: Skill
    goal: Any
    context_id: str
    text: str
    """The question, for the user."""
    client: str
    """The client whose user is asked."""


class Questions:
    """The questions of one server that wait for their answers."""

    def __init__(self) -> None:
        self._open: OpenQuestions[Question] = OpenQuestions()

    def ask(
        self,
        goal_id: GoalID,
        skill: Skill,
        goal: Any,
        context_id: str,
        text: str,
        client: str,
    ) -> Question:
        """Begin to wait for an answer; a question that is asked again goes on.

        Raises:
            InvalidParamsError: Another question has the ID.
        """
        question = Question(goal_id, skill, goal, context_id or str(goal_id), text, client)
        known = self._open.find(str(goal_id))
        if known is not None and (known.client, known.text) != (client, text):
            raise InvalidParamsError(
                "another message has this ID: give each message an ID of its own"
            )
        self._open.add(str(goal_id), question)
        return question

    def find(self, goal_id: GoalID, client: str) -> Question | None:
        """Return the question of a client about a goal; None if there is none, or it was asked too
        long ago.
        """
        question = self._open.find(str(goal_id))
        return None if question is None or question.client != client else question

    def close(self, question: Question) -> None:
        """Wait for the answer no longer."""
        self._open.close(str(question.goal_id))


def answer_in(documents: Sequence[Document]) -> bool | None:
    """Return the answer in the documents of a message; None if it is not one."""
    if len(documents) != 1:
        return None
    kind, value = documents[0]
    if kind == "text":
        return _ANSWERS.get(value.strip().strip(".!").lower())
    consent = value.get("consent") if is_map(value) else None
    return consent if isinstance(consent, bool) else None
