from __future__ import annotations

import pytest

from tests.transports.rtps.target import Target, Victim


@pytest.fixture
def target() -> Target:
    """A participant that knows no other."""
    return Target()


@pytest.fixture
def victim() -> Victim:
    """A participant that a peer knows."""
    return Victim()
