"""A fuzz target: the datagrams of hostile peers of a participant of RTPS.

    python -m tests.fuzz.rtps -max_total_time=600

The input is a conversation: datagrams with the pauses before them. They go to a participant with a
reliable writer, which has written, and two readers. Whatever arrives, nothing is raised, what is
held stays within its limits and is freed at the end, and all that is sent is valid. Needs atheris,
which `make fuzz` installs.
"""

from __future__ import annotations

from collections.abc import Iterator

from fibaction_transports.rtps.limits import RtpsLimits
from fibaction_transports.rtps.messages.codec import read_packet
from fibaction_transports.rtps.messages.ids import Address
from fibaction_transports.rtps.participant import Participant, ParticipantSettings
from fibaction_transports.rtps.qos import Durability, Liveliness, Qos, Reliability
from tests.fuzz.fuzzer import fuzz
from tests.transports.rtps.world import TOPIC, TYPE

PREFIX = b"\x01\x7fthe victim"
LIMITS = RtpsLimits(
    participants=4,
    endpoints=16,
    endpoints_of_one=8,
    sample=2**16,
    held=2**16,
    incomplete=2**18,
    early_heartbeats=8,
    outbox=1024,
)
PAUSE = 0.01
"""Seconds that each step of the first byte of a datagram stands for."""
_ELSEWHERE = 0x80
MOST_DATAGRAMS = 200


def conversation(*datagrams: tuple[int, bytes]) -> bytes:
    """Return the input with these datagrams, each after so many pauses."""
    return b"".join(
        bytes([pauses]) + len(datagram).to_bytes(2, "big") + datagram
        for pauses, datagram in datagrams
    )


def datagrams(data: bytes) -> Iterator[tuple[float, Address, bytes]]:
    """Return the datagrams of an input, with the seconds before each and its source."""
    place = 0
    for _ in range(MOST_DATAGRAMS):
        if place + 3 > len(data):
            return
        pauses, size = data[place], int.from_bytes(data[place + 1 : place + 3], "big")
        host = "10.0.0.99" if pauses & _ELSEWHERE else "10.0.0.2"
        yield (pauses & ~_ELSEWHERE) * PAUSE, (host, 7410), data[place + 3 : place + 3 + size]
        place += 3 + size


class Victim:
    """A participant, its time, and what it sends."""

    def __init__(self) -> None:
        self.now = 0.0
        settings = ParticipantSettings(
            discovery_addresses=(("10.0.0.1", 7410),),
            data_addresses=(("10.0.0.1", 7411),),
            announce_to=(("239.255.0.1", 7400),),
            fragment_size=256,
            limits=LIMITS,
        )
        self.participant = Participant(settings, self.now, prefix=PREFIX)
        late = Qos(durability=Durability.TRANSIENT_LOCAL, depth=5)
        writer = self.participant.create_writer(TOPIC, TYPE, late, self.now)
        loose = Qos(
            reliability=Reliability.BEST_EFFORT,
            liveliness=Liveliness.BY_PARTICIPANT,
            liveliness_lease=1.0,
        )
        for qos in (Qos(), loose):
            self.participant.create_reader(TOPIC, TYPE, qos, self.now)
        for size in (10, 1000):
            writer.write(b"\x00\x01\x00\x00" + bytes(size), self.now)

    def take(self, pause: float, source: Address, datagram: bytes) -> None:
        """Let time pass, and take a datagram."""
        self.pass_time(pause)
        self.participant.receive(datagram, source, self.now)
        self.check()

    def pass_time(self, seconds: float) -> None:
        """Keep the deadlines of so many seconds."""
        end = self.now + seconds
        while (deadline := self.participant.next_deadline()) <= end:
            self.now = max(self.now, deadline)
            self.participant.handle_deadline(self.now)
            self.check()
        self.now = end

    def check(self) -> None:
        """Check what is sent and held."""
        shared = self.participant._shared
        for datagram, _ in self.participant.datagrams_to_send():
            assert len(datagram) < 2**16
            read_packet(datagram)
        self.participant.events()
        assert 0 <= shared.held.held <= LIMITS.held
        assert 0 <= shared.partials.held <= LIMITS.incomplete
        assert len(self.participant.remote_endpoints) <= LIMITS.endpoints

    def close(self) -> None:
        """Close the participant: nothing is held for others any more."""
        shared = self.participant._shared
        self.participant.close(self.now)
        self.check()
        assert shared.held.held == shared.partials.held == 0


def one_input(data: bytes) -> None:
    victim = Victim()
    for datagram in datagrams(data):
        victim.take(*datagram)
    victim.pass_time(1.0)
    victim.close()


def main() -> None:
    fuzz("rtps", one_input, logs=False)


if __name__ == "__main__":
    main()
