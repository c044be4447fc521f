"""The writer of a topic, reliable or best effort."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Container, Sequence
from functools import partial

from fibaction.words.errors import LimitReached
from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.reader_proxy import SILENCE, ReaderProxy
from fibaction_transports.rtps.endpoints.sample import History, StoredSample, padded
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.messages.ids import PREFIX_SIZE, Guid
from fibaction_transports.rtps.messages.parameters import Parameters
from fibaction_transports.rtps.messages.submessages import AckNack, FragmentNack
from fibaction_transports.rtps.outbox import PeerRoute
from fibaction_transports.rtps.qos import Qos

FIRST_HEARTBEAT = 0.02
"""Seconds after which a writer asks readers again for what they have not acknowledged."""
LONGEST_HEARTBEAT = 1.0
"""The longest time between two such questions, in seconds: each pause is twice the one before."""
MAX_INLINE_QOS = 1024
"""Bytes of the inline QoS of a sample: they go into each datagram of it."""


class DataWriter:
    """The writer of a topic: it keeps samples, and sends them until readers have them.

    A reader that has been silent for long keeps nothing back: its samples are forgotten when all
    others have acknowledged them. One that asks for them is waited for longer, if they are few.
    """

    def __init__(
        self, guid: Guid, topic: str, type_name: str, qos: Qos, shared: SharedParts
    ) -> None:
        self.guid = guid
        self.topic = topic
        self.type_name = type_name
        self.qos = qos
        self._shared = shared
        self._history = History(qos.depth, shared.limits)
        self.readers: dict[Guid, ReaderProxy] = {}
        """The matched readers of other participants."""
        self.own_readers: dict[Guid, DataReader] = {}
        """Those of this participant, which take samples without the network."""
        self._pause = FIRST_HEARTBEAT
        self._expiries: deque[tuple[float, int]] = deque()

    @property
    def matched(self) -> list[Guid]:
        """All matched readers."""
        return [*self.readers, *self.own_readers]

    @property
    def last(self) -> int:
        """The number of the newest sample; 0 if there is none."""
        return self._history.last

    @property
    def kept(self) -> int:
        """Number of samples that are kept."""
        return len(self._history)

    def acknowledged(self, now: float) -> int:
        """Return the number up to which every reader has all samples; silent ones do not count."""
        return min(
            (
                proxy.acknowledged
                for proxy in self.readers.values()
                if proxy.is_reliable and not proxy.is_silent(now)
            ),
            default=self.last,
        )

    def waiting(self, now: float) -> int:
        """Return the number of the newest samples that a reader has not taken; one that has taken
        none for long does not count.
        """
        if any(reader.is_paused for reader in self.own_readers.values()):
            return self.last
        return self.last - self.acknowledged(now)

    def has_arrived(self, margin: int) -> bool:
        """Return whether every reader has all samples but the newest ones, up to the margin; one
        that is best effort does not tell.
        """
        proxies, least = self.readers.values(), self.last - margin
        return all(proxy.is_reliable and proxy.acknowledged >= least for proxy in proxies)

    def write(
        self,
        payload: bytes,
        now: float,
        *,
        inline_qos: Sequence[tuple[int, bytes]] = (),
        time: float | None = None,
        only_to: Guid | None = None,
    ) -> int:
        """Send a sample to all matched readers, or only to one; return its number.

        The payload begins with its encapsulation header of 4 bytes. The inline QoS are parameters,
        by their IDs, in little-endian.

        Raises:
            LimitReached: The history is full.
            ValueError: The payload has no encapsulation header, or the inline QoS are too long.
        """
        inline = None
        if inline_qos:
            inline = Parameters(tuple(inline_qos))
            size = 0
            for _, value in inline_qos:
                size += len(value)
            if size > MAX_INLINE_QOS:
                raise ValueError(f"inline QoS of {size} bytes exceed {MAX_INLINE_QOS} bytes")
        if len(payload) % 4 or not payload:
            payload = padded(payload)
        sample = StoredSample(payload=payload, inline_qos=inline, time=time, only_to=only_to)
        return self.write_sample(sample, now)

    def write_sample(
        self, sample: StoredSample, now: float, *, only_at: Container[bytes] | None = None
    ) -> int:
        """Send a sample whose payload is padded already; return its number.

        With `only_at`, it is sent to the readers of these participants only. The others need it
        no more than the samples before it, and get it if they ask.

        Raises:
            LimitReached: The history is full.
        """
        if self._expiries:
            self._forget(now)
        try:
            number = self._history.add(sample)
        except LimitReached:
            self._forget(now)
            number = self._history.add(sample)
        if self.qos.lifespan < math.inf:
            self._expiries.append((now + self.qos.lifespan, number))
        is_awaited = False
        for guid, proxy in self.readers.items():
            if only_at is None or guid[:PREFIX_SIZE] in only_at:
                proxy.write(number, sample, now)
            else:
                proxy.skip(number)
            is_awaited |= proxy.is_reliable and (
                now - proxy.waits_since <= SILENCE or not proxy.is_silent(now)
            )
        for reader in self.own_readers.values():
            reader.take_own(self.guid, number, sample, now)
        self._pause = FIRST_HEARTBEAT
        self._shared.timers.set_earlier(self.on_heartbeat_due, now + self._pause)
        if not is_awaited:
            self._forget(now)  # otherwise when they acknowledge
        return number

    def match(self, reader: Guid, route: PeerRoute, qos: Qos, now: float) -> None:
        """Send samples to a reader from now on, and those that are kept if it asks for them."""
        is_reliable = self.qos.is_reliable and qos.is_reliable
        is_late = self.qos.is_transient_local and qos.is_transient_local
        self._forget(now)
        proxy = ReaderProxy(reader, route, self.guid.entity, self._history, self._shared)
        before = 0 if is_late else self.last
        proxy.start(before, is_reliable=is_reliable, is_late=is_late, now=now)
        self.readers[reader] = proxy
        if is_reliable:
            proxy.heartbeat(now)
            self._pause = FIRST_HEARTBEAT
            self._shared.timers.set_earlier(self.on_heartbeat_due, now + self._pause)
        elif is_late:
            proxy.send(range(self._history.first, self.last + 1), now)

    def match_own(self, reader: DataReader, now: float) -> None:
        """Give samples to a reader of the same participant from now on, and those that are kept if
        both are transient local.
        """
        self.own_readers[reader.guid] = reader
        reader.own_writers[self.guid] = partial(self._unmatch_own, reader)
        reader.confirmed_writers.add(self.guid)
        if self.qos.is_transient_local and reader.qos.is_transient_local:
            for number, sample in self._history.samples.items():
                reader.take_own(self.guid, number, sample, now)

    def _unmatch_own(self, reader: DataReader) -> None:
        del self.own_readers[reader.guid], reader.own_writers[self.guid]
        reader.confirmed_writers.discard(self.guid)

    def unmatch(self, reader: Guid, now: float) -> bool:
        """Forget a reader; return whether it was matched."""
        found = self.readers.pop(reader, None) is not None
        self._forget(now)
        return found

    def receive_acknack(self, reader: Guid, nack: AckNack, now: float) -> None:
        """Note what a reader has, and send what it misses."""
        proxy = self.readers.get(reader)
        if proxy is not None and proxy.is_reliable and nack.missing.base <= self.last + 1:
            proxy.receive_acknack(nack, now)
            self._forget(now)

    def receive_answer(self, participant: bytes, number: int, now: float) -> None:
        """Note that a participant has answered a sample: its readers have it."""
        for reader, proxy in self.readers.items():
            if reader[:PREFIX_SIZE] == participant:
                proxy.receive_answer(number, now)

    def receive_fragment_nack(self, reader: Guid, nack: FragmentNack, now: float) -> None:
        """Send the fragments that a reader misses."""
        proxy = self.readers.get(reader)
        if proxy is not None and proxy.is_reliable:
            proxy.receive_fragment_nack(nack, now)

    def on_heartbeat_due(self, now: float) -> None:
        """Ask the readers again that have not acknowledged everything."""
        waiting = [p for p in self.readers.values() if p.has_unacknowledged(self.last)]
        for proxy in waiting:
            proxy.is_answered = False
            proxy.heartbeat(now)
        self._pause = min(self._pause * 2, LONGEST_HEARTBEAT)
        self._forget(now)
        if waiting:
            self._shared.timers.set(self.on_heartbeat_due, now + self._pause)

    def close(self) -> None:
        """Forget all readers, and send nothing any more."""
        self.readers.clear()
        for reader in [*self.own_readers.values()]:
            self._unmatch_own(reader)
        self._shared.timers.cancel(self.on_heartbeat_due)

    def _forget(self, now: float) -> None:
        if self._expiries:
            self._forget_expired(now)
        is_volatile = not self.qos.is_transient_local
        if is_volatile or self._history.has_disposed:  # looking at all readers takes its time
            self._history.forget_acknowledged(self.acknowledged(now), is_volatile=is_volatile)

    def _forget_expired(self, now: float) -> None:
        while self._expiries:
            due, number = self._expiries[0]
            if number in self._history.samples:
                if due > now:
                    return
                self._history.forget(number)
            self._expiries.popleft()
