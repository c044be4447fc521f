"""`fibaction.feeds.intakes`: how the actions of a list take goals."""

from __future__ import annotations

import anyio
import pytest

from fibaction import ActionServer, TransportError
from fibaction.border.abc import Absence, ForwardingEndpoint
from fibaction.feeds import intakes
from fibaction.feeds.intakes import intakes_of
from fibaction.words.intake import Intake, IntakeChange, IntakeMode
from tests.support.fibonacci import FIBONACCI, fibonacci

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
    monkeypatch.setattr(intakes, "INTAKES_TIMEOUT", 0.2)
    async with ActionServer(FIBONACCI, fibonacci) as server:
        assert (await intakes_of([server]))["fibonacci"].mode is IntakeMode.OPEN
        paused = await server.change_intake(IntakeChange(IntakeMode.HOLD))
        assert await intakes_of([Silent(server), Forbidden(server)]) == {}
        assert await intakes_of([Silent(server), server]) == {"fibonacci": paused}
        assert await intakes_of([Away(server)]) == {}
        wrapped = ForwardingEndpoint(server)
        assert await wrapped.change_intake(IntakeChange(IntakeMode.OPEN)) == await wrapped.intake()
