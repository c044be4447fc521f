"""Looks at a graph that grows: what they return, and when."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager, nullcontext
from typing import Any

import anyio
import pytest
from anyio import current_time

from fibaction import ConnectionLost, TransportError
from fibaction_transports.ros2.client import endpoint
from fibaction_transports.ros2.client.endpoint import GraphLooks
from fibaction_transports.ros2.node import parts
from fibaction_transports.ros2.node.parts import (
    DiscoveryState,
    EndInfo,
    GraphView,
    JoinedViews,
    no_scout,
)
from fibaction_transports.ros2.node.ros_node import NodeLife, RosNode
from fibaction_transports.ros2.qos import EndQos
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio

pytestmark = pytest.mark.anyio

TOPIC, TYPE = "/robot1/_action/feedback", "p/action/T_FeedbackMessage"


class Graph(GraphView):
    """A graph that grows with each look at how far discovery has come."""

    raise_if_lost = NodeLife.raise_if_lost

    def __init__(self, grow: Callable[[Graph, int], None] = lambda graph, look: None) -> None:
        self.names: set[str] = set()
        self.ends: list[EndInfo] = []
        self.pending = 0
        self.quiet = 0.0
        self.looks = 0
        self.is_up = True
        self.error = ConnectionLost("gone")
        self._grow = grow

    def observed(self) -> AbstractAsyncContextManager[GraphView]:
        return nullcontext(self)

    def discovery(self) -> DiscoveryState:
        self.looks += 1
        self._grow(self, self.looks)
        return DiscoveryState(len(self.names), self.pending, self.quiet)

    def nodes(self) -> set[str]:
        return set(self.names)

    def services(self) -> list[tuple[str, str]]:
        return [("/reset", "std_srvs/srv/Trigger")]

    def topics(self) -> list[tuple[str, str]]:
        return [(TOPIC, TYPE)]

    def publishers(self, topic: str) -> Sequence[EndInfo]:
        return self.ends

    def subscriptions(self, topic: str) -> Sequence[EndInfo]:
        return self.ends


def looks(graph: Graph, timeout: float = 5.0) -> GraphLooks:
    ros: Any = graph
    return GraphLooks(ros, timeout)


def nodes_of(view: GraphView) -> set[str]:
    return view.nodes()


@pytest.fixture(autouse=True)
def short_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(endpoint, "GRAPH_PAUSE", 0.001)


async def test_a_look_waits_for_participants_whose_ends_have_not_come() -> None:
    def grow(graph: Graph, look: int) -> None:
        graph.names.add("/robot1")
        graph.pending = int(look < 50)
        if look >= 49:
            graph.names.add("/robot2")

    assert await looks(Graph(grow)).settled(nodes_of) == {"/robot1", "/robot2"}


async def test_a_look_waits_for_a_quiet_time_which_news_begin_anew() -> None:
    def grow(graph: Graph, look: int) -> None:
        graph.quiet = 0.2
        if look <= 100:
            graph.names.add(f"/robot{look}")

    start = current_time()
    assert len(await looks(Graph(grow)).settled(nodes_of)) == 100
    assert current_time() - start >= 0.2 + 99 * 0.001


async def test_the_quiet_time_begins_when_the_view_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0

    def grow(graph: Graph, look: int) -> None:
        nonlocal now
        now += 0.01
        graph.names.add(f"/robot{min(look, 2)}")

    @asynccontextmanager
    async def observed() -> AsyncGenerator[GraphView, None]:
        nonlocal now
        now += 1.5  # as a scout on a busy machine
        yield graph

    graph = Graph(grow)
    graph.names, graph.quiet = {"/robot1"}, 1.0
    monkeypatch.setattr(graph, "observed", observed)
    monkeypatch.setattr(endpoint, "current_time", lambda: now)
    assert await looks(graph).settled(nodes_of) == {"/robot1", "/robot2"}


async def test_that_there_is_nothing_is_said_after_the_timeout_only() -> None:
    start = current_time()
    assert await looks(Graph(), 0.1).settled(nodes_of) == set()
    assert current_time() - start >= 0.1


async def test_a_participant_that_tells_nothing_more_is_not_waited_for_without_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(endpoint, "LONGEST", 0.05)
    graph = Graph()
    graph.names, graph.pending = {"/robot1"}, 1
    with anyio.fail_after(10):
        assert await looks(graph).settled(nodes_of) == {"/robot1"}


async def test_a_node_that_has_been_there_for_long_looks_at_once_and_without_a_scout(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(endpoint, "GROWN", 0.0)
    graph = Graph()
    graph.names, graph.quiet = {"/robot1"}, 1000.0
    monkeypatch.setattr(graph, "observed", None)
    assert await looks(graph).settled(nodes_of) == {"/robot1"}
    assert graph.looks == 1


async def test_a_look_ends_with_an_error_when_ros_is_shut_down() -> None:
    def grow(graph: Graph, look: int) -> None:
        graph.is_up = look < 3

    with pytest.raises(ConnectionLost, match="gone"):
        await looks(Graph(grow)).settled(nodes_of)


def end(gid: bytes, node: str) -> EndInfo:
    return EndInfo(gid, node, EndQos())


def test_two_views_of_a_graph_know_what_either_of_them_knows() -> None:
    one, other = Graph(), Graph()
    one.names, other.names = {"/robot1"}, {"/robot2"}
    one.ends = [end(b"a", "/robot1"), end(b"b", "")]
    other.ends = [end(b"a", ""), end(b"b", "/robot2"), end(b"c", "")]
    joined = JoinedViews(one, other)
    assert joined.nodes() == {"/robot1", "/robot2"}
    expected = [end(b"a", "/robot1"), end(b"b", "/robot2"), end(b"c", "")]
    assert sorted(joined.publishers(TOPIC)) == sorted(joined.subscriptions(TOPIC)) == expected
    assert (joined.count_publishers(TOPIC), joined.count_subscriptions(TOPIC)) == (3, 3)
    assert joined.served_actions() == [(TOPIC, "p/action/T")]
    other.pending = 7
    assert joined.discovery().pending == 7


def scouting(graph: Graph) -> parts.ScoutOpener:
    @asynccontextmanager
    async def opened(domain: int) -> AsyncGenerator[GraphView, None]:
        yield graph

    return opened


async def test_a_scout_counts_only_if_it_sees_the_node(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "SCOUT_PATIENCE", 0.05)
    own, scout = Graph(), Graph()
    scout.names = {"/other"}
    async with parts.scouted_view(own, "/own", 7, scouting(scout)) as view:
        assert view is own
    async with parts.scouted_view(own, "/other", 7, scouting(scout)) as view:
        assert view.nodes() == {"/other"}


async def test_without_a_scout_a_node_looks_by_itself() -> None:
    own = Graph()
    async with parts.scouted_view(own, "/own", 7, no_scout) as view:
        assert view is own
    with pytest.raises(TransportError, match="nothing looks at the domain 7"):
        no_scout(7)


def test_ends_are_counted_in_the_graph_if_there_is_no_quicker_way() -> None:
    node: Any = Graph()
    node.ends = [end(b"a", "/robot1"), end(b"b", "")]
    assert RosNode.count_publishers(node, TOPIC) == 2
    assert RosNode.count_subscriptions(node, TOPIC) == 2
