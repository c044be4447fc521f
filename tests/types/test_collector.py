from __future__ import annotations

import gc

import pytest

from fibaction.types.action import collector_paused


@pytest.mark.parametrize("is_enabled", [True, False])
def test_the_collector_is_as_it_was_after_the_block(is_enabled: bool) -> None:
    try:
        if not is_enabled:
            gc.disable()
        with pytest.raises(ValueError, match="x"), collector_paused():
            assert not gc.isenabled()
            raise ValueError("x")
        assert gc.isenabled() == is_enabled
    finally:
        gc.enable()
