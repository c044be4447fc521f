"""The values that the arguments of ROS give to parameters, and those of one node among them.

They come by `-p`, and by files with `--params-file`:

    /robot/arm:
      ros__parameters:
        use_sim_time: true

A file may be about many nodes, of which others read the rest. The rules are those of rcl: `*` in
the name of a node is any one name, and `**` is any number of names; of several values of a
parameter, the last one counts. It does so by the place where its nodes were first named.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from fibaction.border.peer_text import excerpt
from fibaction.words.errors import TransportError
from fibaction.words.extras import MissingExtra, NeedsExtra

ALL_NODES: Final = "/**"
_KEY = "ros__parameters"
_FORM = f"expected the names of nodes, each with {_KEY} and its parameters"
_NODES = re.compile(r"(/(\*\*?|[A-Za-z_][A-Za-z0-9_]*))+", re.ASCII)
_ANY = {"*": r"/\w+", "**": r"(/\w+)*"}


class Override(NamedTuple):
    """A value that a parameter is to have from the beginning."""

    nodes: str
    """The nodes that it is for: a full name, which may have `*` and `**` in it."""
    name: str
    value: object
    """Text, as YAML has it; lists and dicts of such values from a file."""
    origin: str
    """The words that begin an error about it."""


def overrides_of(node: str, overrides: Iterable[Override]) -> dict[str, Override]:
    """Return those that are for a node, which has this full name, by the names of parameters."""
    by_nodes: dict[str, dict[str, Override]] = {}
    for one in overrides:
        by_nodes.setdefault(one.nodes, {})[one.name] = one
    found: dict[str, Override] = {}
    for nodes, named in by_nodes.items():
        if _pattern(nodes).fullmatch(node):
            found |= named
    return found


def _pattern(nodes: str) -> re.Pattern[str]:
    parts = nodes.removeprefix("/").split("/")
    return re.compile("".join(_ANY.get(part, f"/{re.escape(part)}") for part in parts), re.ASCII)


def read_parameters_file(path: str) -> list[Override]:
    """Read a file of parameters.

    Raises:
        TransportError: The file cannot be read, is not such a file, or PyYAML is not installed.
    """
    what = f"--params-file {excerpt(path)!r}"
    try:
        return list(_overrides("", _content(path), what))
    except MissingExtra as exc:
        raise TransportError(str(exc)) from exc
    except OSError as exc:
        raise TransportError(f"{what}: {exc.strerror}") from exc
    except RecursionError as exc:
        raise TransportError(f"{what}: too many levels") from exc
    except ValueError as exc:
        raise TransportError(f"{what}: {' '.join(str(exc).split())}") from exc


def _content(path: str) -> Any:
    with NeedsExtra("--params-file", "fibaction[cli]"):
        import yaml
    try:
        with Path(path).open("rb") as file:
            for event in yaml.parse(file, yaml.BaseLoader):
                if isinstance(event, yaml.AliasEvent):
                    raise ValueError(f"it has the alias *{event.anchor}, as no file for ROS may")
            file.seek(0)
            # Texts only: which of them are numbers is not asked here.
            return yaml.load(file, yaml.BaseLoader) or {}
    except yaml.YAMLError as exc:
        raise ValueError(f"not valid YAML: {exc}") from exc


def _overrides(nodes: str, content: Any, what: str) -> Iterator[Override]:
    for key, value in _mapping(nodes, content).items():
        if key != _KEY:
            yield from _overrides(f"{nodes}/{key.removeprefix('/')}", value, what)
        elif not _NODES.fullmatch(nodes):
            raise ValueError(f"{nodes!r} is not the name of a node: {_FORM}")
        else:
            for name, given in _mapping(nodes, value).items():
                told = f"{name} is {excerpt(str(given))!r} in {what}"
                yield Override(nodes, name, given, told)


def _mapping(nodes: str, content: Any) -> dict[str, Any]:
    if isinstance(content, dict):
        return cast(dict[str, Any], content)
    raise ValueError(f"{excerpt(str(content))!r} at {nodes or 'its top'}: {_FORM}")
