"""Heartbeats of writers that discovery has not told of yet."""

from __future__ import annotations

from collections import OrderedDict

from msgspec.structs import replace

from fibaction_transports.rtps.limits import RtpsLimits
from fibaction_transports.rtps.messages.ids import Guid
from fibaction_transports.rtps.messages.submessages import WriterHeartbeat


class EarlyHeartbeats:
    """The newest heartbeat of each writer that no reader is matched with yet.

    Fast DDS sends its first heartbeat before its discovery has told of the writer, and the next one
    three seconds later. Its first sample may come before discovery, too, without a heartbeat of its
    own: that sample counts as announced, so that it is requested when the writer is matched.
    """

    def __init__(self, limits: RtpsLimits) -> None:
        self._limit = limits.early_heartbeats
        self._limit_of_one = limits.early_heartbeats_of_one
        self._of: OrderedDict[bytes, OrderedDict[Guid, WriterHeartbeat]] = OrderedDict()
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def keep(self, writer: Guid, heartbeat: WriterHeartbeat) -> None:
        """Keep a heartbeat until its writer is matched, or too many others have come."""
        of_one = self._of.setdefault(writer.prefix, OrderedDict())
        self._count += writer not in of_one
        of_one[writer] = heartbeat
        of_one.move_to_end(writer)
        self._of.move_to_end(writer.prefix)
        if len(of_one) > self._limit_of_one:
            self.take(next(iter(of_one)))
        elif self._count > self._limit:
            self.take(next(iter(next(iter(self._of.values())))))

    def note_sample(self, writer: Guid, number: int) -> None:
        """Note that a sample came which no reader could take yet."""
        of_one = self._of.get(writer.prefix)
        if of_one is not None and writer in of_one and of_one[writer].last < number:
            of_one[writer] = replace(of_one[writer], last=number)

    def take(self, writer: Guid) -> WriterHeartbeat | None:
        """Return the heartbeat of a writer, and keep it no longer; None if there is none."""
        of_one = self._of.get(writer.prefix)
        if of_one is None or writer not in of_one:
            return None
        heartbeat = of_one.pop(writer)
        self._count -= 1
        if not of_one:
            del self._of[writer.prefix]
        return heartbeat

    def forget_participant(self, prefix: bytes) -> None:
        """Keep no heartbeat of a participant."""
        self._count -= len(self._of.pop(prefix, ()))
