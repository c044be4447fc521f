"""Packets from datagrams, of which nothing is believed before its bounds are checked."""

from __future__ import annotations

import struct
from collections.abc import Callable

from fibaction_transports.rtps.messages import layout
from fibaction_transports.rtps.messages.ids import PREFIX_SIZE
from fibaction_transports.rtps.messages.layout import (
    BIG,
    LITTLE,
    MAX_NUMBER,
    U32,
    InvalidPacket,
    Order,
    checked_number,
    invalid_number,
    read_bits,
    seconds_of,
)
from fibaction_transports.rtps.messages.parameters import Parameters, read_parameters
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    Destination,
    FragmentNack,
    Gap,
    NumberSet,
    Packet,
    SourceInfo,
    Submessage,
    Timestamp,
    WriterHeartbeat,
)

MAX_FRAGMENTS = 2**16
"""The most fragments of one sample."""


def read_packet(datagram: bytes) -> Packet:
    """Read a datagram. Submessages of kinds that are not used, such as those of vendors,
    are left out.

    Raises:
        InvalidPacket: The datagram breaks the rules, or a limit. None of it is to be used.
    """
    if len(datagram) < layout.PACKET_HEAD or datagram[:4] != layout.MAGIC:
        raise InvalidPacket(f"datagram of {len(datagram)} bytes does not begin as RTPS does")
    if datagram[4] != layout.VERSION[0]:
        raise InvalidPacket(f"version {datagram[4]} of RTPS is not {layout.VERSION[0]}")
    try:
        submessages = tuple(_submessages(datagram))
    except struct.error as error:
        raise InvalidPacket("submessage is shorter than its kind") from error
    prefix, vendor = datagram[8 : layout.PACKET_HEAD], datagram[6:8]
    return Packet(prefix, vendor, submessages, len(datagram))


def _submessages(datagram: bytes) -> list[Submessage]:
    found = list[Submessage]()
    data, heads = memoryview(datagram), layout.SUBMESSAGE_HEAD
    offset, end, step = layout.PACKET_HEAD, len(datagram), heads.size
    while offset + step <= end:
        order = LITTLE if datagram[offset + 1] & layout.LITTLE_FLAG else BIG
        kind, flags, size = heads[order].unpack_from(datagram, offset)
        offset += step
        if size == 0 and kind not in (layout.PAD, layout.INFO_TS):
            size = end - offset  # the last one may leave its length out
        if offset + size > end:
            raise InvalidPacket(f"submessage of {size} bytes is longer than its datagram")
        read = _READERS.get(kind)
        if read is not None:
            found.append(read(data[offset : offset + size], flags, order))
        offset += size
    return found


def _data(body: memoryview, flags: int, order: Order) -> Data:
    _, distance, reader, writer, high, low = layout.DATA_HEAD[order].unpack_from(body)
    inline, place = None, layout.TO_INLINE + distance
    if flags & layout.INLINE_FLAG or place != layout.DATA_HEAD.size:
        inline, place = _inline_qos(body, flags, order, place, layout.DATA_HEAD.size)
    is_key = bool(flags & layout.KEY_FLAG)
    payload = body[place:] if is_key or flags & layout.PAYLOAD_FLAG else None
    if payload is not None and len(payload) < U32.size:
        raise InvalidPacket(f"payload of {len(payload)} bytes has no encapsulation header")
    number = (high << 32) | low
    if not 0 < number < MAX_NUMBER:
        raise invalid_number(number, 1)
    return Data(reader, writer, number, payload, inline, is_key)


