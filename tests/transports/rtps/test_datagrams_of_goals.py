"""The datagrams of goals at both ends: requests, answers, heartbeats and acknowledgements."""

from __future__ import annotations

import pytest

from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.messages.ids import Address
from fibaction_transports.rtps.messages.submessages import WriterHeartbeat
from tests.transports.rtps.world import GROUP, Node, World, payload, reader_of, writer_of

GOALS = 100
REQUESTS = ("send_goal", "get_result")
ANSWERS = ("accepted", "status", "count", "result")


class Pair:
    """A client and a server of goals, in virtual time."""

    def __init__(self) -> None:
        self.world = World()
        client, server = self.world.pair()
        self.requests = [self._topic(client, server, topic) for topic in REQUESTS]
        self.answers = [self._topic(server, client, topic) for topic in ANSWERS]
        self.world.run(2.0)
        self.sent = 0
        self.world.is_lost = self._count

    def _topic(self, one: Node, other: Node, topic: str) -> tuple[DataWriter, Node, DataReader]:
        writer = writer_of(self.world, one, topic=topic)
        return writer, other, reader_of(self.world, other, topic=topic)

    def _count(self, datagram: bytes, address: Address) -> bool:
        self.sent += address != GROUP
        return False

    def send(self, *topics: tuple[DataWriter, Node, DataReader]) -> None:
        """Write a sample of each topic, and wait until all of them have arrived."""
        for writer, _, _ in topics:
            writer.write(payload("x"), self.world.now)
        assert self.world.run_until(
            lambda: all(len(node.samples(reader)) == to.last for to, node, reader in topics)
        )

    def note_answers(self, *requests: tuple[DataWriter, Node, DataReader]) -> None:
        """Tell writers of requests that the last one was answered."""
        for writer, server, _ in requests:
            writer.receive_answer(server.participant.prefix, writer.last, self.world.now)

    def run(self, duration: float, pause: float) -> float:
        """Run goals of this duration one after another, with these pauses between them; return the
        datagrams of each.
        """
        for _ in range(GOALS):
            self.send(*self.requests)
            if duration:
                self.send(*self.answers[:2])
                self.note_answers(self.requests[0])
                self.world.run(duration)
                self.send(*self.answers[1:])
                self.note_answers(self.requests[1])
            else:
                self.send(*self.answers)
                self.note_answers(*self.requests)
            self.world.run(pause)
        self.world.run(2.0)
        assert all(writer.kept == 0 for writer, _, _ in self.requests + self.answers)
        return self.sent / GOALS


@pytest.mark.parametrize(
    ("duration", "pause", "most"),
    [(0, 0, 2.1), (0, 0.005, 3), (0, 0.1, 3.1), (0.1, 0.1, 5.2)],
)
def test_a_goal_takes_few_datagrams(duration: float, pause: float, most: float) -> None:
    assert Pair().run(duration, pause) <= most


def test_a_request_with_a_soon_answer_needs_no_heartbeat_and_is_repeated_if_lost() -> None:
    world = World()
    client, server = world.pair()
    other = world.join()
    writer = writer_of(world, client, topic="send_goal")
    reader = reader_of(world, server, topic="send_goal")
    reader_of(world, other, topic="send_goal")
    world.run(2.0)
    heartbeats = world.heard(WriterHeartbeat)

    def request(answered: int | None) -> int:
        """Write a request, and note an answer to one; return the number of heartbeats."""
        heartbeats.clear()
        writer.write(payload("request"), world.now, only_to=reader.guid)
        world.run(0.001)
        if answered is not None:
            writer.receive_answer(server.participant.prefix, answered, world.now)
        world.run(0.004)
        found = [one for _, (host, _), one in heartbeats if host == server.host]
        return len(found)

    assert request(answered=1) == 1
    world.run(0.1)
    assert request(answered=2) == 0
    world.run(0.1)
    assert writer.has_arrived(0)
    world.is_lost = lambda datagram, address: True
    request(answered=None)
    assert not writer.has_arrived(0)
    heartbeats = world.heard(WriterHeartbeat)
    world.run(0.1)
    assert len(server.samples(reader)) == 3
    assert writer.has_arrived(0)
    assert request(answered=1) == 1  # it is not sure any more, and an old answer says nothing
