"""`fibaction.feeds.answers`: a server that does not answer soon is not waited for."""

from __future__ import annotations

from typing import Any

import anyio
import pytest

from fibaction import ActionServer, ServerNotFound, TransportError
from fibaction.border.abc import Absence, ForwardingEndpoint
from fibaction.feeds import answers
from fibaction.feeds.answers import ANSWERING, intakes_of, statuses_soon
from fibaction.types.action import ActionInfo
from fibaction.words.intake import Intake, IntakeChange, IntakeMode
from tests.support.fibonacci import FIBONACCI, fibonacci
from tests.support.virtual_time import in_virtual_time

pytestmark = pytest.mark.anyio


class Silent(ForwardingEndpoint):
    async def intake(self) -> Intake:
        await anyio.sleep_forever()
        raise AssertionError


class Away(ForwardingEndpoint):
    @property
    def absence(self) -> Absence | None:
        return Absence(0, "gone")


class Forbidden(ForwardingEndpoint):
    async def intake(self) -> Intake:
        raise TransportError("no")


async def test_each_action_tells_how_it_takes_goals_and_nobody_waits_for_one_that_does_not_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(answers, "INTAKES_TIMEOUT", 0.2)
    async with ActionServer(FIBONACCI, fibonacci) as server:
        assert (await intakes_of([server]))["fibonacci"].mode is IntakeMode.OPEN
        paused = await server.change_intake(IntakeChange(IntakeMode.HOLD))
        assert await intakes_of([Silent(server), Forbidden(server)]) == {}
        assert await intakes_of([Silent(server), server]) == {"fibonacci": paused}
        assert await intakes_of([Away(server)]) == {}
        wrapped = ForwardingEndpoint(server)
        assert await wrapped.change_intake(IntakeChange(IntakeMode.OPEN)) == await wrapped.intake()


class Slow:
    """An endpoint that answers after some seconds."""

    info = ActionInfo("pick")

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds

    async def status(self) -> str:
        await anyio.sleep(self._seconds)
        return "statuses"


@in_virtual_time()
async def test_a_server_that_answers_late_is_waited_for_and_one_that_is_frozen_is_not() -> None:
    late: Any = Slow(0.9 * ANSWERING)
    assert str(await statuses_soon(late)) == "statuses"
    frozen: Any = Slow(100)
    began = anyio.current_time()
    with pytest.raises(ServerNotFound, match="'pick' has not answered for 5 s: ask again"):
        await statuses_soon(frozen)
    assert anyio.current_time() - began == pytest.approx(ANSWERING)