def _fragment(body: memoryview, flags: int, order: Order) -> DataFragment:
    fields = layout.FRAGMENT_HEAD[order].unpack_from(body)
    _, distance, reader, writer, high, low, first, count, size, whole = fields
    least = layout.FRAGMENT_HEAD.size
    inline, place = _inline_qos(body, flags, order, layout.TO_INLINE + distance, least)
    if size == 0 or whole < U32.size or -(-whole // size) > MAX_FRAGMENTS:
        raise InvalidPacket(f"sample of {whole} bytes in fragments of {size} is beyond the limits")
    last = first + count - 1
    if first < 1 or count < 1 or last > -(-whole // size):
        raise InvalidPacket(f"fragments {first} to {last} are not in the sample")
    expected = min(count * size, whole - (first - 1) * size)
    if len(body) - place < expected:
        raise InvalidPacket(f"fragments have {len(body) - place} of {expected} bytes")
    return DataFragment(
        reader,
        writer,
        checked_number(high, low),
        first,
        count,
        size,
        whole,
        body[place : place + expected],
        inline,
        bool(flags & layout.FRAGMENT_KEY_FLAG),
    )


def _inline_qos(
    body: memoryview, flags: int, order: Order, place: int, least: int
) -> tuple[Parameters | None, int]:
    """Return the inline QoS, which begin at a place, and the place of the payload."""
    if not least <= place <= len(body):
        raise InvalidPacket(f"inline QoS at byte {place} is outside its submessage")
    return read_parameters(body, order, place) if flags & layout.INLINE_FLAG else (None, place)


def _heartbeat(body: memoryview, flags: int, order: Order) -> WriterHeartbeat:
    fields = layout.HEARTBEAT_BODY[order].unpack_from(body)
    reader, writer, first_high, first_low, last_high, last_low, count = fields
    first, last = (first_high << 32) | first_low, (last_high << 32) | last_low
    if not 0 < first < MAX_NUMBER:
        raise invalid_number(first, 1)
    if not first - 1 <= last < MAX_NUMBER:
        raise invalid_number(last, first - 1)
    is_final, is_alive = bool(flags & layout.FINAL_FLAG), bool(flags & layout.ALIVE_FLAG)
    return WriterHeartbeat(reader, writer, first, last, count, is_final, is_alive)


def _acknack(body: memoryview, flags: int, order: Order) -> AckNack:
    reader, writer, high, low = layout.ACK_NACK_HEAD[order].unpack_from(body)
    base = checked_number(high, low, least=0)  # Fast DDS begins with 0
    numbers, place = read_bits(body, order, layout.ACK_NACK_HEAD.size, base)
    (count,) = layout.COUNT[order].unpack_from(body, place)
    missing = NumberSet(base, tuple(number for number in numbers if number))
    return AckNack(reader, writer, missing, count, bool(flags & layout.FINAL_FLAG))


def _fragment_nack(body: memoryview, _: int, order: Order) -> FragmentNack:
    reader, writer, high, low, base = layout.NACK_FRAG_HEAD[order].unpack_from(body)
    numbers, place = read_bits(body, order, layout.NACK_FRAG_HEAD.size, base)
    (count,) = layout.COUNT[order].unpack_from(body, place)
    return FragmentNack(reader, writer, checked_number(high, low), NumberSet(base, numbers), count)


def _gap(body: memoryview, _: int, order: Order) -> Gap:
    reader, writer, *numbers = layout.GAP_HEAD[order].unpack_from(body)
    start = checked_number(numbers[0], numbers[1])
    base = checked_number(numbers[2], numbers[3], start)
    found, _ = read_bits(body, order, layout.GAP_HEAD.size, base)
    return Gap(reader, writer, start, NumberSet(base, found))


def _destination(body: memoryview, _: int, order: Order) -> Destination:
    if len(body) < PREFIX_SIZE:
        raise InvalidPacket("destination is shorter than a prefix")
    return Destination(bytes(body[:PREFIX_SIZE]))


def _timestamp(body: memoryview, flags: int, order: Order) -> Timestamp:
    if flags & layout.INVALID_FLAG:
        return Timestamp(None)
    return Timestamp(seconds_of(*layout.TIME_BODY[order].unpack_from(body)))


def _source(body: memoryview, _: int, order: Order) -> SourceInfo:
    _, vendor, prefix = layout.SOURCE_BODY[order].unpack_from(body)
    return SourceInfo(vendor, prefix)


_READERS: dict[int, Callable[[memoryview, int, Order], Submessage]] = {
    layout.ACK_NACK: _acknack,
    layout.HEARTBEAT: _heartbeat,
    layout.GAP: _gap,
    layout.INFO_TS: _timestamp,
    layout.INFO_SRC: _source,
    layout.INFO_DST: _destination,
    layout.NACK_FRAG: _fragment_nack,
    layout.DATA: _data,
    layout.DATA_FRAG: _fragment,
}
