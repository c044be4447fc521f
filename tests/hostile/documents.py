"""The JSON documents that cost the most for their size, and the actions that they are goals of."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec

from fibaction import Action


class Tree(msgspec.Struct):
    """A goal that may contain itself, and whose fields all have defaults."""

    kids: list[Tree] = []
    left: Tree | None = None
    name: str | None = None
    size: int | None = None


TREE = Action("tree", goal=Tree, feedback=str, result=int)
NUMBERS = Action("numbers", goal=list[float], feedback=str, result=int)
ANYTHING = Action("anything", goal=dict[str, Any], feedback=str, result=int)


class Document(NamedTuple):
    """A document of any size."""

    action: str
    head: str
    item: str
    """What it has very often."""
    tail: str
    is_goal: bool = True
    """True if the action accepts it."""

    def text(self, size: int) -> str:
        """Return the document with nearly so many bytes."""
        room = size - len(self.head) - len(self.tail)
        items = [self.item] * (room // (len(self.item) + 1))
        return f"{self.head}{','.join(items)}{self.tail}"


def nested(levels: int) -> str:
    """Return a goal of `tree` in which each has two within it."""
    return "{}" if not levels else f'{{"kids":[{nested(levels - 1)},{nested(levels - 1)}]}}'


DOCUMENTS: dict[str, Document] = {
    "empty objects": Document("tree", '{"kids":[', "{}", "]}"),
    "objects in objects": Document("tree", '{"kids":[', '{"left":{"left":{}}}', "]}"),
    "a wide tree": Document("tree", '{"kids":[', nested(10), "]}"),
    "nulls": Document("tree", '{"kids":[', '{"left":null,"name":null}', "]}"),
    "a wrong end": Document("tree", '{"kids":[', "{}", ',{"left":5}]}', is_goal=False),
    "a wrong field": Document("tree", '{"more":5,"kids":[', "{}", "]}", is_goal=False),
    "nothing right": Document("tree", '{"kids":[', "5", "]}", is_goal=False),
    "floats": Document("numbers", "[", "1.5", "]"),
    "floats of 308 digits": Document("numbers", "[", "1e308", "]"),
    "whole numbers": Document("numbers", "[", "1", "]"),
    "a wrong number": Document("numbers", "[", "1", ',"x"]', is_goal=False),
    "empty lists": Document("anything", '{"a":[', "[]", "]}"),
}
"""Documents by what they consist of."""
