"""The arguments of ROS on a command line, and the names that they change.

https://design.ros2.org/articles/ros_command_line_arguments.html has their form, and
https://design.ros2.org/articles/topic_and_service_names.html the rules for names.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from fibaction.words.errors import TransportError
from fibaction_transports.ros2.on_dds.arguments.parameter_overrides import (
    ALL_NODES,
    Override,
    read_parameters_file,
)
from fibaction_transports.ros2.on_dds.graph import NodeName

_BEGIN, _END = "--ros-args", "--"
_IGNORED_WITH_VALUE = ("--log-level", "--log-config-file", "-e", "--enclave")
_ROSOUT_LOGS = {"--enable-rosout-logs": True, "--disable-rosout-logs": False}
_STDOUT = ("--enable-stdout-logs", "--disable-stdout-logs")
_OTHER_LOGS = ("--enable-external-lib-logs", "--disable-external-lib-logs")
_NODE = ("__node", "__name")
_NAMESPACE = "__ns"
_SCHEMES = ("rostopic://", "rosservice://")
_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII)
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
        if not all(map(_TOKEN.fullmatch, full[1:].split("/"))):
            raise TransportError(
                f"{name!r} is not a valid name in ROS: it has names of letters, digits and _"
                " between slashes, none of which begins with a digit"
            )
        return full
