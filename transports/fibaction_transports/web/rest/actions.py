"""Actions in the REST interface: their descriptions, how they take goals, and their statistics.

Many pages may ask for statistics every few seconds, and a history may be long. So those of an
action are computed one at a time, and an answer is given again for as long as `REST` times the
seconds that it took.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Awaitable, Callable, Collection
from time import monotonic, time_ns
from typing import Any, NamedTuple

import anyio
import msgspec

from fibaction.border.abc import Endpoint
from fibaction.border.http_access import Refused
from fibaction.feeds.answers import intakes_of
from fibaction.feeds.statistics import statistics_of
from fibaction.words.goal_query import time_of
from fibaction.words.intake import NO_LEVERS, IntakeMode
from fibaction_transports.web.rest.goal_list import refusing

LARGEST_CHANGE = 10_000
"""Bytes of a change, at most."""
ONE_DAY = "24h"
"""The begin of the longer span if nothing else is said."""
REST = 20
"""Seconds for which an answer is given again, for each second that it took."""
SHORTEST_REST = 1.0
"""Seconds for which it is given again at least."""
MOST_KNOWN = 100
"""Answers that are known at once."""


class WantedIntake(msgspec.Struct, forbid_unknown_fields=True):
    """A change that a client sends."""

    mode: IntakeMode
    """`hold` to pause the action, so that new goals wait; `refuse` to pause it and reject them;
    `drain` to reject them, and let all others end; `open` to take goals again."""
    reason: str = ""
    """The reason, for people."""
    worker: str = ""
    """The only worker of a fleet that it is about; empty for all."""


def wanted_in(body: bytes) -> WantedIntake:
    """Return the change in the body of a request.

    Raises:
        Refused: It is not one.
    """
    try:
        return msgspec.json.decode(body, type=WantedIntake)
    except msgspec.MsgspecError as exc:
        raise Refused(422, f"a change has a mode, and may have a reason: {exc}") from None


async def all_described(
    endpoints: Collection[Endpoint], may_observe: Callable[[str], Awaitable[bool]]
) -> list[dict[str, Any]]:
    """Return the descriptions of actions, each with `away` while its server is, with `intake` while
    it takes no goals as usual, with `no_levers` if that cannot be changed, and with the `schedule`
    of its server. A client that may not observe an action learns neither who has paused it nor the
    schedule.
    """
    described = [msgspec.structs.asdict(endpoint.info) for endpoint in endpoints]
    intakes = await intakes_of(endpoints)
    for endpoint, members in zip(endpoints, described, strict=True):
        name = endpoint.info.name
        if endpoint.absence is not None:
            members["away"] = endpoint.absence
        elif (intake := intakes.get(name)) is not None:
            observes = await may_observe(name)
            if not intake.has_levers:
                members["no_levers"] = NO_LEVERS
            if intake.mode is not IntakeMode.OPEN:
                text = intake.text if observes else intake.text_for_all
                members["intake"] = {"mode": intake.mode, "text": text}
            if observes and (schedule := intake.schedule) is not None:
                members["schedule"] = {"text": schedule.text, **msgspec.to_builtins(schedule)}
    return described


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
