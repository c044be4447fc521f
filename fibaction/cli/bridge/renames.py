"""New names for the actions that a bridge serves: other namespaces, and other names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple, Self

import msgspec

from fibaction.border.abc import Endpoint, ForwardingEndpoint
from fibaction.cli.arguments.names import ROOT, Namespace, shown
from fibaction.cli.output.escape import excerpt
from fibaction.cli.process.exit_codes import Failure
from fibaction.types.action import ActionInfo

_RENAME = re.compile(r"([\w/~]+):?=(/?[A-Za-z_]\w*(?:/[A-Za-z_]\w*)*)", re.ASCII)


class Renames(NamedTuple):
    """The rules by which the actions of a namespace get new names."""

    source: Namespace = ROOT
    """The namespace from which the actions are taken."""
    target: Namespace | None = None
    """The namespace that takes the place of `source`; None if names stay as they are."""
    names: Mapping[str, str] = {}
    """New names by old ones, both with a slash in front."""

    @classmethod
    def parse(cls, rules: Iterable[str], source: Namespace, target: Namespace | None) -> Self:
        """Read rules `OLD=NEW`, or `OLD:=NEW`, as ROS writes it.

        OLD without a slash in front is relative to `source`, and NEW to `target`.

        Raises:
            Failure: A rule is malformed, or two are about the same action.
        """
        found: dict[str, str] = {}
        for rule in rules:
            match = _RENAME.fullmatch(rule)
            if match is None:
                text = f"a rename is like OLD=NEW, for example pick=grasp, unlike {excerpt(rule)!r}"
                raise Failure(text)
            old = shown(source.absolute(match[1]))
            if old in found:
                raise Failure(f"the action {old} is renamed twice")
            found[old] = shown((source if target is None else target).absolute(match[2]))
        return cls(source, target, found)

    def new_name(self, name: str) -> str:
        """Return the name under which an action is served.

        A new name has no slash in front: at `ros2://` it is relative to the namespace of the URL,
        as the names of all actions of servers are.
        """
        if renamed := self.names.get(shown(name)):
            return renamed.removeprefix("/")
        if self.target is None:
            return name
        rest = self.source.relative(name).lstrip("/")
        return f"{self.target.path}/{rest}".lstrip("/")

    def unknown(self, names: Iterable[str]) -> str:
        """Return an old name of a rule that is not among these; empty if all are."""
        known = set(map(shown, names))
        return next((old for old in self.names if old not in known), "")

    def check(self, names: Iterable[str]) -> None:
        """Check that no two of these actions get the same name by the rules.

        Raises:
            Failure: Two do.
        """
        owners: dict[str, str] = {}
        for name in names:
            new = shown(self.new_name(name))
            other = owners.setdefault(new, name)
            if other != name and (self.names or self.target is not None):
                raise Failure(clash(new, name, other))

    def endpoint(self, endpoint: Endpoint) -> Endpoint:
        """Return an endpoint under its new name."""
        name = self.new_name(endpoint.info.name)
        return endpoint if name == endpoint.info.name else _RenamedEndpoint(endpoint, name)


AS_THEY_ARE = Renames()
"""No rules: all actions keep their names."""


def clash(new: str, name: str, other: str) -> str:
    """Return the sentence about two actions with the same new name."""
    first, second = sorted(excerpt(shown(one)) for one in (name, other))
    taken = excerpt(shown(new))
    return f"{first} and {second} cannot both be served as {taken}: give one another name"


class _RenamedEndpoint(ForwardingEndpoint):
    """An endpoint that is served under another name."""

    def __init__(self, inner: Endpoint, name: str) -> None:
        super().__init__(inner)
        self._info = msgspec.structs.replace(inner.info, name=name)

    @property
    def info(self) -> ActionInfo:
        return self._info
