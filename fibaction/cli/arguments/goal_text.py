"""Goals as text: YAML, JSON or pairs that are read, and templates to fill in.

A schema comes from a server: nothing is fetched, and the work is limited.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from typing import Any, NoReturn, TypeAlias, cast

import yaml

from fibaction.border.abc import Meta
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.yaml_text import as_yaml
from fibaction.cli.process.exit_codes import Failure
from fibaction.schema.payload import GoalCodec, PayloadError
from fibaction.schema.template import FORMATS, Template
from fibaction.words.goal_query import Labels
from fibaction.words.meta import trace_meta, with_labels
from fibaction.words.plain_data import is_map, is_number, quoted

Pairs: TypeAlias = tuple[str, ...]
"""A goal as words such as `speed=1.5`, or `pose.x=1` for a field in a field."""

PAIR = re.compile(r"([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*):?=(.*)", re.ASCII | re.DOTALL)


def read_goal(text: str | Pairs, schema: dict[str, Any]) -> Any:
    """Return the goal as plain data that can be sent.

    Fields that are left out get their defaults from the schema; an empty text is the goal `{}`.
    Bytes are written in base64, or as YAML's `!!binary`; times in ISO 8601. In a pair, the value of
    a field with text is the text; any other is YAML.

    Raises:
        Failure: The text is not YAML, or the schema does not allow it; the message names the field.
    """
    if isinstance(text, tuple):
        template = Template(schema)
        takes_fields = template.fields or template.value == {}
        goal = _fields(text, template) if takes_fields else read_yaml(" ".join(text))
    else:
        goal = read_yaml(text)
    try:
        return GoalCodec(schema).complete(goal)
    except PayloadError as exc:
        # `{order:3}` is YAML for a field named "order:3".
        glued = any(re.search(r'has no field ".*:', problem) for problem in exc.problems)
        advice = "; in YAML, a space follows the colon" if glued else ""
        raise Failure(f"{exc}{advice}") from exc


def _fields(pairs: Pairs, template: Template) -> dict[str, Any]:
    """Return the goal that pairs tell.

    Raises:
        Failure: A value is not YAML, or a field is given twice.
    """
    goal: dict[str, Any] = {}
    for pair in pairs:
        found = PAIR.fullmatch(pair)
        assert found is not None
        *path, name = found[1].split(".")
        inner, fields = goal, template.fields
        for one in path:
            # Within a field that has a value already, each name is taken.
            inner = inner.setdefault(one, {}) if is_map(inner) else {name: inner}
            fields = template.resolved(fields.get(one)).get("properties", {})
        if not is_map(inner) or name in inner:
            raise Failure(f"the field {found[1]} is given twice")
        is_text = template.resolved(fields.get(name)).get("type") == "string"
        inner[name] = found[2] if is_text else read_yaml(found[2] or "null")
    return goal


def shell_meta(labels: Labels, *, is_detached: bool) -> Meta:
    """Return the meta of a goal with these labels, and with the trace that the environment
    variables TRACEPARENT and so on tell, as far as it fits.

    Raises:
        InvalidMessage: There are too many labels, or they are too large.
    """
    variables = {name.lower(): value for name, value in os.environ.items()}
    return with_labels(dict(labels), trace_meta(variables, is_detached=is_detached))


MAX_DIGITS = 100
"""Characters of a number. The longest ones take a long time, and no message can hold them."""


class _Loader(yaml.SafeLoader):
    """A YAML loader that reads `1e3` as a number, which YAML 1.1 reads as text, and times as text,
    because only the schema tells whether a field is a time.

    It reads no aliases: some lines of them can stand for more values than a computer can hold.
    """

    yaml_implicit_resolvers = {  # noqa: RUF012  # PyYAML's attribute, and it has no type there
        first: [pair for pair in pairs if pair[0] != "tag:yaml.org,2002:timestamp"]
        for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            mark = cast("Any", self).peek_event().start_mark
            self._reject("aliases such as *name are not supported", mark)
        return super().compose_node(parent, index)

    def construct_number(self, node: yaml.ScalarNode) -> int | float:
        if len(node.value) > MAX_DIGITS:
            text = f"a number with more than {MAX_DIGITS} digits"
            self._reject(text, node.start_mark)
        if node.tag.endswith("int"):
            return self.construct_yaml_int(node)
        return self.construct_yaml_float(node)

    def _reject(self, problem: str, mark: yaml.Mark) -> NoReturn:
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


for _kind in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _Loader.construct_number)

cast("Any", _Loader).add_implicit_resolver(  # the stub has no types for it
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)[eE][-+]?\d+"),
    list("-+0123456789."),
)


def read_yaml(text: str, what: str = "goal") -> Any:
    """Return the plain data in a text of YAML or JSON; that of an empty one is `{}`.

    Raises:
        Failure: The text is not YAML.
    """
    with suppress(ValueError, RecursionError):
        return json.loads(text)  # faster, and some JSON text is not YAML
    try:
        goal = yaml.load(text, _Loader)
        return {} if goal is None and yaml.compose(text, _Loader) is None else goal
    except yaml.MarkedYAMLError as exc:
        mark = exc.problem_mark or exc.context_mark
        where = f" (line {mark.line + 1}, column {mark.column + 1})" if mark else ""
        problem = ", ".join(filter(None, (exc.context, exc.problem)))
        raise Failure(f"the {what} is not valid YAML{where}: {problem}") from exc
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError) as exc:
        # PyYAML raises any of these for a value with a wrong tag, such as `!!int x`.
        raise Failure(f"the {what} is not valid YAML: {exc}") from exc


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
