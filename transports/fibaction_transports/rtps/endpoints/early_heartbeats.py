"""Heartbeats of writers that discovery has not told of yet."""

from __future__ import annotations

from collections import OrderedDict

from fibaction_transports.rtps.messages.ids import Guid
from fibaction_transports.rtps.messages.submessages import WriterHeartbeat


class EarlyHeartbeats:
    """The newest heartbeat of each writer that no reader is matched with yet.

    Fast DDS sends its first heartbeat before its discovery has told of the writer, and the next one
    three seconds later.
    """

    def __init__(self, limit: int) -> None:
        """Keep those of at most so many writers."""
        self._limit = limit
        self._heartbeats: OrderedDict[Guid, WriterHeartbeat] = OrderedDict()

    def __len__(self) -> int:
        return len(self._heartbeats)

    def keep(self, writer: Guid, heartbeat: WriterHeartbeat) -> None:
        """Keep a heartbeat until its writer is matched, or too many others have come."""
        self._heartbeats[writer] = heartbeat
        self._heartbeats.move_to_end(writer)
        if len(self._heartbeats) > self._limit:
            self._heartbeats.popitem(last=False)

    def take(self, writer: Guid) -> WriterHeartbeat | None:
        """Return the heartbeat of a writer, and keep it no longer; None if there is none."""
        return self._heartbeats.pop(writer, None)
