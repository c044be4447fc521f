"""Goals between `dds://` and Cyclone DDS where 5 % of the datagrams are lost, each way."""

from __future__ import annotations

from random import Random

import pytest

from fibaction import serve
from fibaction_transports.rtps.messages.ids import Address
from fibaction_transports.rtps.participant import Participant
from fibaction_transports.rtps.ports import ParticipantSockets
from tests.support.fibonacci import Goal, Result
from tests.transports.cyclone import dds_end
from tests.transports.cyclone.dds_end import NINE, cyclone_client, cyclone_server, new_name
from tests.transports.cyclone.partner import needs_cyclone

pytestmark = [pytest.mark.anyio, needs_cyclone, pytest.mark.timeout(180)]

LOSS = 0.05
GOALS = 200


@pytest.fixture(params=range(2))
def lossy(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lose datagrams of the participants of this process, by a seed."""
    random = Random(request.param)
    send, receive = ParticipantSockets.send, Participant.receive

    def send_most(sockets: ParticipantSockets, datagram: bytes, address: Address) -> None:
        if random.random() >= LOSS:
            send(sockets, datagram, address)

    def receive_most(
        participant: Participant, datagram: bytes, address: Address, now: float
    ) -> None:
        if random.random() >= LOSS:
            receive(participant, datagram, address, now)

    monkeypatch.setattr(ParticipantSockets, "send", send_most)
    monkeypatch.setattr(Participant, "receive", receive_most)


@pytest.mark.usefixtures("lossy")
async def test_no_goal_at_a_cyclone_server_is_lost_or_runs_twice() -> None:
    name = new_name()
    async with cyclone_server(name) as cyclone, dds_end.client(name) as client:
        for _ in range(GOALS):
            assert await client.call(Goal(9)) == Result(NINE)
        offered = await cyclone.ask("offered")
        assert len(offered) == len(set(offered)) == GOALS


@pytest.mark.usefixtures("lossy")
async def test_no_goal_of_a_cyclone_client_is_lost_or_answered_twice() -> None:
    name = new_name()
    async with serve(dds_end.server(name), "dds://"), cyclone_client(name) as cyclone:
        for _ in range(GOALS // 50):
            await cyclone.ask("one_by_one", count=50, order=9)
        assert await cyclone.ask("repeated") == 0
