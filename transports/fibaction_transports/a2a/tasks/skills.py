"""`Skill`: an action as a skill of an agent."""

from __future__ import annotations

from a2a.types import AgentSkill

from fibaction.border.abc import Connection
from fibaction.border.peer_text import excerpt, shortened
from fibaction.schema.payload import JsonCodec, to_json
from fibaction.schema.template import Template
from fibaction.types.action import ActionInfo
from fibaction_transports._agents.robot_actions import RobotAction, RobotActions

JSON = "application/json"
TEXT = "text/plain"
LONGEST_DESCRIPTION = 1000
"""Characters of a description that a server gives."""
LONGEST_SCHEMA = 4000
"""Characters of a schema in the description of a skill; of a longer one only the card's extension
tells."""


class Skill(RobotAction):
    """One action that is served now, and the skill that it is; the ID of the skill is the label."""

    def __init__(self, server: str, info: ActionInfo, connection: Connection, label: str):
        super().__init__(server, info, connection, label)
        self.feedback = JsonCodec(info.feedback, "feedback")
        self.result = JsonCodec(info.result, "result")
        self._template = Template(dict(info.goal))
        self._type = self._template.resolved(info.goal) if self._template.is_usable else {}
        self.takes_text = self._type.get("type") == "string"
        """True if a goal is plain text."""

    def in_card(self, *, is_asked: bool) -> AgentSkill:
        """Return the skill for an agent card; with `is_asked`, the user is asked before a goal."""
        info = self.info
        text = f"Send a goal to the action {self.title}."
        described = self._type.get("description", "")
        if isinstance(described, str) and described:
            text += f" {shortened(described, LONGEST_DESCRIPTION)}"
        if is_asked:
            text += " A user must agree before the goal is sent."
        schema = to_json(info.goal)
        if len(schema) <= LONGEST_SCHEMA:
            text += f" The goal is a data part of this JSON Schema: {schema}"
        template = self._template
        kind = excerpt(info.type_name)
        return AgentSkill(
            id=self.label,
            name=self.title,
            description=text,
            tags=["action", *([kind] if kind else [])],
            examples=[to_json(template.value)] if template.is_usable else [],
            input_modes=[JSON, TEXT] if self.takes_text else [JSON],
            output_modes=[JSON],
        )


Skills = RobotActions[Skill]
