"""The actions of a robot as the source of one Python module."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from fibaction.interfaces.definitions import InterfaceError
from fibaction.interfaces.files import ActionFile, InterfaceMessage, read_action_texts
from fibaction.interfaces.source import module_source
from fibaction.interfaces.structs import make_structs

_ABOUT = (
    '"""The actions of a robot, and their messages.',
    "",
    "Written by `fibaction gen --from-robot`.",
    "If the types of the robot change, write it again.",
    '"""',
)


class RobotSource:
    """Collects actions, and writes them into one module. They may share messages."""

    def __init__(self) -> None:
        self._actions: list[ActionFile] = []
        self._fields: dict[str, Sequence[object]] = {}
        """The fields of all messages, by their types."""

    def __len__(self) -> int:
        return len(self._actions)

    def add(self, name: str, type_name: str, texts: Mapping[str, str]) -> None:
        """Add an action, by the texts of its interface files.

        Raises:
            InterfaceError: A text is malformed, or defines another version of a type that an
                earlier action has.
        """
        action = read_action_texts(type_name, texts, name=name)
        own = {one.type_name: _fields(one) for one in action.messages()}
        for one, fields in own.items():
            if self._fields.get(one, fields) != fields:
                problem = f"expected {one} as in the other actions, found another version of it"
                raise InterfaceError(action.path, 1, problem)
        make_structs(action)  # raises now what the module would raise on import
        self._fields |= own
        self._actions.append(action)

    def source(self) -> str:
        """Return the source of the module."""
        return module_source(_united(self._actions), _ABOUT)


def _fields(message: InterfaceMessage) -> Sequence[object]:
    """Return what two definitions of one message must have in common."""
    return [
        (field.name, field.type._replace(package=""), nested.type_name if nested else "")
        for field in message.definition.fields
        for nested in (message.nested.get(field.name),)
    ]


def _united(actions: Sequence[ActionFile]) -> list[ActionFile]:
    """Return the actions with class names that are unique among all their messages."""
    found = {one.type_name: one for action in actions for one in action.messages()}
    namesakes = Counter(one.definition.name for one in found.values())
    made: dict[str, InterfaceMessage] = {}

    def united(one: InterfaceMessage) -> InterfaceMessage:
        if one.type_name not in made:
            name = one.definition.name
            made[one.type_name] = one._replace(
                class_name=f"{one.package}_{name}" if namesakes[name] > 1 else name,
                nested={field: united(nested) for field, nested in one.nested.items()},
            )
        return made[one.type_name]

    return [
        action._replace(
            goal=united(action.goal),
            result=united(action.result),
            feedback=united(action.feedback),
        )
        for action in actions
    ]
