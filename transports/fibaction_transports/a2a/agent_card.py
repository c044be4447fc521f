"""`CardMaker` and `Skill`: the agent card, with one skill for each action.

The card without a token tells how to get in, and no skills: the names and types of a robot's
actions are for its clients. With the token, the same path has the whole card, which is also what
`GetExtendedAgentCard` answers.
"""

from __future__ import annotations

from typing import Any

from a2a.types import (
    AgentCapabilities,
    AgentCard,
    AgentExtension,
    AgentInterface,
    AgentSkill,
    HTTPAuthSecurityScheme,
    SecurityRequirement,
    SecurityScheme,
    StringList,
)
from a2a.utils.constants import PROTOCOL_VERSION_0_3, PROTOCOL_VERSION_1_0, TransportProtocol

from fibaction import __version__
from fibaction.border.abc import Connection
from fibaction.border.peer_text import excerpt, shortened
from fibaction.schema.payload import JsonCodec, to_json
from fibaction.schema.template import Template
from fibaction.types.action import ActionInfo
from fibaction_transports._agents.robot_actions import AgentPolicy, RobotAction, RobotActions
from fibaction_transports.a2a.documents import struct_of

EXTENSION = "urn:fibaction:goals:1"
"""The identifier of the extension that the card declares: goals as tasks."""
BEARER = "token"
JSON = "application/json"
TEXT = "text/plain"
LONGEST_DESCRIPTION = 1000
"""Characters of a description that a server gives."""
LONGEST_SCHEMA = 4000
"""Characters of a schema in the description of a skill; of a longer one only the card's extension
tells."""

_DESCRIPTION = (
    "Actions of robots, devices and long jobs. A goal may move something. A task is one goal: send"
    " a message with one part, the goal as data or as JSON text, and the ID of the skill in its"
    ' metadata as "skill"; or both in the part: {"skill": ..., "goal": ...}.'
)
_READ_ONLY = " Only the tasks of others can be followed here: nothing is sent or canceled."
_HIDDEN = "The skills are in the card that is sent with the token."
_RESUMING = (
    "Updates have a number and an event_id in their metadata; SubscribeToTask with the last"
    " event_id in the header Last-Event-ID continues after it, even after the end of the task."
)


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
        self.text_field = self._text_field()
        """The only field that a goal needs, or has, if it is text; empty if it is not so."""
        self.example: Any = self._template.value
        """A goal with the defaults."""

    def _text_field(self) -> str:
        fields = self._template.required or list(self._template.fields)
        kinds = [self._template.resolved(self._template.fields.get(one)) for one in fields]
        is_text = [kind.get("type") for kind in kinds] == ["string"]
        return fields[0] if is_text else ""

    def in_card(self, *, is_asked: bool) -> AgentSkill:
        """Return the skill for an agent card; with `is_asked`, the user is asked before a goal."""
        info = self.info
        text = f"Send a goal to the action {self.title}."
        if info.description:
            text += f" {shortened(info.description, LONGEST_DESCRIPTION)}"
        if is_asked:
            text += " A user must agree before the goal is sent."
        if not self.goals.needs_goal:
            text += " It needs no goal: an empty text will do."
        schema = to_json(info.goal)
        if len(schema) <= LONGEST_SCHEMA:
            text += f" The goal is data, or JSON text, of this JSON Schema: {schema}"
        template = self._template
        kind = excerpt(info.type_name)
        return AgentSkill(
            id=self.label,
            name=self.title,
            description=text,
            tags=["action", *([kind] if kind else [])],
            examples=[to_json(template.value)] if template.is_usable else [],
            input_modes=[JSON, TEXT],
            output_modes=[JSON],
        )


Skills = RobotActions[Skill]


class CardMaker:
    """The cards of one server."""

    def __init__(self, skills: Skills, policy: AgentPolicy) -> None:
        self._skills = skills
        self._policy = policy

    def card(self, url: str, *, is_known: bool) -> AgentCard:
        """Return the card for a server at that URL, for a client that is known or not."""
        scheme = SecurityScheme(http_auth_security_scheme=HTTPAuthSecurityScheme(scheme="Bearer"))
        read_only = _READ_ONLY if self._policy.read_only else ""
        card = AgentCard(
            name="fibaction",
            description=_DESCRIPTION + read_only,
            version=__version__,
            supported_interfaces=[
                AgentInterface(
                    url=url,
                    protocol_binding=TransportProtocol.JSONRPC,
                    protocol_version=version,
                )
                for version in (PROTOCOL_VERSION_1_0, PROTOCOL_VERSION_0_3)
            ],
            capabilities=AgentCapabilities(
                streaming=True, push_notifications=False, extended_agent_card=True
            ),
            security_schemes={BEARER: scheme},
            security_requirements=[SecurityRequirement(schemes={BEARER: StringList()})],
            default_input_modes=[JSON, TEXT],
            default_output_modes=[JSON],
        )
        if is_known:
            self._add_skills(card)
        if not card.skills:  # a card has at least one
            text = "No action is served now." if is_known else _HIDDEN
            card.skills.append(
                AgentSkill(id="none", name="Actions", description=text, tags=["action"])
            )
        return card

    def _add_skills(self, card: AgentCard) -> None:
        schemas: dict[str, object] = {}
        for name, skill in sorted(self._skills.by_label.items()):
            info = skill.info
            asks = self._policy.asks(skill.server, info.name)
            card.skills.append(skill.in_card(is_asked=asks))
            schemas[name] = {"goal": info.goal, "feedback": info.feedback, "result": info.result}
        extension = AgentExtension(
            uri=EXTENSION, description=_RESUMING, params=struct_of({"schemas": schemas})
        )
        card.capabilities.extensions.append(extension)
