"""One matched reader, as its writer sees it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from fibaction_transports.rtps.endpoints.history import History, StoredSample
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.messages.ids import Guid
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    FragmentNack,
    Gap,
    NumberSet,
    WriterHeartbeat,
)
from fibaction_transports.rtps.outbox import PeerRoute

REPAIR_PAUSE = 0.005
"""Seconds within which a sample is not sent again: a request for it has crossed it on the way."""
SILENCE = 10.0
"""Seconds without an acknowledgement after which a reader keeps no samples back."""


class ReaderProxy:
    """One matched reader: what it has, and what was sent to it."""

    def __init__(
        self, guid: Guid, route: PeerRoute, writer: bytes, history: History, shared: SharedParts
    ) -> None:
        self.guid = guid
        self._route = route
        self._writer = writer
        self._history = history
        self._shared = shared
        self._sent: dict[int, float] = {}
        self._before = 0
        self.is_reliable = False
        """True if lost samples are sent to it again."""
        self.acknowledged = 0
        """The number up to which it has all samples."""
        self.waits_since = 0.0
        """The time since which it has said nothing about samples that it lacks."""

    def start(self, before: int, *, is_reliable: bool, now: float) -> None:
        """Begin after the sample with this number."""
        self._before = self.acknowledged = before
        self.is_reliable = is_reliable
        self.waits_since = now

    def has_unacknowledged(self, last: int) -> bool:
        """Return whether it lacks samples up to this number, as far as is known."""
        return self.is_reliable and self.acknowledged < last

    def is_silent(self, now: float) -> bool:
        """Return whether it lacks samples and has been silent for long."""
        return self.has_unacknowledged(self._history.last) and now - self.waits_since > SILENCE

    def send(self, numbers: Iterable[int], now: float) -> None:
        """Send samples, and a GAP for those that the reader does not get."""
        left_out = list[int]()
        self._forget_sent()
        for number in numbers:
            sample = self._sample(number)
            if sample is None:
                left_out.append(number)
            else:
                self._send_sample(number, sample)
                if self.is_reliable:
                    self._sent[number] = now
        if self.is_reliable:
            for gap in self._gaps(left_out):
                self._shared.outbox.add(self._route, gap)
            self.heartbeat()

    def heartbeat(self) -> None:
        """Tell the reader which samples there are."""
        last = self._history.last
        heartbeat = WriterHeartbeat(
            self.guid.entity, self._writer, self._first, last, self._shared.next_count()
        )
        self._shared.outbox.add(self._route, heartbeat)

    def receive_acknack(self, nack: AckNack, now: float) -> None:
        """Note what the reader has, and send what it misses, if it was not sent just now."""
        self.waits_since = now
        has = nack.missing.base - 1
        if has > self.acknowledged:
            self.acknowledged = has
            self._sent = {number: at for number, at in self._sent.items() if number > has}
        wanted = [number for number in nack.missing.numbers if number <= self._history.last]
        if wanted:
            due = [number for number in wanted if self._may_repair(number, now)]
            if due:
                self.send(due, now)
        elif not nack.is_final:
            self.heartbeat()

    def receive_fragment_nack(self, nack: FragmentNack, now: float) -> None:
        """Send the fragments that the reader misses, if they were not sent just now."""
        number = nack.number
        self.waits_since = now
        if number > self._history.last or not self._may_repair(number, now):
            return
        sample = self._sample(number)
        if sample is None:
            self.send([number], now)
            return
        self._sent[number] = now
        for first in nack.missing.numbers:
            size = self._shared.fragment_size
            if 1 <= first <= -(-len(sample.payload) // size):
                self._send_fragment(number, sample, first)
        self.heartbeat()

    @property
    def _first(self) -> int:
        """The number of the first sample that the reader can get."""
        return max(self._history.first, self._before + 1)

    def _forget_sent(self) -> None:
        """Forget when samples were sent that are not kept any more."""
        while self._sent and (oldest := next(iter(self._sent))) < self._history.first:
            del self._sent[oldest]

    def _may_repair(self, number: int, now: float) -> bool:
        sent = self._sent.get(number)
        return sent is None or now - sent >= REPAIR_PAUSE

    def _sample(self, number: int) -> StoredSample | None:
        """Return a sample if it is for this reader."""
        sample = self._history.get(number) if number > self._before else None
        if sample is None or sample.only_to not in (None, self.guid):
            return None
        return sample

    def _send_sample(self, number: int, sample: StoredSample) -> None:
        count = -(-len(sample.payload) // self._shared.fragment_size)
        if count > 1:
            for first in range(1, count + 1):
                self._send_fragment(number, sample, first)
            return
        data = Data(
            self.guid.entity,
            self._writer,
            number,
            sample.payload,
            sample.inline_qos,
            sample.is_disposed,
        )
        self._shared.outbox.add(self._route, data, sample.time)

    def _send_fragment(self, number: int, sample: StoredSample, first: int) -> None:
        size = self._shared.fragment_size
        fragment = DataFragment(
            self.guid.entity,
            self._writer,
            number,
            first,
            1,
            size,
            len(sample.payload),
            memoryview(sample.payload)[(first - 1) * size : first * size],
            sample.inline_qos,
        )
        self._shared.outbox.add(self._route, fragment, sample.time)

    def _gaps(self, numbers: list[int]) -> Iterator[Gap]:
        """Yield a GAP for each run of numbers; all that is before the first sample is one."""
        at = 0
        while at < len(numbers):
            start = end = numbers[at]
            while at < len(numbers) and numbers[at] <= end:
                end = max(numbers[at] + 1, self._first if start < self._first else 0)
                at += 1
            yield Gap(self.guid.entity, self._writer, start, NumberSet(end))
