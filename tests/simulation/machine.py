"""The machine as the product sees it: time, randomness and goal IDs, made from a seed.

They are replaced in all loaded modules of fibaction, under whatever names these import them, so
that none can be forgotten.
"""

from __future__ import annotations

import itertools
import os
import random
import secrets
import sys
import time
import types
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

from fibaction import GoalID
from tests.simulation import loop as virtual
from tests.simulation.goal_names import goal_names

LOOK = 5e-5
"""Virtual seconds that each reading of the clock takes, so that a generator that never awaits uses
up its slice, as on a real machine."""

_FUNCTION = types.BuiltinFunctionType | types.FunctionType | types.MethodType


class _Shadow(types.ModuleType):
    """A module with some of its functions replaced."""

    def __init__(self, module: types.ModuleType, functions: dict[str, Any]) -> None:
        super().__init__(module.__name__)
        self._module = module
        self.__dict__.update(functions)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


@contextmanager
def made_up(loop: virtual.VirtualLoop, seed: int) -> Generator[None, None, None]:
    """Replace time and randomness in all modules of the product, for as long as the block lasts."""
    chance = random.Random(f"product {seed}")
    numbers = itertools.count(1)

    def look() -> float:
        loop.now += LOOK
        return loop.now

    def new_goal_id() -> GoalID:
        goal_id = GoalID(next(numbers).to_bytes(4, "big") + b"simulated 12")
        if (mine := goal_names.get(None)) is not None:
            mine.add(goal_id)
        return goal_id

    replaced: dict[types.ModuleType, dict[str, Any]] = {
        time: {
            "time": lambda: virtual.PAST / 1e9 + loop.now,
            "time_ns": lambda: virtual.PAST + int(loop.now * 1e9),
            "monotonic": look,
            "perf_counter": look,
            "monotonic_ns": lambda: int(look() * 1e9),
            "perf_counter_ns": lambda: int(look() * 1e9),
        },
        random: {
            name: getattr(chance, name)
            for name in ("random", "uniform", "randrange", "randint", "choice", "getrandbits")
        },
        secrets: {"token_bytes": chance.randbytes},
        os: {"urandom": chance.randbytes},
    }
    shadows = {module: _Shadow(module, functions) for module, functions in replaced.items()}
    single = {
        getattr(module, name): function
        for module, functions in replaced.items()
        for name, function in functions.items()
    }
    with ExitStack() as stack:
        stack.enter_context(patch.object(GoalID, "random", new_goal_id))
        for module in _product():
            for name, value in list(vars(module).items()):
                if isinstance(value, types.ModuleType) and value in shadows:
                    stack.enter_context(patch.object(module, name, shadows[value]))
                elif isinstance(value, _FUNCTION) and value in single:
                    stack.enter_context(patch.object(module, name, single[value]))
        yield


def _product() -> list[types.ModuleType]:
    roots = ("fibaction.", "fibaction_transports.")
    return [module for name, module in sys.modules.items() if f"{name}.".startswith(roots)]
