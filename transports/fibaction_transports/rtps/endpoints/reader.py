"""The reader of a topic, reliable or best effort, and heartbeats that come before it is matched."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import TypeAlias

from msgspec.structs import replace

from fibaction_transports.rtps.endpoints.sample import Sample, StoredSample, unpadded
from fibaction_transports.rtps.endpoints.shared import SharedParts
from fibaction_transports.rtps.endpoints.writer_proxy import WriterProxy
from fibaction_transports.rtps.events import CaughtUp
from fibaction_transports.rtps.limits import RtpsLimits
from fibaction_transports.rtps.messages.ids import Guid
from fibaction_transports.rtps.messages.submessages import WriterHeartbeat
from fibaction_transports.rtps.outbox import PeerRoute
from fibaction_transports.rtps.qos import Qos


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


Deliver: TypeAlias = Callable[[Guid, Sample, float], None]
"""A callback for a reader's GUID, a sample and the time."""


class DataReader:
    """The reader of a topic: it hands over the samples of each writer in order, and once."""

    def __init__(
        self,
        guid: Guid,
        topic: str,
        type_name: str,
        qos: Qos,
        shared: SharedParts,
        deliver: Deliver,
    ) -> None:
        self.guid = guid
        self.topic = topic
        self.type_name = type_name
        self.qos = qos
        self._shared = shared
        self._deliver = deliver
        self.is_paused = False
        """True if samples of reliable writers of other participants are held back."""
        self.proxies: dict[Guid, WriterProxy] = {}
        """The matched writers of other participants, which take what is received of them."""
        self.own_writers: dict[Guid, Callable[[], None]] = {}
        """The matched writers of the same participant, and what ends the match."""
        self.confirmed_writers: set[Guid] = set()
        """The matched writers that have found this reader, too, as far as they tell: reliable ones
        send heartbeats, and only to readers that they have found.
        """

    @property
    def writers(self) -> list[Guid]:
        """All matched writers."""
        return [*self.proxies, *self.own_writers]

    def is_complete(self, writer: Guid) -> bool:
        """Return whether a writer has told which samples it has, and all of them have come; False
        if it is not matched.
        """
        proxy = self.proxies.get(writer)
        return writer in self.own_writers if proxy is None else proxy.is_complete

    def match(
        self,
        writer: Guid,
        route: PeerRoute,
        qos: Qos,
        vendor: bytes,
        now: float,
        heartbeat: WriterHeartbeat | None = None,
    ) -> None:
        """Take the samples of a writer from now on, which may have sent a heartbeat before."""
        is_reliable = self.qos.is_reliable and qos.is_reliable
        proxy = WriterProxy(
            writer,
            route,
            vendor,
            self.guid,
            self._shared,
            self._deliver,
            self._tell_caught_up,
            self.confirmed_writers,
        )
        proxy.is_paused = self.is_paused
        self.proxies[writer] = proxy
        if is_reliable:
            proxy.start_reliable(heartbeat, now)

    def unmatch(self, writer: Guid) -> bool:
        """Forget a writer; return whether it was matched."""
        proxy = self.proxies.pop(writer, None)
        if proxy is not None:
            proxy.close()
        return proxy is not None

    def pause(self, now: float, *, is_paused: bool) -> None:
        """Hold samples of reliable writers back, and acknowledge none of them, so that a writer
        which keeps all of them waits; or take them again.
        """
        self.is_paused = is_paused
        for proxy in [*self.proxies.values()]:
            proxy.is_paused = is_paused
            if not is_paused:
                proxy.resume(now)

    def take_own(self, writer: Guid, number: int, stored: StoredSample, now: float) -> None:
        """Take a sample of a writer of the same participant, if it is for this reader."""
        if stored.only_to in (None, self.guid):
            content = unpadded(stored.payload)
            sample = Sample(writer, number, content, stored.inline_qos, stored.time)
            self._deliver(self.guid, sample, now)

    def ask(self, now: float) -> None:
        """Ask every writer for its newest samples, without waiting for its heartbeat.

        Fast DDS repeats a lost heartbeat only after three seconds. If you wait for an answer, ask
        after about 30 ms, and again after twice the time.
        """
        for proxy in self.proxies.values():
            proxy.ask(now)

    @property
    def is_catching_up(self) -> bool:
        """True if writers have been asked by `catch_up`, and `CaughtUp` is still to come."""
        return any(proxy.is_catching_up for proxy in self.proxies.values())

    def catch_up(self, now: float) -> bool:
        """Find out whether samples are missing that were written before, and get them.

        Return True if that takes time: the event `CaughtUp` tells when all of them have come, by
        the rules of `CatchUp`. Return False if there is no need to ask, or no way.
        """
        for proxy in self.proxies.values():
            proxy.catch_up(now)
        return self.is_catching_up

    def _tell_caught_up(self) -> None:
        if not self.is_catching_up:
            self._shared.emit(CaughtUp(self.guid))

    def close(self) -> None:
        """Forget all writers."""
        for writer in [*self.proxies]:
            self.unmatch(writer)
        for unmatch in [*self.own_writers.values()]:
            unmatch()
