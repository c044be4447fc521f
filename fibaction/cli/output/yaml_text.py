"""Values as YAML text in block style, as `ros2 action` prints them."""

from __future__ import annotations

import base64
import datetime
import math
import textwrap
from collections.abc import Collection, Iterator
from typing import Any

import yaml
from msgspec.msgpack import Ext

from fibaction.cli.output.escape import clean_lines
from fibaction.words.plain_data import is_list, is_map

MAX_ITEMS = 128
"""Items of a list that are shown by default; `ros2 topic echo` shows as many."""
MAX_CHARACTERS = 1000
"""Characters of a text, or bytes, that are shown by default."""
MAX_VALUES = 10_000
"""Values of a message that are shown by default, those within others included."""
MAX_VALUES_IN_FULL = 200_000
"""Values that are shown in full: PyYAML needs some 100 MB and some seconds for them."""
MAX_DEPTH = 50
"""Levels of nesting that are shown. PyYAML cannot go on beyond Python's limit of recursion."""


class _Style(yaml.representer.SafeRepresenter):
    """Rules for PyYAML: no aliases, and double quotes for bytes and unprintable text."""

    def ignore_aliases(self, data: object) -> bool:
        return True

    def represent_text(self, data: str) -> yaml.Node:
        # In double quotes, `clean_lines` escapes as YAML does.
        style = None if data.isprintable() else '"'
        return yaml.ScalarNode("tag:yaml.org,2002:str", data, style=style)

    def represent_bytes(self, data: bytes) -> yaml.Node:
        text = base64.b64encode(data).decode()
        return yaml.ScalarNode("tag:yaml.org,2002:binary", text, style='"')


_Style.add_representer(str, _Style.represent_text)
_Style.add_representer(bytes, _Style.represent_bytes)


class _Dumper(_Style, yaml.SafeDumper):
    pass


class _FastDumper(_Style, getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]  # found at run time: not every build of PyYAML has libyaml
    pass


def as_yaml(value: Any, *, full: bool = False, indent: int = 0) -> str:
    """Return the value as YAML text that cannot control a terminal.

    Without `full`, long lists, maps, texts and bytes are cut, and say how much is left out.
    """
    if full:
        cut = _Cut(math.inf, math.inf, MAX_VALUES_IN_FULL)
    else:
        cut = _Cut(MAX_ITEMS, MAX_CHARACTERS, MAX_VALUES)
    data = cut.value(value, 0)
    text = _dump(data, _FastDumper)
    if "\\U" in text:  # libyaml escapes emoji, PyYAML by itself does not
        text = _dump(data, _Dumper)
    return textwrap.indent(clean_lines(text), " " * indent)


def _dump(data: Any, dumper: Any) -> str:
    untyped: Any = yaml  # a part of the type of its `dump` is unknown to checkers
    text: str = untyped.dump(
        data,
        Dumper=dumper,
        allow_unicode=True,
        default_flow_style=False,
        sort_keys=False,
        width=2**30,  # no scalar is folded
    )
    # A mark of the document's end follows a single scalar.
    return text.removesuffix("...\n").removesuffix("\n")


class _Cut:
    """The limits of what is shown, and the plain data within them."""

    def __init__(self, max_items: float, max_characters: float, max_values: int) -> None:
        self._max_items = max_items
        self._max_characters = max_characters
        self._left = max_values

    def value(self, value: Any, depth: int) -> Any:
        """Return what is shown of a value."""
        if depth > MAX_DEPTH:
            return f"... deeper than {MAX_DEPTH} levels"
        self._left -= 1
        if is_map(value):
            return self._map(value, depth)
        if is_list(value):
            return self._list(value, depth)
        return self._scalar(value)

    def _map(self, fields: dict[Any, Any], depth: int) -> dict[Any, Any]:
        shown: dict[Any, Any] = {}
        more = len(fields)
        for key in self._some_of(fields):
            shown[self._scalar(key)] = self.value(fields[key], depth + 1)
            more -= 1
        return {**shown, "...": f"and {more} more"} if more else shown

    def _list(self, items: Collection[Any], depth: int) -> list[Any]:
        shown = [self.value(item, depth + 1) for item in self._some_of(items)]
        more = len(items) - len(shown)
        return [*shown, f"... and {more} more"] if more else shown

    def _some_of(self, values: Collection[Any]) -> Iterator[Any]:
        for index, value in enumerate(values):
            if index >= self._max_items or self._left <= 0:
                return
            yield value

    def _scalar(self, value: Any) -> Any:
        if value is None or isinstance(value, bool | int | float | datetime.date):
            return value
        if isinstance(value, Ext):
            return f"extension {value.code}: {base64.b64encode(value.data).decode()}"
        whole = value if isinstance(value, bytes) else str(value)
        more = len(whole) - self._max_characters
        if more <= 0:
            return whole
        shown = whole[: int(self._max_characters)]
        if isinstance(shown, bytes):
            return f"{base64.b64encode(shown).decode()}... and {more} more bytes"
        return f"{shown}... and {more} more characters"
