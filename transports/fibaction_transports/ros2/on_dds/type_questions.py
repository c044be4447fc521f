"""The questions of a node about the types of actions, by TypeLookup of XTypes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import anyio

from fibaction_transports.ros2.node.parts import EndInfo
from fibaction_transports.ros2.node.rivals import PARTICIPANT
from fibaction_transports.ros2.on_dds.type_objects import TypeObject, read_types
from fibaction_transports.ros2.without_ros.descriptions.description_messages import (
    FieldDescription,
    IndividualTypeDescription,
    UnusableDescription,
)
from fibaction_transports.ros2.without_ros.descriptions.type_learner import ActionQuestions
from fibaction_transports.ros2.without_ros.messages.message_type import ros_type
from fibaction_transports.rtps.events import TypesAnswered

AT_ONCE: Final = 10
"""Types in one question."""
MOST_TYPES: Final = 300
"""Types that an action may nest."""


class TypeQuestions(ActionQuestions):
    """The questions of a node about types, by TypeLookup of XTypes.

    Nodes on Fast DDS 3, as of ROS 2 Kilted, tell the types of all messages in this way, those of
    requests and answers among them: so goals and results, too.
    """

    def __init__(self, ask: Callable[[bytes, Sequence[bytes]], int]) -> None:
        """`ask` sends a question to a participant, and returns its number, or 0 if it cannot."""
        self._ask = ask
        self._waiting: dict[int, tuple[bytes, anyio.Event]] = {}
        self._answers: dict[int, bytes] = {}

    def take(self, event: TypesAnswered) -> None:
        """Take an answer, if it is waited for."""
        prefix, is_answered = self._waiting.get(event.number, (b"", None))
        if is_answered is not None and prefix == event.prefix:
            self._answers[event.number] = event.types
            is_answered.set()

    def can_ask(self, ends: Sequence[EndInfo]) -> bool:
        type_ids = {one.type_id for one in ends}
        return len(type_ids) == len(ends) and b"" not in type_ids

    async def look_up(
        self, ends: Sequence[EndInfo], type_name: str
    ) -> dict[str, IndividualTypeDescription]:
        prefix = ends[0].gid[PARTICIPANT]
        known: dict[bytes, TypeObject] = {}
        wanted = dict.fromkeys(one.type_id for one in ends)
        while missing := [one for one in wanted if one not in known][:AT_ONCE]:
            found = read_types(await self._answer(prefix, missing))
            for one in missing:
                if one not in found:
                    raise UnusableDescription("it does not tell a type that it was asked for")
                known[one] = found[one]
                wanted |= {field.nested: None for field in found[one].fields if field.nested}
            if len(wanted) > MOST_TYPES:
                raise UnusableDescription(f"it nests more than {MOST_TYPES} types")
        return {ros_type(one.name): _described(one, known) for one in known.values()}

    async def _answer(self, prefix: bytes, type_ids: Sequence[bytes]) -> bytes:
        number = self._ask(prefix, type_ids)
        if not number:
            raise UnusableDescription("its participant does not answer questions about types")
        is_answered = anyio.Event()
        self._waiting[number] = prefix, is_answered
        try:
            await is_answered.wait()
            return self._answers[number]
        finally:
            del self._waiting[number]
            self._answers.pop(number, None)


def _described(found: TypeObject, known: dict[bytes, TypeObject]) -> IndividualTypeDescription:
    fields: list[FieldDescription] = []
    for name, field_type, nested in found.fields:
        if nested:
            field_type.nested_type_name = ros_type(known[nested].name)
        fields.append(FieldDescription(name, field_type))
    return IndividualTypeDescription(ros_type(found.name), fields)
