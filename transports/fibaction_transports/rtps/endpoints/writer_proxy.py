"""One matched writer, as its reader sees it: the samples of it that are expected, held, missing.

How a sample comes, if the two are reliable:

- `_next` is the number of the next sample to hand over. It is unknown until the first heartbeat,
  which tells the first sample that there is. A reader that comes late begins there, and a GAP takes
  it over the samples that are not for it: beginning after the last one would lose the first reply
  of a service.
- A sample with a later number is held until those before it have come. Only numbers in a window
  from `_next` on are held or requested, so a forged number makes nobody hold or ask for more.
- A heartbeat tells what there is. Missing samples are requested at once, and again while nothing
  comes (`RequestPace`); an acknowledgement waits, so that one can answer several heartbeats, and
  joins a datagram that leaves meanwhile.
- A request names only numbers that a heartbeat has announced: Fast DDS answers one for a number
  that is not written yet with a GAP, and the sample is then lost.
- Fragments are requested only after a pause without one, because the others are on their way.

If they are best effort, a sample is handed over if its number is larger than all before.
"""

from __future__ import annotations

from collections.abc import Callable

from fibaction_transports.rtps.endpoints.catch_up import OVERTAKEN, CatchUp, RequestPace
from fibaction_transports.rtps.endpoints.sample import PADDING_BITS, Sample, unpadded
from fibaction_transports.rtps.endpoints.shared import PartialSample, SharedParts
from fibaction_transports.rtps.events import SamplesLost
from fibaction_transports.rtps.messages.ids import FAST_DDS, Guid
from fibaction_transports.rtps.messages.layout import MAX_BITS
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

WINDOW = MAX_BITS
"""Numbers from the next one on that are held and requested."""
ACKNOWLEDGE_AFTER = 0.002
"""Seconds within which one acknowledgement answers all heartbeats."""
FIRST_REQUEST = 0.03
"""Seconds after which a request without an answer is repeated."""
LONGEST_REQUEST = 2.0
"""The longest time between two requests, in seconds: each pause is twice the one before."""
FRAGMENT_PAUSE = 0.008
"""Seconds without a fragment after which missing ones are requested."""
LONGEST_FRAGMENT_PAUSE = 0.5
MOST_REQUESTS = 20
"""Requests without an answer after which one waits for the writer's next word."""


