"""Virtual time for tests on trio, which jumps ahead as soon as all tasks wait."""

from __future__ import annotations

import pytest
from trio.testing import MockClock


def in_virtual_time() -> pytest.MarkDecorator:
    """Run a test on trio, whose clock jumps to the next timer."""
    clock = MockClock(autojump_threshold=0)
    return pytest.mark.parametrize("anyio_backend", [("trio", {"clock": clock})], ids=["virtual"])
