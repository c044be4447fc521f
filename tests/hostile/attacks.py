"""All attacks: importing this module registers those of each other one."""

from __future__ import annotations

from tests.hostile import connection_attacks, document_attacks, floods, goal_attacks, memory_attacks
from tests.hostile.attack import ATTACKS, Attack

__all__ = [
    "ATTACKS",
    "Attack",
    "connection_attacks",
    "document_attacks",
    "floods",
    "goal_attacks",
    "memory_attacks",
]
