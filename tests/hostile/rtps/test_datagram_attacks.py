"""Each attack on a participant of RTPS in its short form, beside an honest pair."""

from __future__ import annotations

import pytest

from tests.hostile.rtps.crowd import broken_bounds, figures_of
from tests.hostile.rtps.datagram_attacks import DATAGRAM_ATTACKS


@pytest.mark.asyncio
@pytest.mark.parametrize("name", sorted(DATAGRAM_ATTACKS))
async def test_an_attack_by_datagrams_costs_the_others_little(name: str) -> None:
    found = await figures_of(name)

    assert broken_bounds(DATAGRAM_ATTACKS[name], found) == []
