"""Looks at the graph of ROS that wait until discovery is complete.

Theory of operation
-------------------

A node that has just begun knows nothing of the graph, and finds the others one by one. So a look
is complete

- if no participant is known whose ends have not come yet, and
- if there was no news for a quiet time, which the middleware says: see `DiscoveryState`; and
- if something was found. That there is nothing is said only after `discovery_timeout` seconds.

A node that has been there for long has found the others: a look at it takes no time, unless a
participant has just come. With rclpy, which does not tell what is missing, a new node has a scout
next to it (`on_dds.scout`).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, nullcontext
from typing import TypeVar

import anyio
from anyio import current_time

from fibaction.words.errors import ConnectionLost
from fibaction_transports.ros2.node.graph_view import GraphView
from fibaction_transports.ros2.node.ros_node import RosNode

GRAPH_PAUSE = 0.02
"""Seconds between two looks at the graph."""
GROWN = 5.0
"""Seconds after which a node has found the others: each announces itself again within 3 s."""
LONGEST = 4.0
"""Seconds that a look takes at most, if something is found and there is always news."""

FoundT = TypeVar("FoundT")


class GraphLooks:
    """Looks of a connection at the graph of its node."""

    def __init__(self, ros: RosNode, discovery_timeout: float) -> None:
        self._ros = ros
        self._opened = current_time()
        self._timeout = discovery_timeout

    async def settled(self, look: Callable[[GraphView], FoundT]) -> FoundT:
        """Return what is found in the graph when discovery is complete.

        Raises:
            ConnectionLost: ROS has been shut down.
        """
        self.check()
        began = current_time()
        async with self._view() as view:
            found, state = self.once(look, view), view.discovery()
            changed = current_time()  # not before: on a busy machine, a scout takes a second
            while not self._is_over(bool(found), began):
                is_quiet = self._is_grown() or current_time() - changed >= state.quiet
                if found and is_quiet and not state.pending:
                    break
                await anyio.sleep(GRAPH_PAUSE)
                before = state
                found, state = self.once(look, view), view.discovery()
                if state != before:
                    changed = current_time()
        return found

    def once(self, look: Callable[[GraphView], FoundT], view: GraphView | None = None) -> FoundT:
        """Return what is found in the graph now.

        Raises:
            ConnectionLost: ROS has been shut down.
        """
        self.check()
        found = look(view or self._ros)
        self.check()
        return found

    def check(self) -> None:
        """Raise `ConnectionLost` if ROS has been shut down."""
        if not self._ros.is_up:
            raise ConnectionLost(str(self._ros.error))

    def _is_over(self, is_found: bool, began: float) -> bool:
        since, most = (began, LONGEST) if is_found else (self._opened, self._timeout)
        return current_time() - since >= most

    def _view(self) -> AbstractAsyncContextManager[GraphView]:
        return nullcontext(self._ros) if self._is_grown() else self._ros.observed()

    def _is_grown(self) -> bool:
        return current_time() - self._opened >= GROWN
