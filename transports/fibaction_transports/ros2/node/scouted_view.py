"""The graph as a node sees it, and a scout next to the node, which tells how far discovery has
come.

A scout counts only if it sees the node, too: another middleware or security may hide the graph from
it. Then the node's own view is all there is.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager, suppress
from typing import TypeAlias

import anyio

from fibaction.words.errors import TransportError
from fibaction_transports.ros2.node.graph_view import GraphView, JoinedViews

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
    """Look at a graph with the view of a node, by its full name, and that of a scout."""
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
