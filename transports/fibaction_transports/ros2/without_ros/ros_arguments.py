"""The arguments of ROS on a command line, and the names that they change.

https://design.ros2.org/articles/ros_command_line_arguments.html has their form, and
https://design.ros2.org/articles/topic_and_service_names.html the rules for names.

Values of parameters come by `-p`, and by files with `--params-file`:

    /robot/arm:
      ros__parameters:
        use_sim_time: true

A file may be about many nodes, of which others read the rest. The rules are those of rcl: `*` in
the name of a node is any one name, and `**` is any number of names; of several values of a
parameter, the last one counts. It does so by the place where its nodes were first named.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from msgspec import Struct

from fibaction.border.peer_text import excerpt
from fibaction.words.errors import TransportError
from fibaction.words.extras import MissingExtra, NeedsExtra

ALL_NODES: Final = "/**"
MOST_LEVELS = 100
"""Levels of a file of parameters, which nests names of nodes and of parameters."""
LONGEST_NAME: Final = 247
"""Characters of a full name of a topic or a service, as ROS counts."""
_KEY = "ros__parameters"
_FORM = f"expected the names of nodes, each with {_KEY} and its parameters"
_NODES = re.compile(r"(/(\*\*?|[A-Za-z_][A-Za-z0-9_]*))+", re.ASCII)
_ANY = {"*": r"/\w+", "**": r"(/\w+)*"}


class NodeName(Struct, frozen=True):
    """The name of a node, and its namespace, which is `/` without one."""

    name: str
    namespace: str

    def __str__(self) -> str:
        return f"{self.namespace.rstrip('/')}/{self.name}"


class Override(NamedTuple):
    """A value that a parameter is to have from the beginning."""

    nodes: str
    """The nodes that it is for: a full name, which may have `*` and `**` in it."""
    name: str
    value: object
    """Text of YAML; lists of such texts from a file."""
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
            depth = 0
            for event in yaml.parse(file, yaml.BaseLoader):
                depth += isinstance(event, yaml.CollectionStartEvent)
                depth -= isinstance(event, yaml.CollectionEndEvent)
                if depth > MOST_LEVELS:  # PyYAML takes a time that is quadratic in the depth
                    raise RecursionError
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
            for name, given in _flat("", _mapping(nodes, value)):
                told = f"{name} is {excerpt(str(given))!r} in {what}"
                yield Override(nodes, name, given, told)


def _flat(prefix: str, content: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, given in content.items():
        if isinstance(given, dict):
            yield from _flat(f"{prefix}{name}.", cast(dict[str, Any], given))
        else:
            yield f"{prefix}{name}", given


def _mapping(nodes: str, content: Any) -> dict[str, Any]:
    if isinstance(content, dict):
        return cast(dict[str, Any], content)
    raise ValueError(f"{excerpt(str(content))!r} at {nodes or 'its top'}: {_FORM}")


_BEGIN, _END = "--ros-args", "--"
_IGNORED_WITH_VALUE = ("--log-level", "--log-config-file", "-e", "--enclave")
_ROSOUT_LOGS = {"--enable-rosout-logs": True, "--disable-rosout-logs": False}
_STDOUT = ("--enable-stdout-logs", "--disable-stdout-logs")
_OTHER_LOGS = ("--enable-external-lib-logs", "--disable-external-lib-logs")
_NODE = ("__node", "__name")
_NAMESPACE = "__ns"
_SCHEMES = ("rostopic://", "rosservice://")
_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII)
_UNKNOWN = re.compile(r"\{\w*\}", re.ASCII)
_SUBSTITUTION = re.compile(r"\{(node|ns|namespace)\}")


class Remap(NamedTuple):
    """A name that is to be another one."""

    node: str
    """The only node that it is for; empty for all."""
    old: str
    new: str


class RosArguments(NamedTuple):
    """The arguments of ROS."""

    remaps: tuple[Remap, ...] = ()
    parameters: tuple[Override, ...] = ()
    has_rosout: bool = True
    """True if the log goes to the topic `/rosout`, too."""


def read_arguments(arguments: Sequence[str]) -> RosArguments:
    """Read the arguments between `--ros-args` and `--`, of which there may be several.

    Raises:
        TransportError: An argument is not one of ROS, or has no value; or a file of parameters
            cannot be read.
    """
    remaps: list[Remap] = []
    parameters: list[Override] = []
    has_rosout = True
    words = iter(_of_ros(arguments))
    for word in words:
        if word in ("-r", "--remap"):
            node, old, new = _rule(word, next(words, ""))
            remaps.append(Remap(node, old, new))
        elif word in ("-p", "--param"):
            text = next(words, "")
            node, name, value = _rule(word, text)
            nodes = f"/{node.removeprefix('/')}" if node else ALL_NODES
            parameters.append(Override(nodes, name, value, f"{word} {text}"))
        elif word == "--params-file":
            parameters += read_parameters_file(next(words, ""))
        elif word in _IGNORED_WITH_VALUE:
            next(words, None)
        elif word in _ROSOUT_LOGS:
            has_rosout = _ROSOUT_LOGS[word]
        elif word not in (*_STDOUT, *_OTHER_LOGS):
            raise TransportError(
                f"{word!r} is not an argument of ROS that dds:// knows: use -r OLD:=NEW,"
                " -p NAME:=VALUE or --params-file FILE after --ros-args"
            )
    return RosArguments(tuple(remaps), tuple(parameters), has_rosout)


def _of_ros(arguments: Sequence[str]) -> Iterator[str]:
    is_inside = False
    for word in arguments:
        if word in (_BEGIN, _END):
            is_inside = word == _BEGIN
        elif is_inside:
            yield word


def _rule(word: str, text: str) -> tuple[str, str, str]:
    old, is_rule, new = text.partition(":=")
    if not (is_rule and old and new):
        raise TransportError(f"{word} {text!r}: expected a rule such as old:=new")
    for scheme in _SCHEMES:
        old = old.removeprefix(scheme)
    node, colon, name = old.partition(":")
    return (node, name, new) if colon else ("", old, new)


def node_name(name: str, namespace: str, arguments: RosArguments) -> NodeName:
    """Return the name of a node after `__node` and `__ns` of the arguments.

    Raises:
        TransportError: ROS does not allow the name or the namespace.
    """
    for rule in arguments.remaps:
        if rule.node in ("", name):
            name = rule.new if rule.old in _NODE else name
            namespace = rule.new if rule.old == _NAMESPACE else namespace
    if not _TOKEN.fullmatch(name):
        raise TransportError(
            f"invalid node_name {name!r}: it has letters, digits and _, and does not begin with a"
            " digit"
        )
    namespace = f"/{namespace.removeprefix('/')}"
    if namespace != "/" and not all(map(_TOKEN.fullmatch, namespace[1:].split("/"))):
        raise TransportError(
            f"invalid namespace {namespace!r}: it has names of letters, digits and _ after slashes"
        )
    return NodeName(name, namespace)


class NameResolver:
    """The rules by which a node makes full names."""

    def __init__(self, node: NodeName, arguments: RosArguments) -> None:
        self._node = node
        self._remaps = {
            self._expand(rule.old): self._expand(rule.new)
            for rule in arguments.remaps
            if rule.node in ("", node.name) and rule.old not in (*_NODE, _NAMESPACE)
        }

    def resolve(self, name: str) -> str:
        """Return the full name of a topic or a service, remapped if a rule says so.

        Raises:
            TransportError: ROS does not allow this name.
        """
        full = self._expand(name)
        return self._remaps.get(full, full)

    def _expand(self, name: str) -> str:
        base = self._node.namespace.rstrip("/")
        texts = {"node": self._node.name, "ns": base, "namespace": base}
        full = _SUBSTITUTION.sub(lambda found: texts[found[1]], name)
        if full == "~" or full.startswith("~/"):
            full = f"{base}/{self._node.name}{full[1:]}"
        elif not full.startswith("/"):
            full = f"{base}/{full}"
        wrong = f"{excerpt(name)!r} is not a valid name in ROS:"
        if unknown := _UNKNOWN.search(full):
            raise TransportError(f"{wrong} {unknown[0]} is not {{node}}, {{ns}} or {{namespace}}")
        if not all(map(_TOKEN.fullmatch, full[1:].split("/"))):
            raise TransportError(
                f"{wrong} it has names of letters, digits and _ between slashes, none of which"
                " begins with a digit; ~ for the name of the node comes first, before a slash"
            )
        if len(full) > LONGEST_NAME:
            raise TransportError(f"{wrong} it has {len(full)} characters of {LONGEST_NAME} at most")
        return full
