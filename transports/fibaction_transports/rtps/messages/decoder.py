"""Packets from datagrams. Nothing of a datagram is believed before its bounds are checked."""

from __future__ import annotations

import struct
from collections.abc import Callable

from fibaction_transports.rtps.messages import kinds
from fibaction_transports.rtps.messages.errors import InvalidPacket
from fibaction_transports.rtps.messages.ids import PREFIX_SIZE
from fibaction_transports.rtps.messages.layout import (
    BIG,
    LITTLE,
    MAX_NUMBER,
    U32,
    Order,
    checked_number,
    invalid_number,
    seconds_of,
)
from fibaction_transports.rtps.messages.locators import LOCATOR_SIZE, Locator, read_locator
from fibaction_transports.rtps.messages.number_sets import read_bits
from fibaction_transports.rtps.messages.parameters import Parameters, read_parameters
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    Destination,
    FragmentHeartbeat,
    FragmentNack,
    Gap,
    NumberSet,
    Packet,
    ReplyLocators,
    SourceInfo,
    Submessage,
    Timestamp,
    WriterHeartbeat,
)

MAX_FRAGMENTS = 2**16
"""The most fragments of one sample."""
MAX_LOCATORS = 64
"""The most locators of one INFO_REPLY."""


def read_packet(datagram: bytes) -> Packet:
    """Read a datagram. Submessages of unknown kinds, such as those of vendors, are left out.

    Raises:
        InvalidPacket: The datagram breaks the rules, or a limit. None of it is to be used.
    """
    if len(datagram) < kinds.PACKET_HEAD or datagram[:4] != kinds.MAGIC:
        raise InvalidPacket(f"datagram of {len(datagram)} bytes does not begin as RTPS does")
    if datagram[4] != kinds.VERSION[0]:
        raise InvalidPacket(f"version {datagram[4]} of RTPS is not {kinds.VERSION[0]}")
    try:
        submessages = tuple(_submessages(memoryview(datagram)))
    except struct.error as error:
        raise InvalidPacket("submessage is shorter than its kind") from error
    prefix, vendor = datagram[8 : kinds.PACKET_HEAD], datagram[6:8]
    return Packet(prefix, vendor, submessages, len(datagram))


def _submessages(data: memoryview) -> list[Submessage]:
    found = list[Submessage]()
    offset, end = kinds.PACKET_HEAD, len(data)
    while offset + kinds.SUBMESSAGE_HEAD.size <= end:
        order = LITTLE if data[offset + 1] & kinds.LITTLE_FLAG else BIG
        kind, flags, size = kinds.SUBMESSAGE_HEAD[order].unpack_from(data, offset)
        offset += kinds.SUBMESSAGE_HEAD.size
        if size == 0 and kind not in (kinds.PAD, kinds.INFO_TS):
            size = end - offset  # the last one may leave its length out
        if offset + size > end:
            raise InvalidPacket(f"submessage of {size} bytes is longer than its datagram")
        read = _READERS.get(kind)
        if read is not None:
            found.append(read(data[offset : offset + size], flags, order))
        offset += size
    return found


def _data(body: memoryview, flags: int, order: Order) -> Data:
    _, distance, reader, writer, high, low = kinds.DATA_HEAD[order].unpack_from(body)
    inline, place = None, kinds.TO_INLINE + distance
    if flags & kinds.INLINE_FLAG or place != kinds.DATA_HEAD.size:
        inline, place = _inline_qos(body, flags, order, place, kinds.DATA_HEAD.size)
    is_key = bool(flags & kinds.KEY_FLAG)
    payload = body[place:] if is_key or flags & kinds.PAYLOAD_FLAG else None
    if payload is not None and len(payload) < U32.size:
        raise InvalidPacket(f"payload of {len(payload)} bytes has no encapsulation header")
    number = (high << 32) | low
    if not 0 < number < MAX_NUMBER:
        raise invalid_number(number, 1)
    return Data(reader, writer, number, payload, inline, is_key)


def _fragment(body: memoryview, flags: int, order: Order) -> DataFragment:
    fields = kinds.FRAGMENT_HEAD[order].unpack_from(body)
    _, distance, reader, writer, high, low, first, count, size, whole = fields
    least = kinds.FRAGMENT_HEAD.size
    inline, place = _inline_qos(body, flags, order, kinds.TO_INLINE + distance, least)
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
        bool(flags & kinds.FRAGMENT_KEY_FLAG),
    )


def _inline_qos(
    body: memoryview, flags: int, order: Order, place: int, least: int
) -> tuple[Parameters | None, int]:
    """Return the inline QoS, which begin at a place, and the place of the payload."""
    if not least <= place <= len(body):
        raise InvalidPacket(f"inline QoS at byte {place} is outside its submessage")
    return read_parameters(body, order, place) if flags & kinds.INLINE_FLAG else (None, place)


