"""A view of a graph of ROS: the ends of topics, their nodes, and the state of discovery."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager, suppress
from typing import NamedTuple, TypeAlias

import anyio

from fibaction.words.errors import TransportError
from fibaction_transports.ros2.node.parts import EndInfo

FEEDBACK = "/_action/feedback"
"""The end of the name of an action's feedback topic, after the name of the action."""
_FEEDBACK_MESSAGE = "_FeedbackMessage"


class DiscoveryState(NamedTuple):
    """The state of discovery, as far as a middleware tells."""

    known: int
    """The participants, nodes and ends that are known: another number is news."""
    pending: int
    """Participants that are known, and whose ends or nodes have not all come."""
    quiet: float
    """Seconds without news after which nothing more is expected."""


class GraphView(ABC):
    """A view of a graph: its topics, their ends, and the nodes."""

    @abstractmethod
    def discovery(self) -> DiscoveryState:
        """Return the state of discovery."""

    @abstractmethod
    def nodes(self) -> set[str]:
        """Return the full names of the nodes that are known."""

    @abstractmethod
    def topics(self) -> list[tuple[str, str]]:
        """Return the topics, with or without a publisher, each with the name of its type."""

    @abstractmethod
    def services(self) -> list[tuple[str, str]]:
        """Return the services that are served, each with the name of its type."""

    @abstractmethod
    def publishers(self, topic: str) -> Sequence[EndInfo]:
        """Return the publishers of a topic, connected or not."""

    @abstractmethod
    def subscriptions(self, topic: str) -> Sequence[EndInfo]:
        """Return the subscriptions to a topic, connected or not."""

    # Counts may be quicker than lists.

    def count_publishers(self, topic: str) -> int:
        """Return the number of publishers of a topic, connected or not."""
        return len(self.publishers(topic))

    def count_subscriptions(self, topic: str) -> int:
        """Return the number of subscriptions to a topic, connected or not."""
        return len(self.subscriptions(topic))

    def served_actions(self) -> list[tuple[str, str]]:
        """Return the feedback topics of all actions with a server, each with the action's type."""
        return sorted(
            (topic, type_name.removesuffix(_FEEDBACK_MESSAGE))
            for topic, type_name in self.topics()
            if topic.endswith(FEEDBACK)
            and type_name.endswith(_FEEDBACK_MESSAGE)
            and self.count_publishers(topic)
        )


class JoinedViews(GraphView):
    """Two views of the same graph: what either of them knows."""

    def __init__(self, one: GraphView, other: GraphView) -> None:
        """Join two views, of which the second one tells the state of discovery."""
        self._one = one
        self._other = other

    def discovery(self) -> DiscoveryState:
        return self._other.discovery()

    def nodes(self) -> set[str]:
        return self._one.nodes() | self._other.nodes()

    def topics(self) -> list[tuple[str, str]]:
        return sorted({*self._one.topics(), *self._other.topics()})

    def services(self) -> list[tuple[str, str]]:
        return sorted({*self._one.services(), *self._other.services()})

    def publishers(self, topic: str) -> Sequence[EndInfo]:
        return _joined(self._one.publishers(topic), self._other.publishers(topic))

    def subscriptions(self, topic: str) -> Sequence[EndInfo]:
        return _joined(self._one.subscriptions(topic), self._other.subscriptions(topic))


def _joined(one: Sequence[EndInfo], other: Sequence[EndInfo]) -> list[EndInfo]:
    """Return the ends of both, each once, with its node if either knows it."""
    found = {end.gid: end for end in other}
    found.update((end.gid, end) for end in one if end.node or end.gid not in found)
    return list(found.values())


SCOUT_PATIENCE = 1.0
"""Seconds within which a scout finds the node."""
SCOUT_PAUSE = 0.01

ScoutOpener: TypeAlias = Callable[[int], AbstractAsyncContextManager[GraphView]]
"""Opens a view of the graph of a domain; raises `TransportError` if it cannot."""


def no_scout(domain: int) -> AbstractAsyncContextManager[GraphView]:
    """Open no view.

    Raises:
        TransportError: Always.
    """
    raise TransportError(f"nothing looks at the domain {domain}")


@asynccontextmanager
async def scouted_view(
    own: GraphView, node: str, domain: int, open_scout: ScoutOpener
) -> AsyncGenerator[GraphView, None]:
    """Look at a graph with the view of a node, by its full name, and that of a scout next to the
    node, which tells how far discovery has come.

    A scout counts only if it sees the node, too: another middleware or security may hide the graph
    from it. Then the node's own view is all there is.
    """
    async with AsyncExitStack() as stack:
        view = own
        with suppress(TransportError):
            scout = await stack.enter_async_context(open_scout(domain))
            with anyio.move_on_after(SCOUT_PATIENCE):
                await _find(node, scout)
                view = JoinedViews(own, scout)
        yield view


async def _find(node: str, scout: GraphView) -> None:
    while node not in scout.nodes():  # noqa: ASYNC110  # nothing tells of a new node
        await anyio.sleep(SCOUT_PAUSE)
