"""Goals in the messages of agents: which skill a message is for, and its goal."""

from __future__ import annotations

from functools import partial
from typing import Any
from uuid import UUID

from a2a.types import Message, Part, SendMessageRequest
from a2a.utils.errors import ContentTypeNotSupportedError, InvalidParamsError

from fibaction.border.peer_text import excerpt
from fibaction.schema.payload import PayloadError
from fibaction.schema.turns import in_turn
from fibaction.words.goals import NO_GOAL, GoalID
from fibaction_transports.a2a.a2a_values import LARGEST, has_inexact, plain_of
from fibaction_transports.a2a.agent_card import Skill, Skills

SKILL = "skill"
"""The key in the metadata of a message, or of its request, for the ID of the skill."""


def skill_of(request: SendMessageRequest, skills: Skills) -> Skill:
    """Return the skill that a message is for.

    Raises:
        InvalidParamsError: It names none that is here.
    """
    known = skills.by_label
    names = ", ".join(sorted(known)) or "none"
    for metadata in (request.message.metadata, request.metadata):
        if SKILL in metadata:
            named = metadata[SKILL]
            if isinstance(named, str) and named in known:
                return known[named]
            text = excerpt(named if isinstance(named, str) else "that is no text")
            raise InvalidParamsError(f"there is no skill {text!r} now; there are: {names}")
    if len(known) != 1:
        raise InvalidParamsError(
            f"name the skill in the metadata of the message, as {SKILL!r}; there are: {names}"
        )
    return next(iter(known.values()))


async def goal_of(message: Message, skill: Skill) -> Any:
    """Return the goal in a message, with its defaults.

    Raises:
        ContentTypeNotSupportedError: It is not one part with data; or with text, for a skill whose
            goals are text; or an empty text, for one that needs no goal.
        InvalidParamsError: The data is not a goal of the action.
    """
    given = _given(list(message.parts), skill)
    try:
        goal = await in_turn(None, partial(skill.goals.complete, given))
    except PayloadError as exc:
        raise InvalidParamsError(f"the goal was not sent: {exc}") from exc
    if has_inexact(goal):
        raise InvalidParamsError(
            f"the goal was not sent: it has a whole number of {LARGEST} or more, which A2A does not"
            f" carry exactly"
        )
    return goal


def _given(parts: list[Part], skill: Skill) -> Any:
    kinds = [part.WhichOneof("content") for part in parts]
    if kinds == ["data"]:
        try:
            return plain_of(parts[0].data)
        except ValueError as exc:
            raise InvalidParamsError(f"the goal was not sent: {exc}") from exc
    if kinds == ["text"] and skill.takes_text:
        return parts[0].text
    if kinds == ["text"] and not parts[0].text.strip() and not skill.goals.needs_goal:
        return {}
    wanted = "data, or one with text" if skill.takes_text else "data"
    raise ContentTypeNotSupportedError(
        f"a message to the skill {skill.label} has one part with {wanted}, which is the goal"
    )


def goal_id_of(message: Message) -> GoalID:
    """Return the ID of the goal that a message sends: the message's own, if that is a UUID.

    So a message that is sent again, because its answer was lost, does not send a second goal.
    """
    try:
        goal_id = GoalID(UUID(message.message_id).bytes)
    except ValueError:
        goal_id = NO_GOAL
    return GoalID.random() if goal_id == NO_GOAL else goal_id