def _heartbeat(body: memoryview, flags: int, order: Order) -> WriterHeartbeat:
    reader, writer, *numbers, count = kinds.HEARTBEAT_BODY[order].unpack_from(body)
    first, last = (numbers[0] << 32) | numbers[1], (numbers[2] << 32) | numbers[3]
    if not 0 < first < MAX_NUMBER:
        raise invalid_number(first, 1)
    if not first - 1 <= last < MAX_NUMBER:
        raise invalid_number(last, first - 1)
    is_final, is_alive = bool(flags & kinds.FINAL_FLAG), bool(flags & kinds.ALIVE_FLAG)
    return WriterHeartbeat(reader, writer, first, last, count, is_final, is_alive)


def _fragment_heartbeat(body: memoryview, _: int, order: Order) -> FragmentHeartbeat:
    reader, writer, high, low, last, count = kinds.HEARTBEAT_FRAG_BODY[order].unpack_from(body)
    return FragmentHeartbeat(reader, writer, checked_number(high, low), last, count)


def _acknack(body: memoryview, flags: int, order: Order) -> AckNack:
    reader, writer, high, low = kinds.ACK_NACK_HEAD[order].unpack_from(body)
    base = checked_number(high, low, least=0)  # Fast DDS begins with 0
    numbers, place = read_bits(body, order, kinds.ACK_NACK_HEAD.size, base)
    (count,) = kinds.COUNT[order].unpack_from(body, place)
    missing = NumberSet(base, tuple(number for number in numbers if number))
    return AckNack(reader, writer, missing, count, bool(flags & kinds.FINAL_FLAG))


def _fragment_nack(body: memoryview, _: int, order: Order) -> FragmentNack:
    reader, writer, high, low, base = kinds.NACK_FRAG_HEAD[order].unpack_from(body)
    numbers, place = read_bits(body, order, kinds.NACK_FRAG_HEAD.size, base)
    (count,) = kinds.COUNT[order].unpack_from(body, place)
    return FragmentNack(reader, writer, checked_number(high, low), NumberSet(base, numbers), count)


def _gap(body: memoryview, _: int, order: Order) -> Gap:
    reader, writer, *numbers = kinds.GAP_HEAD[order].unpack_from(body)
    start = checked_number(numbers[0], numbers[1])
    base = checked_number(numbers[2], numbers[3], start)
    found, _ = read_bits(body, order, kinds.GAP_HEAD.size, base)
    return Gap(reader, writer, start, NumberSet(base, found))


def _destination(body: memoryview, _: int, order: Order) -> Destination:
    if len(body) < PREFIX_SIZE:
        raise InvalidPacket("destination is shorter than a prefix")
    return Destination(bytes(body[:PREFIX_SIZE]))


def _timestamp(body: memoryview, flags: int, order: Order) -> Timestamp:
    if flags & kinds.INVALID_FLAG:
        return Timestamp(None)
    return Timestamp(seconds_of(*kinds.TIME_BODY[order].unpack_from(body)))


def _source(body: memoryview, _: int, order: Order) -> SourceInfo:
    _, vendor, prefix = kinds.SOURCE_BODY[order].unpack_from(body)
    return SourceInfo(vendor, prefix)


def _reply(body: memoryview, flags: int, order: Order) -> ReplyLocators:
    unicast, place = _locators(body, order, 0)
    if not flags & kinds.MULTICAST_FLAG:
        return ReplyLocators(unicast)
    return ReplyLocators(unicast, _locators(body, order, place)[0])


def _locators(body: memoryview, order: Order, place: int) -> tuple[tuple[Locator, ...], int]:
    (count,) = U32[order].unpack_from(body, place)
    if count > MAX_LOCATORS:
        raise InvalidPacket(f"{count} locators exceed {MAX_LOCATORS}")
    place += U32.size
    end = place + count * LOCATOR_SIZE
    return tuple(read_locator(body, order, at) for at in range(place, end, LOCATOR_SIZE)), end


_READERS: dict[int, Callable[[memoryview, int, Order], Submessage]] = {
    kinds.ACK_NACK: _acknack,
    kinds.HEARTBEAT: _heartbeat,
    kinds.GAP: _gap,
    kinds.INFO_TS: _timestamp,
    kinds.INFO_SRC: _source,
    kinds.INFO_DST: _destination,
    kinds.INFO_REPLY: _reply,
    kinds.NACK_FRAG: _fragment_nack,
    kinds.HEARTBEAT_FRAG: _fragment_heartbeat,
    kinds.DATA: _data,
    kinds.DATA_FRAG: _fragment,
}
