"""One matched reader, as its writer sees it.

A reader that does not ask for old samples takes as old what it is told by the first heartbeat that
it hears: Cyclone DDS acknowledges such samples, and drops them. It hears none before it has found
the writer, which may be later than the writer has found it. So it gets a heartbeat of no samples,
again and again until it answers, and its samples only then. A question for a heartbeat is not an
answer: it may have been sent before any was heard.

A heartbeat in one datagram with a sample tells nothing of that sample, as both are lost together.
It tells of those before, and asks for an acknowledgement. So only one of many samples has one: the
last ones are asked for by the writer, after a pause. But a reader that lacks older samples gets one
with each: one of Fast DDS requests what is missing, and skips what is gone, when a heartbeat tells.
If samples are requests that are answered at once, the answers acknowledge them.

What a reader requests is sent again at once, unless it was sent within `REPAIR_PAUSE`, or the
budget of the reader's participant is used up (`budgets`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from fibaction_transports.rtps.endpoints.sample import History, StoredSample
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.limits import MIB
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
ANSWER_PAUSE = 0.001
"""Seconds within which one heartbeat answers all questions of a reader."""
HEARTBEAT_PAUSE = 0.01
"""Seconds after a heartbeat in which new samples are sent without one, unless they are many."""
SAMPLES_WITHOUT = 64
"""New samples that may be sent without a heartbeat."""
QUESTIONS = 2
"""Questions for a heartbeat that are no sign that one was heard; some may ask in each answer."""
ANSWERED_SOON = 0.02
"""Seconds after which a sample without a heartbeat has one, unless it was answered."""
SILENCE = 10.0
"""Seconds without an acknowledgement after which a reader keeps no samples back."""
LONGEST_SILENCE = 60.0
"""The same for a reader that asks meanwhile: most of what is sent to it may be lost."""
MOST_ASKED, MOST_ASKED_BYTES = 256, MIB
"""Samples that such a reader keeps back at most after `SILENCE`, and their bytes."""
GAP_SIZE = 32
"""Bytes of a GAP that tells that a sample does not come."""


class ReaderProxy:
    """One matched reader: what it has, and what was sent to it."""

    def __init__(
        self, guid: Guid, route: PeerRoute, writer: bytes, history: History, shared: SharedParts
    ) -> None:
        self.guid = guid
        self._entity = guid.entity
        self._route = route
        self._writer = writer
        self._history = history
        self._shared = shared
        self._budget = shared.budgets[route.prefix]
        self._sent: dict[int, float] = {}
        self._answered = -math.inf
        self._told_at = -math.inf
        """The time of the last heartbeat."""
        self._told = 0
        """The newest sample of which it told."""
        self._is_current = False
        """True if the reader has said that it lacks nothing, and not otherwise since."""
        self.is_answered = False
        """True if the last sample was answered soon."""
        self._written_at = -math.inf
        self._before = 0
        self._is_new = False
        self._questions = 0
        self.is_reliable = False
        """True if lost samples are sent to it again."""
        self.acknowledged = 0
        """The number up to which it has all samples."""
        self.waits_since = 0.0
        """The time since which it lacks samples and has got none of them."""
        self._asked_at = -math.inf
        """The time at which it has asked for samples, or for a heartbeat."""

    def start(self, before: int, *, is_reliable: bool, is_late: bool, now: float) -> None:
        """Begin after the sample with this number; a late reader gets those that are kept."""
        self._before = self.acknowledged = before
        self._is_new = is_reliable and not is_late
        self.is_reliable = is_reliable
        self.waits_since = now
        if before < self._history.last:
            self._budget.write(self._history.bytes)

    def has_unacknowledged(self, last: int) -> bool:
        """Return whether it lacks samples up to this number, as far as is known."""
        return self.is_reliable and (self.acknowledged < last or self._is_new)

    def is_silent(self, now: float) -> bool:
        """Return whether it lacks samples and has got none of them for long."""
        history, waits = self._history, now - self.waits_since
        if waits <= SILENCE or not self.has_unacknowledged(history.last):
            return False
        is_little = len(history) <= MOST_ASKED and history.bytes <= MOST_ASKED_BYTES
        return waits > LONGEST_SILENCE or now - self._asked_at > SILENCE or not is_little

    def write(self, number: int, sample: StoredSample, now: float) -> None:
        """Send a new sample, or a GAP if the reader does not get it."""
        if not self.is_reliable or self.acknowledged >= number - 1:
            self.waits_since = now
        self._budget.write(len(sample.payload))
        self._written_at = now
        if self._is_new:
            return
        # One that waits is replaced at no cost, so it is told of the newest sample, too.
        is_recent = now - self._told_at < HEARTBEAT_PAUSE and number - self._told < SAMPLES_WITHOUT
        is_answered_soon = self.is_answered and self.acknowledged == number - 1
        has_heartbeat = not is_answered_soon and (
            not (is_recent and self._is_current)
            or self._shared.outbox.has_heartbeat(self._route, self._entity, self._writer)
        )
        if sample.only_to in (None, self.guid):
            self._send_sample(number, sample)
        elif self.is_reliable:
            self._shared.outbox.add(
                self._route, Gap(self._entity, self._writer, number, NumberSet(number + 1))
            )
        if self.is_reliable:
            self._note_sent(number, now)
            if has_heartbeat:
                self.heartbeat(now)

    def skip(self, number: int) -> None:
        """Note a new sample that the reader does not need."""
        if self.acknowledged == number - 1:
            self.acknowledged = number

    def send(self, numbers: Iterable[int], now: float) -> None:
        """Send samples, and a GAP for those that the reader does not get; and a heartbeat."""
        left_out = list[int]()
        for number in numbers:
            sample = self._sample(number)
            if sample is None:
                left_out.append(number)
            else:
                self._send_sample(number, sample)
            if self.is_reliable:
                self._note_sent(number, now)
        if self.is_reliable:
            for gap in self._gaps(left_out):
                self._shared.outbox.add(self._route, gap)
            self.heartbeat(now)

    def heartbeat(self, now: float) -> None:
        """Tell the reader which samples there are."""
        first, last = self._before + 1, self._before
        if not self._is_new:
            first, last = max(self._history.first, first), self._history.last
        self._told, self._told_at = last, now
        count = self._shared.next_count()
        heartbeat = WriterHeartbeat(self._entity, self._writer, first, last, count)
        self._shared.outbox.add(self._route, heartbeat)

    def receive_acknack(self, nack: AckNack, now: float) -> None:
        """Note what the reader has, and send what it misses, if it was not sent just now."""
        has = nack.missing.base - 1
        if not nack.is_final or nack.missing.numbers:
            self._asked_at = now
        if nack.is_final or nack.missing.numbers:
            self._is_current = not nack.missing.numbers
        if has > self.acknowledged:
            self._acknowledge(has)
            self.waits_since = now
        wanted = [number for number in nack.missing.numbers if number <= self._history.last]
        if self._is_new and self._is_answer(nack):
            self._is_new = False
            self.send(range(self._first, self._history.last + 1), now)
        elif wanted:
            due = [number for number in wanted if self._may_repair(number, now)]
            if due:
                self.send(due, now)
        elif not nack.is_final and now - self._answered >= ANSWER_PAUSE:
            self._answered = now
            self.heartbeat(now)

    def receive_answer(self, number: int, now: float) -> None:
        """Note that the reader has a sample, since it was answered."""
        self.is_answered = now - self._written_at < ANSWERED_SOON
        if self.is_reliable and number == self.acknowledged + 1:
            self._acknowledge(number)
            self.waits_since = now

    def _is_answer(self, nack: AckNack) -> bool:
        self._questions += not (nack.is_final or nack.missing.numbers)
        return nack.is_final or bool(nack.missing.numbers) or self._questions > QUESTIONS

    def receive_fragment_nack(self, nack: FragmentNack, now: float) -> None:
        """Send the fragments that the reader misses, if they were not sent just now."""
        self._asked_at = now
        number, size = nack.number, self._shared.fragment_size
        if number > self._history.last or self._was_sent_just_now(number, now):
            return
        sample = self._sample(number)
        if sample is None and not self._is_new and self._budget.may_repair(GAP_SIZE, now):
            self.send([number], now)
        if sample is None:
            return
        self._sent[number] = now
        for first in nack.missing.numbers:
            start = (first - 1) * size
            if not 0 <= start < len(sample.payload) or not self._budget.may_repair(size, now):
                break
            self._send_fragment(number, sample, first)
        self.heartbeat(now)

    @property
    def _first(self) -> int:
        """The number of the first sample that the reader can get, from its answer on."""
        return max(self._history.first, self._before + 1)

    def _acknowledge(self, has: int) -> None:
        if has - self.acknowledged > len(self._sent):
            self._sent = {number: at for number, at in self._sent.items() if number > has}
        else:
            for number in range(self.acknowledged + 1, has + 1):
                self._sent.pop(number, None)
        self.acknowledged = has

    def _note_sent(self, number: int, now: float) -> None:
        """Note when a sample was sent, and forget it of samples that are not kept any more."""
        self._sent[number] = now
        if len(self._sent) > 2 * len(self._history.samples) + 2:
            first = self._history.first
            self._sent = {number: at for number, at in self._sent.items() if number >= first}

    def _was_sent_just_now(self, number: int, now: float) -> bool:
        return now - self._sent.get(number, -math.inf) < REPAIR_PAUSE

    def _may_repair(self, number: int, now: float) -> bool:
        """Return whether a sample may be sent again now, and count that."""
        if self._was_sent_just_now(number, now):
            return False
        sample = self._sample(number)
        return self._budget.may_repair(GAP_SIZE if sample is None else len(sample.payload), now)

    def _sample(self, number: int) -> StoredSample | None:
        """Return a sample if it is for this reader."""
        sample = self._history.samples.get(number) if number > self._before else None
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
            self._entity,
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
            self._entity,
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
            yield Gap(self._entity, self._writer, start, NumberSet(end))
