"""Generated parts of docs/howto/secure.md: the limits, and the bound for the server's memory."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
from page_parts import table
from protocol_parts import docs_of_fields

from fibaction.server.settings import ActionServerSettings
from fibaction.wire.auth import TOKEN
from fibaction.wire.frames import FIRST_FRAME
from fibaction.wire.link import OVERFULL
from fibaction.wire.settings import Limits

KIB, MIB, GIB = 2**10, 2**20, 2**30
TIMES = "×"  # noqa: RUF001  # the sign of a product, in text

CONNECTION = 192 * KIB
"""Bytes of one connection: its tasks and buffers, those of TLS, and a message of 64 KiB of which a
part has arrived. `tests/server/test_memory_bound.py` measures this number and the next six."""
GOAL = 2 * KIB
"""Bytes of one goal that a connection sends or follows, or that is kept for a lost client."""
AUTHORIZING = 8 * KIB
"""Bytes of it in addition, while an async `authorize` decides."""
REQUEST = 12 * KIB
"""Bytes of one other request that waits."""
LISTED = 512
"""Bytes of one goal in an answer that lists all goals; each connection has one at a time."""
ACTIVE = 12 * KIB
"""Bytes of one undecided or active goal at the server, beside its bytes and your executor's."""
RESULT = 8 * KIB
"""Bytes of one goal that has ended, beside its bytes, and of one rejection."""
UNREAD = 1.5
"""The times of `max_bytes` that goals, feedback and results may take: unread results have half of
it for themselves."""

WHAT_HAPPENS = {
    "connections": "one that has said nothing, is idle over HTTP or does not read its answer is"
    " ended, of the address that has the most, otherwise the new one",
    "per_address": "the same, of that address",
    "goals": "a goal is rejected; following one raises `LimitReached`",
    "follows": "following raises `LimitReached`",
    "lost": "those that were lost first are given up sooner",
    "requests": "the call raises `LimitReached`",
    "frame": "the connection ends",
    "memory": "the goal is rejected",
    "total_memory": "the goal is rejected, or the connection whose message is too much ends",
    "queue": "answers and feedback wait; the connection ends if it asks for twice as much",
    "handshake": "the connection ends",
    "heartbeat": "the connection ends after four times as long",
    "write": "the connection ends",
}
"""The effect of each limit."""
OF_THE_SERVER = {
    "max_goals": ("Goals that are active at the same time, of all clients.", "it is rejected"),
    "max_bytes": (
        "Bytes of goals, remembered feedback and results, of all clients.",
        "a goal is rejected; results are forgotten, the oldest of the client that holds most",
    ),
    "max_results": ("Results that are kept.", "the oldest is forgotten"),
    "result_timeout": ("Seconds that a result is kept.", "it is forgotten"),
    "given_up_timeout": (
        "Seconds that a store keeps a goal that was given up, with the goal and its checkpoint.",
        "it is forgotten",
    ),
    "feedback_window": (
        "Feedback messages that are remembered of each goal.",
        "the executor waits for its client, and others lose the oldest",
    ),
    "stall_timeout": (
        "Seconds that an executor waits for its own client.",
        "the oldest feedback is lost to that client",
    ),
    "shutdown_timeout": (
        "Seconds for the clean-up of executors when the server stops.",
        "they are given up",
    ),
}
"""Meaning of each limit of `ActionServer`, and what the server does at it."""
FIXED = (
    ("first message of a client", FIRST_FRAME, "Bytes of `Hello`.", "the connection ends"),
    ("token", TOKEN, "Bytes of a token.", "the connection ends"),
)
"""Limits that are no settings."""


def _default(name: str) -> int:
    fields = msgspec.structs.fields(ActionServerSettings)
    default: int = next(field.default for field in fields if field.name == name)
    return default


def limits_part() -> str:
    """Return the table of all limits with their defaults."""
    rows = [
        [f"`Limits.{field.name}`", _number(field.default), _meaning(field.name), at]
        for field, at in zip(msgspec.structs.fields(Limits), WHAT_HAPPENS.values(), strict=True)
    ]
    rows += [
        [f"`ActionServer({name}=)`", _number(_default(name)), meaning, at]
        for name, (meaning, at) in OF_THE_SERVER.items()
    ]
    rows += [[name, _number(number), meaning, at] for name, number, meaning, at in FIXED]
    return table(["Limit", "Default", "It bounds", "At the limit"], rows)


def _meaning(name: str) -> str:
    return docs_of_fields(Limits)[name]


@dataclass
class Bound:
    """The most memory of a server with one action, part by part."""

    limits: Limits
    max_goals: int
    max_bytes: int
    max_results: int

    @property
    def of_a_connection(self) -> int:
        """The most that one connection can take, beside what all share."""
        limits = self.limits
        buffers = CONNECTION + OVERFULL * limits.queue
        answer = LISTED * self.max_goals
        return buffers + answer + limits.goals * GOAL + limits.requests * REQUEST

    @property
    def shared(self) -> int:
        """The most that all connections together can take in addition."""
        goals = self.max_goals * ACTIVE + self.max_results * RESULT + self.limits.lost * GOAL
        return self.limits.total_memory + int(UNREAD * self.max_bytes) + goals

    @property
    def whole(self) -> int:
        """The most that all clients together can take."""
        return self.limits.connections * self.of_a_connection + self.shared


DEFAULT = Bound(Limits(), *(_default(name) for name in ("max_goals", "max_bytes", "max_results")))
TIGHT = Bound(
    Limits(
        connections=20,
        goals=20,
        follows=4,
        lost=100,
        requests=10,
        frame=64 * KIB,
        memory=256 * KIB,
        total_memory=4 * MIB,
        queue=128 * KIB,
    ),
    max_goals=50,
    max_bytes=8 * MIB,
    max_results=100,
)
"""The tighter limits of the page's example."""


def memory_part() -> str:
    """Return the table of the bound, for the defaults and for the tighter limits."""
    rows = [
        [meaning, formula, _bytes(getattr(DEFAULT, name)), _bytes(getattr(TIGHT, name))]
        for name, meaning, formula in (
            (
                "of_a_connection",
                "one connection, at most",
                _sum(
                    _bytes(CONNECTION),
                    f"{OVERFULL} {TIMES} `queue`",
                    f"{_bytes(GOAL)} {TIMES} `goals`",
                    f"{_bytes(REQUEST)} {TIMES} `requests`",
                    f"{LISTED} B {TIMES} `max_goals`",
                ),
            ),
            (
                "shared",
                "all connections share, in addition",
                _sum(
                    "`total_memory`",
                    f"{UNREAD} {TIMES} `max_bytes`",
                    f"{_bytes(ACTIVE)} {TIMES} `max_goals`",
                    f"{_bytes(RESULT)} {TIMES} `max_results`",
                    f"{_bytes(GOAL)} {TIMES} `lost`",
                ),
            ),
            (
                "whole",
                "all clients together, at most",
                f"`connections` {TIMES} the first + the second",
            ),
        )
    ]
    return table(["What", "Formula", "Default", "Tighter"], rows)


def _sum(*parts: str) -> str:
    return " + ".join(parts)


def _bytes(number: int) -> str:
    for unit, name in ((GIB, "GiB"), (MIB, "MiB")):
        if number >= unit:
            return f"{number / unit:.3g} {name}"
    return f"{number / KIB:.3g} KiB"


def _number(value: object) -> str:
    if value is None:
        return "none"
    assert isinstance(value, int | float)
    if value >= KIB and value % KIB == 0:
        return _bytes(int(value))
    return f"{value:,g}"
