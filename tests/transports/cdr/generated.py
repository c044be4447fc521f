"""Definitions of messages that hypothesis makes, and values for them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hypothesis import strategies as st

from fibaction.interfaces.definitions import FieldType
from fibaction.interfaces.files import InterfaceMessage
from fibaction.interfaces.ros_types import attribute
from fibaction.interfaces.structs import is_bytes
from tests.transports.cdr.definitions import Goal

_INTEGERS = {
    f"{sign}int{bits}": st.integers(
        0 if sign else -(2 ** (bits - 1)), 2**bits - 1 if sign else 2 ** (bits - 1) - 1
    )
    for sign in ("", "u")
    for bits in (8, 16, 32, 64)
}
_TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=6)
_SINGLES: dict[str, st.SearchStrategy[Any]] = {
    **_INTEGERS,
    "bool": st.booleans(),
    "byte": st.integers(0, 255),
    "char": st.integers(0, 255),
    "float32": st.floats(width=32, allow_nan=False),
    "float64": st.floats(allow_nan=False),
    "string": _TEXT,
    "wstring": _TEXT,
}
_ENDS = ["", "", "", "[]", "[3]", "[<=2]"]


def values_of(message: InterfaceMessage, structs: Mapping[str, Any]) -> st.SearchStrategy[Any]:
    """Return values of a message; the structs are those of its codec."""
    fields: dict[str, st.SearchStrategy[Any]] = {}
    for field in message.definition.fields:
        kind = field.type
        nested = message.nested.get(field.name)
        one = _single(kind) if nested is None else values_of(nested, structs)
        if kind.is_array:
            least, most = kind.size or 0, kind.size or kind.bound or 3
            if is_bytes(kind):
                one = st.binary(min_size=least, max_size=most)
            else:
                one = st.lists(one, min_size=least, max_size=most)
        fields[attribute(field.name)] = one
    return st.builds(structs[message.class_name], **fields)


def _single(kind: FieldType) -> st.SearchStrategy[Any]:
    values = _SINGLES[kind.base]
    return values if kind.characters is None else values.map(lambda text: text[: kind.characters])


class GeneratedGoal(Goal):
    """A goal of a generated definition."""

    @property
    def values(self) -> st.SearchStrategy[Any]:
        """Values of the goal."""
        return values_of(self.message, self.structs)


@st.composite
def goals(draw: st.DrawFn) -> GeneratedGoal:
    """Make a goal that nests two levels of messages."""
    kinds = [*_SINGLES, "string<=3"]
    messages: dict[str, str] = {}
    for name in ("Innermost", "Inner"):
        messages[f"made_msgs/{name}"] = draw(_fields(kinds))
        kinds.append(name)
    return GeneratedGoal(draw(_fields(kinds)), messages)


def _fields(kinds: list[str]) -> st.SearchStrategy[str]:
    one = st.tuples(st.sampled_from(kinds), st.sampled_from(_ENDS)).map("".join)
    return st.lists(one, max_size=6).map(
        lambda types: "\n".join(f"{kind} f{index}" for index, kind in enumerate(types))
    )