class WriterProxy:
    """One matched writer: its samples go to `deliver`, in order and once."""

    def __init__(
        self,
        guid: Guid,
        route: PeerRoute,
        vendor: bytes,
        reader: Guid,
        shared: SharedParts,
        deliver: Callable[[Guid, Sample, float], None],
        on_caught_up: Callable[[], None],
        confirmed: set[Guid],
    ) -> None:
        """Match a writer. It is in `confirmed` if it is known to have found the reader, or does
        not tell.
        """
        self._guid = guid
        self._confirmed = confirmed
        confirmed.add(guid)
        self._route = route
        self._vendor = vendor
        self._reader = reader
        self.is_paused = False
        """True if samples are held back that could be handed over."""
        self._shared = shared
        self._deliver = deliver
        self._is_reliable = False
        self._next: int | None = None
        self._announced = 0
        self._held: dict[int, Sample | None] = {}
        self._partials: dict[int, PartialSample] = {}
        self._request_pause = FIRST_REQUEST
        self._requests = 0
        self._pace = RequestPace(shared.answer_time)
        self._owes = False
        """True if the writer waits for an acknowledgement."""
        self._fragment_pause = FRAGMENT_PAUSE
        self._catch_up = CatchUp(shared.timers, self.ask, on_caught_up)

    @property
    def is_complete(self) -> bool:
        """True if all samples that the writer has told of have come, or it does not tell."""
        if not self._is_reliable:
            return True
        return self._next is not None and self._next > self._announced

    @property
    def is_catching_up(self) -> bool:
        """True from `catch_up` on until the reader has caught up."""
        return self._catch_up.is_open

    def catch_up(self, now: float) -> None:
        """Find out whether samples are missing, as `CatchUp` describes."""
        if self._is_reliable and self._next is not None:
            self._catch_up.start(is_complete=self.is_complete, now=now)

    def resume(self, now: float) -> None:
        """Hand over what was held back, and tell the writer."""
        if self._is_reliable and self._next is not None:
            self._hand_over(now)
            self._owes = True
            self._shared.timers.set_earlier(self.on_acknowledge_due, now)

    def start_reliable(self, heartbeat: WriterHeartbeat | None, now: float) -> None:
        """Take the first heartbeat of the writer, or ask for it until it comes."""
        self._is_reliable = True
        self._confirmed.discard(self._guid)
        if heartbeat is None:
            self.on_request_due(now)
        else:
            self.receive_heartbeat(heartbeat, now)

    def close(self) -> None:
        """Forget everything that is held."""
        for callback in (self.on_request_due, self.on_fragments_due, self.on_acknowledge_due):
            self._shared.timers.cancel(callback)
        self._shared.outbox.owed.pop(self._route, None)  # timers remind the others
        for partial in list(self._partials.values()):
            self._shared.partials.remove(partial)
        for number in list(self._held):
            self._unhold(number)
        self._catch_up.close()
        self._confirmed.discard(self._guid)

    def receive_data(self, data: Data, time: float | None, now: float) -> None:
        """Take a sample."""
        is_due = data.number == self._next and not self.is_paused
        if not is_due and not self._wants(data.number):
            return
        payload, content = data.payload, b""
        if payload:
            if len(payload) > self._shared.limits.sample:
                self._shared.counters.over_limit += 1
                return
            # Most have no padding.
            content = unpadded(payload) if payload[3] & PADDING_BITS else bytes(payload)
        self._take(
            Sample(self._guid, data.number, content, data.inline_qos, time, data.is_key), now
        )

    def receive_fragment(self, fragment: DataFragment, time: float | None, now: float) -> None:
        """Take fragments of a sample, and the sample if it is complete."""
        number = fragment.number
        if not self._wants(number):
            return
        partials = self._shared.partials
        partial = self._partials.get(number) or partials.start(
            fragment, self._guid.prefix, self._partials
        )
        if partial is None or not partial.add(fragment):
            self._shared.counters.over_limit += 1
            return
        if not partial.is_complete:
            partials.touch(partial)
            if self._is_reliable:
                self._fragment_pause = FRAGMENT_PAUSE
                self._shared.timers.set(self.on_fragments_due, now + FRAGMENT_PAUSE)
            return
        partials.remove(partial)
        content = unpadded(partial.content())
        sample = Sample(self._guid, number, content, partial.inline_qos, time, fragment.is_key)
        self._take(sample, now)

    def receive_heartbeat(self, heartbeat: WriterHeartbeat, now: float) -> None:
        """Note which samples there are, and request those that are missing."""
        if not self._is_reliable:
            return
        self._announced = heartbeat.last
        self._requests = 0
        pause = ACKNOWLEDGE_AFTER
        if self._next is None:
            pause = 0.0  # samples may wait for the first acknowledgement
            self._request_pause = FIRST_REQUEST
            self._advance(heartbeat.first, now)
        elif heartbeat.first > self._next:
            self._catch_up.note_loss(now)
            self._shared.emit(
                SamplesLost(self._reader, self._guid, self._lost_before(heartbeat.first))
            )
            self._advance(heartbeat.first, now)
        elif self._next <= self._announced and self._missing():
            self._catch_up.note_loss(now)
        self._catch_up.hear(heartbeat.count, heartbeat.last, now)
        if self._catch_up.is_open:
            self._catch_up.settle(self._next or 1)
        # What was announced may not have been handed over.
        if self._partials or (self._next or 1) <= self._announced:
            self._request(now)
        elif not heartbeat.is_final:
            self._owes = True
            self._shared.timers.set_earlier(self.on_acknowledge_due, now + pause)
            self._shared.outbox.owed[self._route][self._acknowledge_all] = None

    def receive_gap(self, gap: Gap, now: float) -> None:
        """Note samples that do not come."""
        if self._next is None or not self._is_reliable:
            return
        if gap.start <= self._next < gap.rest.base:
            self._advance(gap.rest.base, now)
        end = self._next + WINDOW
        run = range(max(gap.start, self._next), min(gap.rest.base, end))
        for number in (*run, *gap.rest.numbers):
            if self._next <= number < end and number not in self._held:
                self._give_up(number)
                self._held[number] = None
        self._hand_over(now)

    def ask(self, now: float) -> None:
        """Ask for a heartbeat."""
        if self._is_reliable:
            # Fast DDS answers at once to 0 only; for Cyclone a packet with 0 is malformed.
            base = 0 if self._vendor == FAST_DDS else self._next or 1
            self._acknowledge(NumberSet(base), is_final=False)

    def on_request_due(self, now: float) -> None:
        """Repeat what has had no answer: the question for a heartbeat, or a request for samples."""
        if self._next is None:
            self.ask(now)
        elif missing := self._missing():
            self._send_request(missing, now)
        else:
            return
        self._requests += 1
        if self._requests < MOST_REQUESTS:
            self._shared.timers.set(self.on_request_due, now + self._request_pause)
            self._request_pause = min(self._request_pause * 2, LONGEST_REQUEST)

    def on_acknowledge_due(self, now: float) -> None:
        """Acknowledge what has arrived: no datagram has left meanwhile."""
        self._acknowledge_all()

    def _acknowledge_all(self) -> None:
        """Tell the writer that everything has arrived, if so, and if it has not been told."""
        if self._owes and self._next is not None and not self._missing():
            self._acknowledge(NumberSet(self._next), is_final=True)

    def on_fragments_due(self, now: float) -> None:
        """Request fragments, after a pause without one; give up samples that get none."""
        for partial in list(self._partials.values()):
            partial.requests += 1
            if partial.requests > MOST_REQUESTS:
                self._give_up(partial.number)
                continue
            nack = FragmentNack(
                self._reader.entity,
                self._guid.entity,
                partial.number,
                partial.missing(),
                self._shared.next_count(),
            )
            self._shared.outbox.add(self._route, nack)
        if self._partials:
            self._fragment_pause = min(self._fragment_pause * 2, LONGEST_FRAGMENT_PAUSE)
            self._shared.timers.set(self.on_fragments_due, now + self._fragment_pause)

    def _wants(self, number: int) -> bool:
        """Return whether a sample with this number is new, and can be held if it comes too soon."""
        if self._next is None:
            return number not in self._held and len(self._held) < WINDOW
        if not self._is_reliable:
            return number >= self._next
        return self._next <= number < self._next + WINDOW and number not in self._held

    def _take(self, sample: Sample, now: float) -> None:
        """Hand over a sample, or hold it until those before it have come."""
        number = sample.number
        if self._partials:
            self._give_up(number)
        self._requests = 0
        if number <= self._pace.requested:
            self._pace.note_sample(now)
        self._catch_up.sampled_at = now
        if not self._is_reliable:
            self._advance(number, now)
        if number == self._next and not self.is_paused:
            self._next = number + 1
            self._request_pause = FIRST_REQUEST
            self._deliver(self._reader, sample, now)
            if self._held or self._catch_up.is_open:
                self._hand_over(now)
        elif self._shared.held.take(len(sample.payload)):
            self._held[number] = sample
            if self._next is not None:
                self._catch_up.note_loss(now)
            # Most samples have no heartbeat, and others may come late.
            self._announced = max(self._announced, number)
            self._shared.timers.set_earlier(self.on_request_due, now + OVERTAKEN)
        else:
            self._shared.counters.over_limit += 1

    def _advance(self, number: int, now: float) -> None:
        """Expect no sample before this number, and hand over what was held for it."""
        self._next = number
        self._confirmed.add(self._guid)
        for held in sorted(self._held):
            if held < number:
                self._hand_over_one(held, now)
            elif held >= number + WINDOW:
                self._unhold(held)
        for partial in [at for at in self._partials if not number <= at < number + WINDOW]:
            self._give_up(partial)
        self._hand_over(now)

    def _hand_over(self, now: float) -> None:
        """Hand over held samples, as far as none is missing."""
        while self._next in self._held and not self.is_paused:
            self._next += 1
            self._hand_over_one(self._next - 1, now)
        self._catch_up.settle(self._next or 1)

    def _hand_over_one(self, number: int, now: float) -> None:
        sample = self._unhold(number)
        if sample is not None:
            self._deliver(self._reader, sample, now)

    def _unhold(self, number: int) -> Sample | None:
        sample = self._held.pop(number)
        if sample is not None:
            self._shared.held.free(len(sample.payload))
        return sample

    def _give_up(self, number: int) -> None:
        """Forget the fragments of a sample."""
        partial = self._partials.get(number)
        if partial is not None:
            self._shared.partials.remove(partial)

    def _missing(self) -> tuple[int, ...]:
        """Return the announced samples that have not begun to arrive."""
        start = self._next or 1
        if start > self._announced:
            return ()
        end = min(self._announced + 1, start + WINDOW)
        return tuple(
            number
            for number in range(start, end)
            if number not in self._held and number not in self._partials
        )

    def _lost_before(self, number: int) -> int:
        """Return how many samples are lost if those before this number do not come any more."""
        return number - (self._next or number) - sum(1 for at in self._held if at < number)

    def _request(self, now: float) -> None:
        """Request what is missing, but not at each of many heartbeats."""
        pause, missing = self._request_pause, self._missing()
        if missing and self._pace.may_request(missing[-1], now):
            if self._pace.just_requested(ACKNOWLEDGE_AFTER, now):
                pause = ACKNOWLEDGE_AFTER
            else:
                self._send_request(missing, now)
        self._shared.timers.set_earlier(self.on_request_due, now + pause)

    def _send_request(self, missing: tuple[int, ...], now: float) -> None:
        self._pace.note_request(missing[-1], now)
        self._acknowledge(NumberSet(self._next or 1, missing), is_final=False)

    def _acknowledge(self, missing: NumberSet, *, is_final: bool) -> None:
        self._owes = False
        self._shared.timers.cancel(self.on_acknowledge_due)
        ends, count = (self._reader.entity, self._guid.entity), self._shared.next_count()
        self._shared.outbox.add(self._route, AckNack(*ends, missing, count, is_final))
