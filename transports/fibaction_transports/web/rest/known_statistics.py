"""`KnownStatistics`: the statistics of actions as JSON, computed no more often than need be.

Many pages may ask for them every few seconds, and a history may be long. So those of an action are
computed one at a time, and an answer is given again for as long as `REST` times the seconds that it
took.
"""

from __future__ import annotations

from collections import defaultdict
from time import monotonic, time_ns
from typing import NamedTuple

import anyio
import msgspec

from fibaction.border.abc import Endpoint
from fibaction.feeds.statistics import statistics_of
from fibaction.words.goal_query import time_of
from fibaction_transports.web.rest.goal_list import refusing

ONE_DAY = "24h"
"""The begin of the longer span if nothing else is said."""
REST = 20
"""Seconds for which an answer is given again, for each second that it took."""
SHORTEST_REST = 1.0
"""Seconds for which it is given again at least."""
MOST_KNOWN = 100
"""Answers that are known at once."""


class Known(NamedTuple):
    """An answer that was computed."""

    body: bytes
    until: float


class KnownStatistics:
    """The statistics that the clients of one interface have asked for."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, str], Known] = {}
        self._computing: defaultdict[str, anyio.Lock] = defaultdict(anyio.Lock)

    async def of(self, endpoint: Endpoint, since: str) -> bytes:
        """Return the statistics of an action since a time, as JSON.

        Raises:
            Refused: The text is not a time.
            ActionError: As for `statistics_of`.
        """
        with refusing("since"):
            begin = time_of(since, time_ns(), is_local=False)
        key = endpoint.info.name, since
        async with self._computing[endpoint.info.name]:
            known = self._known.pop(key, None)
            if known is None or known.until < monotonic():
                began = monotonic()
                body = msgspec.json.encode(await statistics_of(endpoint, begin))
                ended = monotonic()
                known = Known(body, ended + max(REST * (ended - began), SHORTEST_REST))
            self._known[key] = known
            while len(self._known) > MOST_KNOWN:
                del self._known[next(iter(self._known))]
        return known.body
