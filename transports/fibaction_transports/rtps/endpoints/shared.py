"""The parts that all endpoints of a participant share."""

from __future__ import annotations

from collections.abc import Callable

from fibaction_transports.rtps.endpoints.catch_up import AnswerTime
from fibaction_transports.rtps.endpoints.fragments import PartialSamples
from fibaction_transports.rtps.events import Event
from fibaction_transports.rtps.limits import ByteAccount, PeerBudget, RtpsCounters, RtpsLimits
from fibaction_transports.rtps.messages.ids import OWN_VENDOR
from fibaction_transports.rtps.outbox import Outbox
from fibaction_transports.rtps.timers import Timers

_LARGEST_COUNT = 2**31 - 1


class SharedParts:
    """The parts of a participant that its endpoints use."""

    def __init__(
        self, prefix: bytes, limits: RtpsLimits, fragment_size: int, emit: Callable[[Event], None]
    ) -> None:
        self.prefix = prefix
        self.limits = limits
        self.fragment_size = fragment_size
        self.emit = emit
        self.counters = RtpsCounters()
        self.timers = Timers()
        self.budgets: dict[bytes, PeerBudget] = {}
        """The budget of each known participant, by its prefix."""
        self.outbox = Outbox(OWN_VENDOR, prefix, limits.outbox, self.budgets, self.counters)
        self.partials = PartialSamples(limits)
        self.held = ByteAccount(limits.held)
        self.answer_time = AnswerTime()
        self._count = 0

    def next_count(self) -> int:
        """Return the count of the next heartbeat or acknowledgement, larger than all before."""
        self._count = self._count % _LARGEST_COUNT + 1
        return self._count
