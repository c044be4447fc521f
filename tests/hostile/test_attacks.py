"""Each attack in its short form, beside an honest client."""

from __future__ import annotations

import pytest

from tests.hostile.arena import figures_of
from tests.hostile.attacks import ATTACKS
from tests.hostile.verdict import faults

# Sorted, since the order in which they are registered depends on what was imported before.
SHORT = sorted(name for name, attack in ATTACKS.items() if not attack.is_long)


@pytest.mark.asyncio
@pytest.mark.parametrize("name", SHORT)
async def test_an_attack_costs_the_others_little(name: str) -> None:
    found = await figures_of(name)

    assert faults(ATTACKS[name], found) == []
