"""Packets and their submessages as bytes and back.

Of a datagram nothing is believed before its bounds are checked. What is written is a multiple of
four bytes long if its payload is.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, TypeAlias

from fibaction_transports.rtps.messages import layout
from fibaction_transports.rtps.messages.ids import PREFIX_SIZE
from fibaction_transports.rtps.messages.layout import (
    BIG,
    LITTLE,
    LOW,
    MAX_NUMBER,
    U32,
    InvalidPacket,
    Order,
    bits_bytes,
    checked_number,
    halves,
    invalid_number,
    read_bits,
    seconds_of,
    time_halves,
)
from fibaction_transports.rtps.messages.parameters import (
    Parameters,
    parameters_bytes,
    read_parameters,
)
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

_Parts: TypeAlias = tuple[int, int, bytes, bytes | memoryview]
"""The kind and the flags of a submessage, its body, and the payload at the end of it."""
_NO_PAYLOAD = b""

_MAX_BODY = 2**16 - 1
DESTINATION_HEAD = layout.SUBMESSAGE_HEAD[LITTLE].pack(
    layout.INFO_DST, layout.LITTLE_FLAG, PREFIX_SIZE
)
"""The head of the submessage that tells the participant, by its prefix, that the rest is for."""


def packet_head(vendor: bytes, prefix: bytes) -> bytes:
    """Return the head of a packet, after which its submessages follow."""
    return layout.MAGIC + layout.VERSION + vendor + prefix


def submessage_pieces(
    submessage: Submessage, order: Order = LITTLE
) -> tuple[bytes, bytes | memoryview]:
    """Return a submessage as on the wire in two pieces, of which the second one is its payload, so
    that a datagram copies it once; inline QoS must have the same byte order.

    Raises:
        ValueError: It is longer than 65,535 bytes.
    """
    kind, flags, body, payload = _ENCODERS[type(submessage)](submessage, order)
    size = len(body) + len(payload)
    if size > _MAX_BODY:
        raise ValueError(f"submessage of {size} bytes exceeds {_MAX_BODY} bytes")
    flags |= layout.LITTLE_FLAG if order == LITTLE else 0
    return layout.SUBMESSAGE_HEAD[order].pack(kind, flags, size) + body, payload


def submessage_bytes(submessage: Submessage, order: Order = LITTLE) -> bytes:
    """Return `submessage_pieces` as one."""
    return b"".join(submessage_pieces(submessage, order))


def _encode_gap(gap: Gap, order: Order) -> _Parts:
    numbers = (*halves(gap.start), *halves(gap.rest.base))
    head = layout.GAP_HEAD[order].pack(gap.reader, gap.writer, *numbers)
    return layout.GAP, 0, head + bits_bytes(gap.rest.base, gap.rest.numbers, order), _NO_PAYLOAD


def _encode_destination(destination: Destination, _: Order) -> _Parts:
    return layout.INFO_DST, 0, destination.prefix, _NO_PAYLOAD


def _encode_source(source: SourceInfo, order: Order) -> _Parts:
    body = layout.SOURCE_BODY[order].pack(layout.VERSION, source.vendor, source.prefix)
    return layout.INFO_SRC, 0, body, _NO_PAYLOAD


def _encode_timestamp(timestamp: Timestamp, order: Order) -> _Parts:
    if timestamp.time is None:
        return layout.INFO_TS, layout.INVALID_FLAG, b"", _NO_PAYLOAD
    body = layout.TIME_BODY[order].pack(*time_halves(timestamp.time))
    return layout.INFO_TS, 0, body, _NO_PAYLOAD


def _encode_data(data: Data, order: Order) -> _Parts:
    distance, number = layout.DATA_HEAD.size - layout.TO_INLINE, data.number
    head = layout.DATA_HEAD[order].pack(
        0, distance, data.reader, data.writer, number >> 32, number & LOW
    )
    inline = b"" if data.inline_qos is None else parameters_bytes(data.inline_qos)
    flags = layout.INLINE_FLAG if inline else 0
    if data.payload is not None:
        flags |= layout.KEY_FLAG if data.is_key else layout.PAYLOAD_FLAG
    return layout.DATA, flags, head + inline, data.payload or _NO_PAYLOAD


def _encode_fragment(fragment: DataFragment, order: Order) -> _Parts:
    head = layout.FRAGMENT_HEAD[order].pack(
        0,
        layout.FRAGMENT_HEAD.size - layout.TO_INLINE,
        fragment.reader,
        fragment.writer,
        *halves(fragment.number),
        fragment.first,
        fragment.count,
        fragment.fragment_size,
        fragment.sample_size,
    )
    inline = b"" if fragment.inline_qos is None else parameters_bytes(fragment.inline_qos)
    flags = layout.INLINE_FLAG if inline else 0
    flags |= layout.FRAGMENT_KEY_FLAG if fragment.is_key else 0
    return layout.DATA_FRAG, flags, head + inline, fragment.payload


def _encode_heartbeat(heartbeat: WriterHeartbeat, order: Order) -> _Parts:
    ends = heartbeat.reader, heartbeat.writer
    first, last = heartbeat.first, heartbeat.last
    span = first >> 32, first & LOW, last >> 32, last & LOW, heartbeat.count
    flags = layout.FINAL_FLAG if heartbeat.is_final else 0
    flags |= layout.ALIVE_FLAG if heartbeat.is_alive else 0
    return layout.HEARTBEAT, flags, layout.HEARTBEAT_BODY[order].pack(*ends, *span), _NO_PAYLOAD


def _encode_nack(nack: AckNack | FragmentNack, order: Order) -> _Parts:
    missing: NumberSet = nack.missing
    tail = bits_bytes(missing.base, missing.numbers, order) + layout.COUNT[order].pack(nack.count)
    ends = nack.reader, nack.writer
    if isinstance(nack, FragmentNack):
        head = layout.NACK_FRAG_HEAD[order].pack(*ends, *halves(nack.number), missing.base)
        return layout.NACK_FRAG, 0, head + tail, _NO_PAYLOAD
    head = layout.ACK_NACK_HEAD[order].pack(*ends, *halves(missing.base))
    return layout.ACK_NACK, layout.FINAL_FLAG if nack.is_final else 0, head + tail, _NO_PAYLOAD


_ENCODERS: dict[type[Any], Callable[[Any, Order], _Parts]] = {
    Data: _encode_data,
    DataFragment: _encode_fragment,
    AckNack: _encode_nack,
    FragmentNack: _encode_nack,
    WriterHeartbeat: _encode_heartbeat,
    Gap: _encode_gap,
    Destination: _encode_destination,
    SourceInfo: _encode_source,
    Timestamp: _encode_timestamp,
}


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
        submessages = tuple(_decode_submessages(datagram))
    except struct.error as error:
        raise InvalidPacket("submessage is shorter than its kind") from error
    prefix, vendor = datagram[8 : layout.PACKET_HEAD], datagram[6:8]
    return Packet(prefix, vendor, submessages, len(datagram))


def _decode_submessages(datagram: bytes) -> list[Submessage]:
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
        read = _DECODERS.get(kind)
        if read is not None:
            found.append(read(data[offset : offset + size], flags, order))
        offset += size
    return found


def _decode_data(body: memoryview, flags: int, order: Order) -> Data:
    _, distance, reader, writer, high, low = layout.DATA_HEAD[order].unpack_from(body)
    inline, place = None, layout.TO_INLINE + distance
    if flags & layout.INLINE_FLAG or place != layout.DATA_HEAD.size:
        inline, place = _decode_inline_qos(body, flags, order, place, layout.DATA_HEAD.size)
    is_key = bool(flags & layout.KEY_FLAG)
    payload = body[place:] if is_key or flags & layout.PAYLOAD_FLAG else None
    if payload is not None and len(payload) < U32.size:
        raise InvalidPacket(f"payload of {len(payload)} bytes has no encapsulation header")
    number = (high << 32) | low
    if not 0 < number < MAX_NUMBER:
        raise invalid_number(number, 1)
    return Data(reader, writer, number, payload, inline, is_key)


def _decode_fragment(body: memoryview, flags: int, order: Order) -> DataFragment:
    fields = layout.FRAGMENT_HEAD[order].unpack_from(body)
    _, distance, reader, writer, high, low, first, count, size, whole = fields
    least = layout.FRAGMENT_HEAD.size
    inline, place = _decode_inline_qos(body, flags, order, layout.TO_INLINE + distance, least)
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


def _decode_inline_qos(
    body: memoryview, flags: int, order: Order, place: int, least: int
) -> tuple[Parameters | None, int]:
    """Return the inline QoS, which begin at a place, and the place of the payload."""
    if not least <= place <= len(body):
        raise InvalidPacket(f"inline QoS at byte {place} is outside its submessage")
    return read_parameters(body, order, place) if flags & layout.INLINE_FLAG else (None, place)


def _decode_heartbeat(body: memoryview, flags: int, order: Order) -> WriterHeartbeat:
    fields = layout.HEARTBEAT_BODY[order].unpack_from(body)
    reader, writer, first_high, first_low, last_high, last_low, count = fields
    first, last = (first_high << 32) | first_low, (last_high << 32) | last_low
    if not 0 < first < MAX_NUMBER:
        raise invalid_number(first, 1)
    if not first - 1 <= last < MAX_NUMBER:
        raise invalid_number(last, first - 1)
    is_final, is_alive = bool(flags & layout.FINAL_FLAG), bool(flags & layout.ALIVE_FLAG)
    return WriterHeartbeat(reader, writer, first, last, count, is_final, is_alive)


def _decode_acknack(body: memoryview, flags: int, order: Order) -> AckNack:
    reader, writer, high, low = layout.ACK_NACK_HEAD[order].unpack_from(body)
    base = checked_number(high, low, least=0)  # Fast DDS begins with 0
    numbers, place = read_bits(body, order, layout.ACK_NACK_HEAD.size, base)
    (count,) = layout.COUNT[order].unpack_from(body, place)
    missing = NumberSet(base, tuple(number for number in numbers if number))
    return AckNack(reader, writer, missing, count, bool(flags & layout.FINAL_FLAG))


def _decode_fragment_nack(body: memoryview, _: int, order: Order) -> FragmentNack:
    reader, writer, high, low, base = layout.NACK_FRAG_HEAD[order].unpack_from(body)
    numbers, place = read_bits(body, order, layout.NACK_FRAG_HEAD.size, base)
    (count,) = layout.COUNT[order].unpack_from(body, place)
    return FragmentNack(reader, writer, checked_number(high, low), NumberSet(base, numbers), count)


def _decode_gap(body: memoryview, _: int, order: Order) -> Gap:
    reader, writer, *numbers = layout.GAP_HEAD[order].unpack_from(body)
    start = checked_number(numbers[0], numbers[1])
    base = checked_number(numbers[2], numbers[3], start)
    found, _ = read_bits(body, order, layout.GAP_HEAD.size, base)
    return Gap(reader, writer, start, NumberSet(base, found))


def _decode_destination(body: memoryview, _: int, order: Order) -> Destination:
    if len(body) < PREFIX_SIZE:
        raise InvalidPacket("destination is shorter than a prefix")
    return Destination(bytes(body[:PREFIX_SIZE]))


def _decode_timestamp(body: memoryview, flags: int, order: Order) -> Timestamp:
    if flags & layout.INVALID_FLAG:
        return Timestamp(None)
    return Timestamp(seconds_of(*layout.TIME_BODY[order].unpack_from(body)))


def _decode_source(body: memoryview, _: int, order: Order) -> SourceInfo:
    _, vendor, prefix = layout.SOURCE_BODY[order].unpack_from(body)
    return SourceInfo(vendor, prefix)


_DECODERS: dict[int, Callable[[memoryview, int, Order], Submessage]] = {
    layout.ACK_NACK: _decode_acknack,
    layout.HEARTBEAT: _decode_heartbeat,
    layout.GAP: _decode_gap,
    layout.INFO_TS: _decode_timestamp,
    layout.INFO_SRC: _decode_source,
    layout.INFO_DST: _decode_destination,
    layout.NACK_FRAG: _decode_fragment_nack,
    layout.DATA: _decode_data,
    layout.DATA_FRAG: _decode_fragment,
}
