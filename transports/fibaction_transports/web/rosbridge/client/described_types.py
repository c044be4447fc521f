"""`DescribedTypes`: the JSON Schemas of action types, as rosapi describes them.

rosapi of rosbridge_suite may end when it is asked for a type that it cannot import. So it is asked
first which types it knows. It is asked for each type once in a connection, as long as there are not
too many, and not again after a call without an answer.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple, TypeVar

import anyio
import msgspec

from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.words.plain_data import is_map
from fibaction_transports.web.rosbridge.client.link import CallFailed, NoAnswer
from fibaction_transports.web.rosbridge.types.type_details import TypeDefinition
from fibaction_transports.web.rosbridge.types.type_schemas import schema_of

MOST_TYPES = 1000
"""Types whose schemas are kept. Beyond, the oldest is dropped, since a server may name new types
without end."""

logger = clean_logger("fibaction.web")


class ActionSchemas(NamedTuple):
    """The schemas of one action type; empty where they are not known."""

    goal: dict[str, Any]
    feedback: dict[str, Any]
    result: dict[str, Any]


AnswerT = TypeVar("AnswerT")

UNKNOWN = ActionSchemas({}, {}, {})


def field_of(values: object, name: str, kind: type[AnswerT]) -> AnswerT:
    """Return a field of an answer of rosapi.

    Raises:
        msgspec.ValidationError: It is not of that kind.
    """
    return msgspec.convert(values.get(name) if is_map(values) else None, kind)


class DescribedTypes:
    """The schemas of the action types of one connection."""

    def __init__(
        self, call: Callable[[str, dict[str, Any]], Awaitable[Any]], most: int = MOST_TYPES
    ) -> None:
        """Let `call` call a service."""
        self._call = call
        self._most = most
        self._names: frozenset[str] = frozenset()
        self._found: dict[str, ActionSchemas] = {"": UNKNOWN}
        self._has_answered = True
        self._asking = anyio.Lock()

    async def schemas_of(self, type_name: str) -> ActionSchemas:
        """Return the schemas of a type; empty ones if rosapi does not describe it.

        Raises:
            ActionError: The connection has ended.
        """
        async with self._asking:
            if type_name not in self._found:
                found = await self._asked(type_name)
                if len(self._found) >= self._most:
                    del self._found[next(iter(self._found))]
                self._found[type_name] = found
            return self._found[type_name]

    async def _asked(self, type_name: str) -> ActionSchemas:
        if not self._has_answered:
            return UNKNOWN
        try:
            if type_name not in self._names:
                self._names = await self._interfaces()
            return await self._details(type_name) if type_name in self._names else UNKNOWN
        except NoAnswer as exc:
            logger.info("types of actions are not described: %s", excerpt(str(exc)))
            self._has_answered = False
            return UNKNOWN

    async def _interfaces(self) -> frozenset[str]:
        try:
            values = await self._call("/rosapi/interfaces", {})
            return frozenset(field_of(values, "interfaces", list[str]))
        except (CallFailed, msgspec.ValidationError) as exc:
            logger.info("types of actions are not described: %s", excerpt(str(exc)))
            return frozenset()

    async def _details(self, type_name: str) -> ActionSchemas:
        schemas: list[dict[str, Any]] = []
        for part in ActionSchemas._fields:
            try:
                values = await self._call(f"/rosapi/action_{part}_details", {"type": type_name})
                schemas.append(schema_of(field_of(values, "typedefs", list[TypeDefinition])))
            except (CallFailed, msgspec.ValidationError) as exc:
                text = f"the {part} of {type_name} is not described: {exc}"
                logger.info("%s", excerpt(text))
                schemas.append({})
        return ActionSchemas(*schemas)
