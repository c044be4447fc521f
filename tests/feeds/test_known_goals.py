"""`fibaction.feeds.known_goals`: a server that does not answer soon is not waited for."""

from __future__ import annotations

from typing import Any

import anyio
import pytest

from fibaction import ServerNotFound
from fibaction.feeds.known_goals import ANSWERING, statuses_soon
from fibaction.types.action import ActionInfo
from tests.support.virtual_time import in_virtual_time

pytestmark = [pytest.mark.anyio, in_virtual_time()]


class Slow:
    """An endpoint that answers after some seconds."""

    info = ActionInfo("pick")

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds

    async def status(self) -> str:
        await anyio.sleep(self._seconds)
        return "statuses"


async def test_a_server_that_answers_late_is_waited_for_and_one_that_is_frozen_is_not() -> None:
    late: Any = Slow(0.9 * ANSWERING)
    assert str(await statuses_soon(late)) == "statuses"
    frozen: Any = Slow(100)
    began = anyio.current_time()
    with pytest.raises(ServerNotFound, match="'pick' has not answered for 5 s: ask again"):
        await statuses_soon(frozen)
    assert anyio.current_time() - began == pytest.approx(ANSWERING)
