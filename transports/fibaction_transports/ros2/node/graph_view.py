"""A view of a graph of ROS: the ends of topics, their nodes, and the state of discovery."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

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

    def publishers(self, topic: str) -> Sequence[EndInfo]:
        return _joined(self._one.publishers(topic), self._other.publishers(topic))

    def subscriptions(self, topic: str) -> Sequence[EndInfo]:
        return _joined(self._one.subscriptions(topic), self._other.subscriptions(topic))


def _joined(one: Sequence[EndInfo], other: Sequence[EndInfo]) -> list[EndInfo]:
    """Return the ends of both, each once, with its node if either knows it."""
    found = {end.gid: end for end in other}
    found.update((end.gid, end) for end in one if end.node or end.gid not in found)
    return list(found.values())
