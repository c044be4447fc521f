"""The submessages of RTPS, as values.

`codec` reads and writes them. Each class is named by what it says; its name in the specification is
in its description.
"""

from __future__ import annotations

from typing import TypeAlias

from msgspec import Struct

from fibaction_transports.rtps.messages.parameters import Parameters


class NumberSet(Struct, frozen=True):
    """Sequence numbers or fragment numbers, of at most 256 from the base on."""

    base: int
    """Every number below it is not in question."""
    numbers: tuple[int, ...] = ()
    """The numbers of the set, ascending."""


class Data(Struct, frozen=True):
    """DATA: one sample, whole."""

    reader: bytes
    writer: bytes
    number: int
    payload: bytes | memoryview | None = None
    """The serialized data with its encapsulation header; None for inline parameters alone."""
    inline_qos: Parameters | None = None
    is_key: bool = False
    """True if the payload is the key of a disposed sample only."""


class DataFragment(Struct, frozen=True):
    """DATA_FRAG: fragments of a sample that follow each other."""

    reader: bytes
    writer: bytes
    number: int
    first: int
    """Number of the first of these fragments, from 1 on."""
    count: int
    """Number of these fragments."""
    fragment_size: int
    """Size of every fragment of the sample but the last, in bytes."""
    sample_size: int
    """Size of the whole sample, in bytes."""
    payload: bytes | memoryview
    inline_qos: Parameters | None = None
    is_key: bool = False


class WriterHeartbeat(Struct, frozen=True):
    """HEARTBEAT: the samples that a writer has."""

    reader: bytes
    writer: bytes
    first: int
    last: int
    """The number of the newest sample; one less than `first` if there is none."""
    count: int
    is_final: bool = False
    """True if no answer is needed."""
    is_alive: bool = False
    """True if the writer says that it is alive."""


class AckNack(Struct, frozen=True):
    """ACKNACK: the samples that a reader has, and those that it misses."""

    reader: bytes
    writer: bytes
    missing: NumberSet
    """Samples below the base have arrived, the numbers are missing."""
    count: int
    is_final: bool = False
    """True if no answer is needed."""


class FragmentNack(Struct, frozen=True):
    """NACK_FRAG: the fragments of a sample that a reader misses."""

    reader: bytes
    writer: bytes
    number: int
    missing: NumberSet
    count: int


class Gap(Struct, frozen=True):
    """GAP: samples that a reader will not get: from `start` below the base, and the numbers."""

    reader: bytes
    writer: bytes
    start: int
    rest: NumberSet


class Destination(Struct, frozen=True):
    """INFO_DST: the participant that the following submessages are for."""

    prefix: bytes


class Timestamp(Struct, frozen=True):
    """INFO_TS: the time of the following samples, in seconds since 1970; None if it is unknown."""

    time: float | None


class SourceInfo(Struct, frozen=True):
    """INFO_SRC: the participant that the following submessages are from."""

    vendor: bytes
    prefix: bytes


Submessage: TypeAlias = (
    Data
    | DataFragment
    | WriterHeartbeat
    | AckNack
    | FragmentNack
    | Gap
    | Destination
    | Timestamp
    | SourceInfo
)


class Packet(Struct, frozen=True):
    """One datagram: its sender and the submessages."""

    prefix: bytes
    vendor: bytes
    submessages: tuple[Submessage, ...]
    size: int
    """Size of the datagram, in bytes."""
