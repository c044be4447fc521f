"""The subscriptions that a node's calls for single messages share."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any, Final, TypeAlias

import anyio
from anyio.abc import TaskGroup
from msgspec.structs import replace

from fibaction.border.abc import Notifier
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.messaging.subscription import Subscription

KEPT_OPEN: Final = 5.0
"""Seconds for which a subscription stays open for the next call of `Node.next`."""
MOST_SHARED: Final = 1_000
"""Subscriptions that are open; then that gives way which was not used for the longest time."""

Wanted: TypeAlias = tuple[str, str | type[Any], str | qos.EndQos]
"""A topic by its full name, its type, and a quality of service."""


class _Shared:
    """An open subscription, and who uses it."""

    def __init__(self, subscription: Subscription[Any]) -> None:
        self.subscription = subscription
        self.is_followed = False
        """True if the newest message was asked for, which may be asked for again at any time."""
        self.waiting = 0
        self.used = 0.0
        """The time at which the last call ended."""


def _closing_time(shared: _Shared) -> float:
    return inf if shared.is_followed or shared.waiting else shared.used + KEPT_OPEN


class NewestMessages:
    """The newest messages of topics, each read by one subscription for all calls."""

    def __init__(self, subscribe: Callable[..., Subscription[Any]], tasks: TaskGroup) -> None:
        """`subscribe` is `Node.subscribe`, and `tasks` are those of the node."""
        self._subscribe = subscribe
        self._tasks = tasks
        self._shared: dict[Wanted, _Shared] = {}
        """The one that was used last is at the end."""
        self._news = Notifier()
        self._has_closer = False

    def latest(self, wanted: Wanted) -> Any | None:
        """Return the newest message; None if none has arrived yet."""
        shared = self._open(wanted)
        shared.is_followed = True
        return shared.subscription.latest

    async def next(self, wanted: Wanted, timeout: float | None) -> Any:
        """Wait for a message that arrives from now on; see `Subscription.upcoming`."""
        shared = self._open(wanted)
        shared.waiting += 1
        try:
            return await shared.subscription.upcoming(timeout)
        finally:
            shared.waiting -= 1
            shared.used = anyio.current_time()
            self._news.notify()

    def _open(self, wanted: Wanted) -> _Shared:
        shared = self._shared.pop(wanted, None)
        if shared is None:
            topic, type_, given = wanted
            # With `keep_all`, publishers would wait for a reader of every message.
            newest = replace(qos.of_topic(given, depth=1), history="keep_last")
            shared = _Shared(self._subscribe(topic, type_, qos=newest))
            if not self._has_closer:  # not at the end of a call: the node may be closed then
                self._has_closer = True
                self._tasks.start_soon(self._close_unused, name="close unused subscriptions")
            for key in [key for key, one in self._shared.items() if not one.waiting]:
                if len(self._shared) >= MOST_SHARED:
                    self._shared.pop(key).subscription.close()
        self._shared[wanted] = shared
        return shared

    async def _close_unused(self) -> None:
        """Close each subscription some time after its last use."""
        while True:
            due = min(map(_closing_time, self._shared.values()), default=inf)
            if due == inf:
                await self._news.wait()
                continue
            await anyio.sleep_until(due)
            now = anyio.current_time()
            for key in [key for key, one in self._shared.items() if _closing_time(one) <= now]:
                self._shared.pop(key).subscription.close()
