"""Templates of goals, made from the JSON Schema of an action, to be filled in.

The schema comes from a server: nothing is fetched, and the work is limited.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from itertools import islice
from typing import Any

from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.yaml_text import as_yaml
from fibaction.schema.template import FORMATS, Template
from fibaction.words.plain_data import is_map, is_number, quoted

MAX_VALUES = 10
"""Values of an enumeration that are named."""
MAX_CHARACTERS = 1000
"""Characters of a template that the shell completes."""

_SHELL_SAFE = re.compile(r'[A-Za-z0-9_ {}\[\]:,."+/-]*', re.ASCII)
"""The characters that mean themselves between single quotes, whatever a shell does with them."""

_KINDS = {"integer": "a whole number", "number": "a number", "string": "text", "array": "a list"}


class GoalTemplate:
    """A goal with a value for each field: its default, or the empty value of its type."""

    def __init__(self, schema: dict[str, Any]) -> None:
        """Make the template of a schema; of one that cannot be used, it is an empty goal."""
        self._template = Template(schema)
        self.goal: Any = self._template.value
        """The goal as plain data."""

    def lines(self) -> Iterator[str]:
        """Yield the template as lines of YAML, with what is known of each field beside it."""
        if not (is_map(self.goal) and self.goal):
            yield as_yaml(self.goal)
            return
        for name, value in self.goal.items():
            first, *others = as_yaml({name: value}).split("\n")
            about = self._about(name)
            yield f"{first}  # {about}" if about else first
            yield from others

    def for_shell(self) -> str:
        """Return the template on one line; empty if a shell could change it, or it is too long."""
        try:
            text = json.dumps(self.goal)
        except (TypeError, RecursionError):  # a default of the server that is not JSON
            return ""
        if len(text) > MAX_CHARACTERS or not _SHELL_SAFE.fullmatch(text):
            return ""
        return text

    def _about(self, name: str) -> str:
        """Return the kind and the description of a field, and whether it is optional."""
        part = self._template.fields.get(name)
        if not is_map(part):
            return ""
        target = self._template.resolved(part)
        kind = _KINDS.get(str(target.get("type")), "")
        enum = target.get("enum")
        if enum:
            kind = f"one of {', '.join(quoted(one) for one in islice(enum, MAX_VALUES))}"
        elif target.get("contentEncoding") == "base64":
            kind = "bytes in base64"
        elif target.get("format") in FORMATS:
            kind = str(target["format"])
        limits = [
            f"{word} {target[keyword]}"
            for keyword, word in (
                ("minimum", "at least"),
                ("maximum", "at most"),
                ("exclusiveMinimum", "more than"),
                ("exclusiveMaximum", "less than"),
            )
            if is_number(target.get(keyword))
        ]
        optional = [] if name in self._template.required else ["optional"]
        about = ", ".join(filter(None, [kind, *limits, *optional]))
        description = part.get("description", target.get("description", ""))
        texts = [about, description.partition("\n")[0] if isinstance(description, str) else ""]
        return excerpt(": ".join(filter(None, texts)))
