"""Names of actions, and namespaces: the actions of one robot among those of a fleet.

A namespace is a path such as `/robot1`. It holds the actions whose names begin with all of its
parts: `/robot1/navigate` and `/robot1/arm/pick`, but not `/robot10/navigate`.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple, Self

import anyio
from anyio import current_time

from fibaction._api import ClientConnection
from fibaction._runtime.text import LONGEST_COMPARED, nearest
from fibaction.border.abc import Connection, Endpoint
from fibaction.cli.output.escape import excerpt
from fibaction.cli.process.exit_codes import ExitCode, Failure
from fibaction.types.action import Action, ActionInfo

MOST_SUGGESTED = 10
"""Names that an error lists where none of them is similar."""


async def find_action(connection: Connection, name: str) -> ActionInfo:
    """Return the action of that name. A slash in front is optional.

    Raises:
        Failure: It is not served. The code is `UNREACHABLE`, since a wrong name and a server that
            has not started cannot be told apart on a network of servers.
    """
    return action_of(name, await connection.actions())


def action_of(name: str, actions: Collection[ActionInfo]) -> ActionInfo:
    """Return the action of that name. A slash in front is optional.

    Raises:
        Failure: It is not among them; the code is that of `find_action`.
    """
    wanted = shown(name)
    for info in actions:
        if shown(info.name) == wanted:
            return info
    raise no_action(name, actions)


def is_type(given: str, type_name: str) -> bool:
    """Return whether a user means this type: by its whole name, with a slash in front or not, by
    package and type, or by the type alone.
    """
    known = type_name.split("/")
    parts = re.split(r"/|\.|::", given.removeprefix("/"))
    return bool(given) and parts in (known, [known[0], known[-1]], known[-1:])


def no_action(name: str, actions: Iterable[ActionInfo]) -> Failure:
    """Return the error for an action that is not served, with the most similar name."""
    known = sorted(excerpt(shown(info.name)) for info in actions)
    text = f"the action {shown(name)} is not served"
    if near := nearest(shown(name), known):
        text += f"; did you mean {near}?"
    elif known:
        text += f"; there is {_some(known)}"
    else:
        text += ", nor is any other"
    return Failure(text, ExitCode.UNREACHABLE)


def shown(name: str) -> str:
    """Return an action's name as `ros2 action` prints it: with a slash in front."""
    return name if name.startswith(("/", "~")) else f"/{name}"


def names_of(endpoints: Iterable[Endpoint]) -> str:
    """Return the names of actions as one text."""
    return ", ".join(excerpt(shown(endpoint.info.name)) for endpoint in endpoints)


LATE = 3.0
"""Seconds for which the first action of a namespace is waited for if a node of it is there."""
LATE_PAUSE = 0.1
"""Seconds between two looks for it."""

_PATH = re.compile(r"/|/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*/?", re.ASCII)


class Namespace(NamedTuple):
    """A namespace of actions."""

    path: str
    """The parts of the namespace, such as `/robot1/arm`; `/` for that of all actions."""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the namespace that a user has written; the slash in front is optional.

        Raises:
            Failure: The text is not a namespace.
        """
        if not _PATH.fullmatch(text):
            text = f"a namespace is like /robot1 or /robot1/arm, unlike {excerpt(text)!r}"
            raise Failure(text)
        return cls(f"/{text.strip('/')}")

    def holds(self, name: str) -> bool:
        """Return whether an action is in this namespace, judging by its name."""
        return self == ROOT or shown(name).startswith(f"{self.path}/")

    def absolute(self, name: str) -> str:
        """Return the full name of an action: one without a slash in front is relative."""
        return name if shown(name) == name else f"{self.path.rstrip('/')}/{name}"

    def relative(self, name: str) -> str:
        """Return the name of an action in this namespace without the namespace."""
        return name if self == ROOT else shown(name).removeprefix(f"{self.path}/")

    def narrow(self, connection: ClientConnection, *names: str | None) -> ClientConnection:
        """Return the connection with the actions of this namespace only; with the `names` of
        actions, which may be in others, the connection as it is.

        Its `actions` raises a `Failure` as long as there has been none.
        """
        if self == ROOT or any(names):
            return connection
        return ClientConnection(_NarrowConnection(connection, self))


ROOT = Namespace("/")


class _NarrowConnection(Connection):
    """A connection that lists the actions of one namespace."""

    def __init__(self, connection: Connection, namespace: Namespace) -> None:
        self._connection = connection
        self._namespace = namespace
        self._exists = False

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        return self._connection.endpoint(action)

    async def actions(self) -> list[ActionInfo]:
        """Return the actions of the namespace. They are waited for if a node of it is there, which
        may have only begun, and there has been no action before.

        Raises:
            Failure: There is none, and there has been none before.
            TransportError, ProtocolError: The server cannot be asked.
        """
        deadline = current_time() + LATE
        nodes: list[str] = []
        while True:
            infos = await self._connection.actions()
            found = [info for info in infos if self._namespace.holds(info.name)]
            self._exists = self._exists or bool(found)
            if self._exists:
                return found
            nodes = sorted(filter(self._namespace.holds, await self._connection.nodes()))
            if not nodes or current_time() >= deadline:
                raise no_namespace(self._namespace, (info.name for info in infos), nodes)
            await anyio.sleep(LATE_PAUSE)


def no_namespace(namespace: Namespace, names: Iterable[str], nodes: Sequence[str] = ()) -> Failure:
    """Return the error for a namespace without actions: with the nodes that it has all the same,
    or else with the most similar namespace.
    """
    names = sorted(names)
    known = sorted(namespaces_of(names))
    text = f"there is no action in the namespace {namespace.path}"
    if nodes:
        text += f" yet, only nodes that serve none: {_some(nodes)}"
    elif near := nearest(namespace.path, known):
        text += f"; did you mean {excerpt(near)}?"
    elif known:
        text += f"; there is {_some(known)}"
    elif names:
        text += f"; the actions here have no namespace, leave out -n: {_some(names)}"
    else:
        text += ", and no action is served here"
    return Failure(text, ExitCode.UNREACHABLE)


def _some(names: Sequence[str]) -> str:
    """Return the first of these names, as one text."""
    some = ", ".join(map(excerpt, names[:MOST_SUGGESTED]))
    return some + (", ..." if len(names) > MOST_SUGGESTED else "")


def namespaces_of(names: Iterable[str]) -> set[str]:
    """Return the namespaces that hold the actions of these names, without `/`.

    Those of more than `LONGEST_COMPARED` characters are left out.
    """
    return {
        name[:end]
        for name in map(shown, names)
        if name.startswith("/")
        for end, character in enumerate(name[: LONGEST_COMPARED + 1])
        if character == "/" and end
    }


def namespace_of(name: str) -> str:
    """Return the namespace that an action is in itself: `/robot1/arm` for `robot1/arm/pick`."""
    return shown(name).rpartition("/")[0] or ROOT.path
