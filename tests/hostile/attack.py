"""`Attack`: one thing that a hostile client repeats, and the bound of what it costs."""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple, TypeAlias

from fibaction.wire.messages import SendGoal
from tests.hostile.raw_client import Target
from tests.hostile.victim import Settings

Wave: TypeAlias = Callable[[Target], Awaitable[None]]

MIB = 2**20
MOST = 2**31 - 1
"""The most credit that a message can grant."""


class Attack(NamedTuple):
    """An attack, which repeats a wave of messages."""

    wave: Wave
    above: int
    """MiB of memory that the server may use above those of one without clients."""
    settings: Settings
    is_long: bool
    """True if it takes too long for `make test`."""


ATTACKS: dict[str, Attack] = {}
"""All attacks by their names, in the order in which their modules are imported."""


def attack(
    name: str,
    *,
    above: int = 64,
    long: bool = False,
    authorize: str = "",
    server: dict[str, Any] | None = None,
    wire: dict[str, Any] | None = None,
    **limits: int | float,
) -> Callable[[Wave], Wave]:
    """Register a wave as an attack on a server with these settings."""

    def register(wave: Wave) -> Wave:
        assert name not in ATTACKS
        settings = Settings(limits, server or {}, wire or {}, authorize)
        ATTACKS[name] = Attack(wave, above, settings, long)
        return wave

    return register


def goal_id() -> bytes:
    return os.urandom(16)


def sending(
    id: int, action: str, goal: bytes, credit: int | None = MOST, name: bytes | None = None
) -> SendGoal:
    """Return a message that sends a goal."""
    return SendGoal(id, action, name or goal_id(), goal, credit)
