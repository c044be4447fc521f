"""Goals in the messages of agents, each for a skill, and the answers of users who are asked.

A program sends the goal as data, and names the skill in the metadata. Many agents can only send a
text that their model has written. So a text that is JSON is a goal as well, one that is not is the
only text field of a goal, and `{"skill": ..., "goal": ...}` names the skill in the document itself.

A question to a user (`Questions`) is a task that requires input. Its ID is that of the goal, which
is sent once the agent has answered with a message to the task: the text `yes`, or the data
`{"consent": true}`. A goal that the user declines is a rejected task. A question belongs to the
client that asked, by its token, and to the goal that was shown: the same ID with another goal is an
error, and other clients know no task of that ID. An agent that answers in place of its user is not
noticed: that is a matter of trust, as with every protocol for agents.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple
from uuid import UUID

from a2a.types import Message, SendMessageRequest
from a2a.utils.errors import ContentTypeNotSupportedError, InvalidParamsError

from fibaction.border.peer_text import excerpt
from fibaction.schema.payload import PayloadError, to_json
from fibaction.schema.turns import Pause, in_turn, read_json
from fibaction.words.goals import NO_GOAL, GoalID
from fibaction.words.plain_data import is_map
from fibaction_transports._agents.robot_actions import OpenQuestions
from fibaction_transports.a2a.agent_card import Skill, Skills
from fibaction_transports.a2a.documents import LARGEST, Document, has_inexact

SKILL, GOAL = "skill", "goal"
"""The keys for the ID of the skill, in the metadata of a message, or of its request, or in a
document with the goal."""


async def goal_in(
    request: SendMessageRequest, documents: Sequence[Document], skills: Skills
) -> tuple[Skill, Any]:
    """Return the skill that a message is for, and its goal, with its defaults.

    Raises:
        ContentTypeNotSupportedError: The message is not one part with data, or with text.
        InvalidParamsError: It names no skill that is here, or is not a goal of its action.
    """
    kinds = {document.kind for document in documents}
    if kinds != {"text"} and (kinds != {"data"} or len(documents) > 1):
        raise ContentTypeNotSupportedError(
            "a message has one part with data, or with text, which is the goal"
        )
    goal = documents[-1]  # agents send what was said before a text, too, each in a part
    return await in_turn(None, lambda pause: _goal_in(request, goal, skills.by_label, pause))


def _goal_in(
    request: SendMessageRequest, document: Document, known: dict[str, Skill], pause: Pause | None
) -> tuple[Skill, Any]:
    skill = _named_in(request, known)
    given = document.value
    if skill is None:
        read = _read(given) if document.kind == "text" else given
        if is_map(read) and read.keys() <= {SKILL, GOAL} and read.get(SKILL) in [*known]:
            skill, given = known[read[SKILL]], read.get(GOAL, {})
        else:
            skill = _only(known)
    if isinstance(given, str):
        given = _goal_of_text(given, skill)
    try:
        goal = skill.goals.complete(given, pause)
    except PayloadError as exc:
        raise InvalidParamsError(f"the goal was not sent: {exc}") from exc
    if has_inexact(goal):
        raise InvalidParamsError(
            f"the goal was not sent: it has a whole number of {LARGEST} or more, which A2A does not"
            f" carry exactly"
        )
    return skill, goal


def _named_in(request: SendMessageRequest, known: dict[str, Skill]) -> Skill | None:
    """Return the skill that the metadata name; None if they name none.

    Raises:
        InvalidParamsError: It is not here.
    """
    for metadata in (request.message.metadata, request.metadata):
        if SKILL in metadata:
            named = metadata[SKILL]
            if isinstance(named, str) and named in known:
                return known[named]
            text = excerpt(named if isinstance(named, str) else "that is no text")
            raise InvalidParamsError(f"there is no skill {text!r} now; there are: {_names(known)}")
    return None


def _only(known: dict[str, Skill]) -> Skill:
    if len(known) == 1:
        return next(iter(known.values()))
    raise InvalidParamsError(
        f"name the skill in the metadata of the message, as {SKILL!r}, or send the goal as"
        f' {{"{SKILL}": ..., "{GOAL}": ...}}; there are: {_names(known)}'
    )


def _names(known: dict[str, Skill]) -> str:
    return ", ".join(sorted(known)) or "none"


def _goal_of_text(text: str, skill: Skill) -> Any:
    """Return the goal that a text is.

    Raises:
        InvalidParamsError: It is not one of the skill.
    """
    if skill.takes_text:
        return text
    if not text.strip() and not skill.goals.needs_goal:
        return {}
    read = _read(text)
    if skill.text_field and not is_map(read):
        return {skill.text_field: text}
    if read is None:
        raise InvalidParamsError(
            f"the goal was not sent: the skill {skill.label} takes data, or a text that is JSON,"
            f" such as {to_json(skill.example)}"
        )
    return read


def _read(text: str) -> Any:
    """Return the value of a JSON text; None if it is not one."""
    try:
        return read_json(text)
    except (ValueError, RecursionError):
        return None


def goal_id_of(message: Message) -> GoalID:
    """Return the ID of the goal that a message sends: the message's own, if that is a UUID.

    So a message that is sent again, because its answer was lost, does not send a second goal.
    """
    try:
        goal_id = GoalID(UUID(message.message_id).bytes)
    except ValueError:
        goal_id = NO_GOAL
    return GoalID.random() if goal_id == NO_GOAL else goal_id


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
