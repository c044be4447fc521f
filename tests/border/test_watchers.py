"""`Watcher`: the base class, whose methods do nothing."""

from __future__ import annotations

from typing import Any, cast

import pytest

from fibaction import Watcher
from fibaction.server.watchers import METHODS


@pytest.mark.parametrize("name", METHODS)
def test_a_method_that_is_not_overridden_does_nothing(name: str) -> None:
    method = getattr(Watcher(), name)
    nothing = cast("Any", None)

    assert method(*[nothing] * (method.__code__.co_argcount - 1)) is None
