"""A process with a participant of Cyclone DDS, which obeys commands: a line of JSON each way.

Samples are taken by a waitset, and not by listeners: a writer that waits for room holds the lock of
Python, which a listener needs in the thread that takes the acknowledgements.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Awaitable, Callable, Coroutine, Generator
from queue import SimpleQueue
from threading import Thread
from typing import Any

from cyclonedds.core import (
    GuardCondition,
    InstanceState,
    Policy,
    Qos,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

ANY = SampleState.Any | ViewState.Any | InstanceState.Any
AT_ONCE = 100
"""Samples that are taken from a reader at once."""


def qos(*, depth: int = 0, reliable: bool = True, late: bool = False, data: bytes = b"") -> Qos:
    """Return a quality of service with the serialization of ROS; depth 0 keeps all samples."""
    reliability = Policy.Reliability
    history = Policy.History.KeepLast(depth) if depth else Policy.History.KeepAll
    return Qos(
        reliability.Reliable(duration(seconds=10)) if reliable else reliability.BestEffort,
        Policy.Durability.TransientLocal if late else Policy.Durability.Volatile,
        history,
        # What late readers get has a history of its own, which rmw_cyclonedds makes the same.
        Policy.DurabilityService(duration(seconds=0), history, -1, -1, -1),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(data),
    )


def readers_of(writer: DataWriter[Any]) -> int:
    """Return the number of readers that a writer has; lists of them may fail when one comes."""
    return int(writer.get_publication_matched_status().current_count)


def writers_of(reader: DataReader[Any]) -> int:
    """Return the number of writers that a reader has."""
    return int(reader.get_subscription_matched_status().current_count)


class Until:
    """A wait of a command or a goal, until something holds after a sample or a command."""

    def __init__(self, is_done: Callable[[], object]) -> None:
        self._is_done = is_done

    def __await__(self) -> Generator[None, None, None]:
        while not self._is_done():
            yield


class Node:
    """A participant, whose samples and commands are handled one after the other."""

    def __init__(self) -> None:
        self.participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
        self._waitset = WaitSet(self.participant)
        self._readers: list[tuple[DataReader[Any], Callable[[Any], None]]] = []
        self._orders: SimpleQueue[dict[str, Any] | None] = SimpleQueue()
        self._running: list[Coroutine[None, None, None]] = []
        self._is_told = GuardCondition(self.participant)
        self._waitset.attach(self._is_told)

    def read(self, topic: str, kind: Any, take: Callable[[Any], None], qos: Qos) -> DataReader[Any]:
        """Make a reader, each of whose samples is given to `take`."""
        reader = DataReader(self.participant, Topic(self.participant, topic, kind), qos=qos)
        self._readers.append((reader, take))
        self._waitset.attach(ReadCondition(reader, ANY))
        return reader

    def write(self, topic: str, kind: Any, qos: Qos) -> DataWriter[Any]:
        """Make a writer."""
        return DataWriter(self.participant, Topic(self.participant, topic, kind), qos=qos)

    def start(self, work: Coroutine[None, None, None]) -> None:
        """Do something that may wait for samples, beside everything else."""
        self._running.append(work)
        self._is_told.set(True)

    def run(self, commands: object) -> None:
        """Handle samples and commands until standard input ends, and leave the domain.

        A command is a method that is a coroutine; what it returns is its answer.
        """
        Thread(target=self._listen, daemon=True).start()
        say("ready")
        while True:
            self._waitset.wait(duration(seconds=60))
            self._is_told.take()
            for reader, take in self._readers:
                for sample in reader.take(AT_ONCE):
                    if sample.sample_info.valid_data:
                        take(sample)
            while not self._orders.empty():
                order = self._orders.get()
                if order is None:
                    # All that belongs to it is deleted, too, and others are told.
                    self.participant._delete(self.participant._ref)
                    os._exit(0)  # as the thread that listens may not stop
                self._running.append(_obey(getattr(commands, order.pop("do"))(**order)))
            self._running = [work for work in self._running if _goes_on(work)]

    def _listen(self) -> None:
        for line in sys.stdin:
            self._orders.put(json.loads(line))
            self._is_told.set(True)
        self._orders.put(None)
        self._is_told.set(True)


async def _obey(command: Awaitable[Any]) -> None:
    try:
        say({"answer": await command})
    except Exception as exc:
        say({"error": repr(exc)})


def _goes_on(work: Coroutine[None, None, None]) -> bool:
    try:
        work.send(None)
    except StopIteration:
        return False
    return True


def say(value: Any) -> None:
    """Print a line of JSON."""
    print(json.dumps(value), flush=True)
