"""Submessages as bytes, each a multiple of four bytes long if its payload is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

from fibaction_transports.rtps.messages import layout
from fibaction_transports.rtps.messages.ids import PREFIX_SIZE
from fibaction_transports.rtps.messages.layout import (
    LITTLE,
    LOW,
    Order,
    bits_bytes,
    halves,
    time_halves,
)
from fibaction_transports.rtps.messages.parameters import parameters_bytes
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    Destination,
    FragmentNack,
    Gap,
    NumberSet,
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


def _gap(gap: Gap, order: Order) -> _Parts:
    numbers = (*halves(gap.start), *halves(gap.rest.base))
    head = layout.GAP_HEAD[order].pack(gap.reader, gap.writer, *numbers)
    return layout.GAP, 0, head + bits_bytes(gap.rest.base, gap.rest.numbers, order), _NO_PAYLOAD


def _destination(destination: Destination, _: Order) -> _Parts:
    return layout.INFO_DST, 0, destination.prefix, _NO_PAYLOAD


def _source(source: SourceInfo, order: Order) -> _Parts:
    body = layout.SOURCE_BODY[order].pack(layout.VERSION, source.vendor, source.prefix)
    return layout.INFO_SRC, 0, body, _NO_PAYLOAD


def _timestamp(timestamp: Timestamp, order: Order) -> _Parts:
    if timestamp.time is None:
        return layout.INFO_TS, layout.INVALID_FLAG, b"", _NO_PAYLOAD
    body = layout.TIME_BODY[order].pack(*time_halves(timestamp.time))
    return layout.INFO_TS, 0, body, _NO_PAYLOAD


def _data(data: Data, order: Order) -> _Parts:
    distance, number = layout.DATA_HEAD.size - layout.TO_INLINE, data.number
    head = layout.DATA_HEAD[order].pack(
        0, distance, data.reader, data.writer, number >> 32, number & LOW
    )
    inline = b"" if data.inline_qos is None else parameters_bytes(data.inline_qos)
    flags = layout.INLINE_FLAG if inline else 0
    if data.payload is not None:
        flags |= layout.KEY_FLAG if data.is_key else layout.PAYLOAD_FLAG
    return layout.DATA, flags, head + inline, data.payload or _NO_PAYLOAD


def _fragment(fragment: DataFragment, order: Order) -> _Parts:
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


def _heartbeat(heartbeat: WriterHeartbeat, order: Order) -> _Parts:
    ends = heartbeat.reader, heartbeat.writer
    first, last = heartbeat.first, heartbeat.last
    span = first >> 32, first & LOW, last >> 32, last & LOW, heartbeat.count
    flags = layout.FINAL_FLAG if heartbeat.is_final else 0
    flags |= layout.ALIVE_FLAG if heartbeat.is_alive else 0
    return layout.HEARTBEAT, flags, layout.HEARTBEAT_BODY[order].pack(*ends, *span), _NO_PAYLOAD


def _nack(nack: AckNack | FragmentNack, order: Order) -> _Parts:
    missing: NumberSet = nack.missing
    tail = bits_bytes(missing.base, missing.numbers, order) + layout.COUNT[order].pack(nack.count)
    ends = nack.reader, nack.writer
    if isinstance(nack, FragmentNack):
        head = layout.NACK_FRAG_HEAD[order].pack(*ends, *halves(nack.number), missing.base)
        return layout.NACK_FRAG, 0, head + tail, _NO_PAYLOAD
    head = layout.ACK_NACK_HEAD[order].pack(*ends, *halves(missing.base))
    return layout.ACK_NACK, layout.FINAL_FLAG if nack.is_final else 0, head + tail, _NO_PAYLOAD


_ENCODERS: dict[type[Any], Callable[[Any, Order], _Parts]] = {
    Data: _data,
    DataFragment: _fragment,
    AckNack: _nack,
    FragmentNack: _nack,
    WriterHeartbeat: _heartbeat,
    Gap: _gap,
    Destination: _destination,
    SourceInfo: _source,
    Timestamp: _timestamp,
}
