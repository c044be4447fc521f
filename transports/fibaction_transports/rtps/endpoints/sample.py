"""Samples of a topic: as a reader receives them, and as a writer keeps them to send them again."""

from __future__ import annotations

from collections import deque

from msgspec import Struct

from fibaction.words.errors import LimitReached
from fibaction_transports.rtps.limits import RtpsLimits
from fibaction_transports.rtps.messages.ids import Guid
from fibaction_transports.rtps.messages.layout import ENCAPSULATION
from fibaction_transports.rtps.messages.parameters import STATUS_INFO, Parameters
from fibaction_transports.rtps.messages.submessages import Data

PADDING_BITS = 0x03
"""The bits of the encapsulation header that count the padding."""
_ENDED_BITS = 0x03
DISPOSED = b"\x00\x00\x00\x03"
"""The status of a sample that says: disposed and unregistered."""


class Sample(Struct, frozen=True):
    """One sample that a reader has received."""

    writer: Guid
    number: int
    payload: bytes
    """The serialized data with its encapsulation header, without padding; or empty."""
    inline_qos: Parameters | None = None
    time: float | None = None
    """The time of the writer, in seconds since 1970; None if it has not told it."""
    is_key: bool = False
    """True if the payload is a key only."""

    @property
    def is_ended(self) -> bool:
        """True if the sample says that what it is about is disposed or unregistered."""
        if self.inline_qos is not None:
            for pid, status in self.inline_qos.items:
                if pid == STATUS_INFO and int.from_bytes(status[3:4]) & _ENDED_BITS:
                    return True
        return False


def received_sample(writer: Guid, data: Data, time: float | None) -> Sample:
    """Return the sample in a submessage, as its own bytes."""
    content = b"" if data.payload is None else unpadded(data.payload)
    return Sample(writer, data.number, content, data.inline_qos, time, data.is_key)


def padded(payload: bytes) -> bytes:
    """Return a payload that is padded to a multiple of four bytes, as its header then tells.

    Raises:
        ValueError: The payload has no encapsulation header.
    """
    if len(payload) < ENCAPSULATION:
        raise ValueError(f"payload of {len(payload)} bytes has no encapsulation header of 4 bytes")
    padding = -len(payload) % 4
    return b"".join(
        (payload[:3], bytes([payload[3] & ~PADDING_BITS | padding]), payload[4:], bytes(padding))
    )


def unpadded(payload: bytes | memoryview) -> bytes:
    """Return a received payload without its padding, and with none in its header."""
    padding = payload[3] & PADDING_BITS
    if not padding or len(payload) < ENCAPSULATION + padding:
        return bytes(payload)
    view = memoryview(payload)
    end = len(payload) - padding
    return b"".join((view[:3], bytes([payload[3] & ~PADDING_BITS]), view[4:end]))


class StoredSample(Struct, frozen=True, kw_only=True):
    """A sample that is to be sent, perhaps several times."""

    payload: bytes
    """The serialized data, padded."""
    inline_qos: Parameters | None = None
    time: float | None = None
    only_to: Guid | None = None
    """The one reader that the sample is for; None for all."""
    key: bytes = b""
    """The key of the sample, in a topic with keys."""
    is_disposed: bool = False
    """True if what it is about is disposed: the payload is its key only."""


class History:
    """The samples of one writer, by their numbers.

    With a depth, the newest of each key are kept; without one, all until `forget` is called.
    """

    def __init__(self, depth: int | None, limits: RtpsLimits) -> None:
        if depth is not None and depth < 1:
            raise ValueError(f"depth {depth} keeps no sample: use 1 or more, or None for all")
        self._depth = depth
        self._limits = limits
        self.samples: dict[int, StoredSample] = {}
        """The samples that are kept, by their numbers."""
        self._numbers: dict[bytes, deque[int]] = {}
        self._disposed: deque[int] = deque()
        self.bytes = 0
        """Bytes of the samples that are kept."""
        self.first = 1
        """The number of the oldest sample that is kept; one more than `last` if there is none."""
        self.last = 0
        """The number of the newest sample, kept or not; 0 if there is none."""

    def __len__(self) -> int:
        return len(self.samples)

    @property
    def has_disposed(self) -> bool:
        """True if samples are kept that say that something is disposed."""
        return bool(self._disposed)

    def add(self, sample: StoredSample) -> int:
        """Keep a sample, and return its number.

        Raises:
            LimitReached: The history is full.
        """
        numbers = self._numbers.get(sample.key, deque())
        while self._depth is not None and len(numbers) >= self._depth:
            self.forget(numbers[0])
        limits, size = self._limits, self.bytes + len(sample.payload)
        if size > limits.history or len(self.samples) >= limits.history_samples:
            raise LimitReached(
                f"history of {len(self.samples)} samples and {self.bytes} bytes is full:"
                " wait until readers have acknowledged, or write less"
            )
        self.bytes = size
        self.last += 1
        self.samples[self.last] = sample
        numbers.append(self.last)
        self._numbers[sample.key] = numbers
        if sample.is_disposed:
            self._disposed.append(self.last)
        return self.last

    def forget(self, number: int) -> None:
        """Keep a sample no longer."""
        sample = self.samples.pop(number)
        self.bytes -= len(sample.payload)
        numbers = self._numbers[sample.key]
        numbers.remove(number)
        if not numbers:
            del self._numbers[sample.key]
        while self.first <= self.last and self.first not in self.samples:
            self.first += 1

    def forget_acknowledged(self, number: int, *, is_volatile: bool) -> None:
        """Forget samples up to a number that no reader needs again.

        A history that is not volatile keeps them for later readers, but for disposed ones.
        """
        if is_volatile:
            while self.first <= min(number, self.last):
                self.forget(self.first)
        while self._disposed and self._disposed[0] <= number:
            if (at := self._disposed.popleft()) in self.samples:
                self.forget(at)
