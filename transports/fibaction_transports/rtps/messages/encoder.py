"""Submessages as bytes. Each is a multiple of four bytes long if its payload is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

from fibaction_transports.rtps.messages import kinds
from fibaction_transports.rtps.messages.ids import PREFIX_SIZE
from fibaction_transports.rtps.messages.layout import LITTLE, LOW, U32, Order, halves, time_halves
from fibaction_transports.rtps.messages.locators import Locator, locator_bytes
from fibaction_transports.rtps.messages.number_sets import bits_bytes
from fibaction_transports.rtps.messages.parameters import parameters_bytes
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    Destination,
    FragmentHeartbeat,
    FragmentNack,
    Gap,
    NumberSet,
    ReplyLocators,
    SourceInfo,
    Submessage,
    Timestamp,
    WriterHeartbeat,
)

_Parts: TypeAlias = tuple[int, int, bytes]
"""The kind, the flags and the body of a submessage."""

_MAX_BODY = 2**16 - 1
_DESTINATION_HEAD = kinds.SUBMESSAGE_HEAD[LITTLE].pack(
    kinds.INFO_DST, kinds.LITTLE_FLAG, PREFIX_SIZE
)


def packet_head(vendor: bytes, prefix: bytes) -> bytes:
    """Return the head of a packet, after which its submessages follow."""
    return kinds.MAGIC + kinds.VERSION + vendor + prefix


def submessage_bytes(submessage: Submessage, order: Order = LITTLE) -> bytes:
    """Return a submessage as on the wire; inline QoS must have the same byte order.

    Raises:
        ValueError: It is longer than 65,535 bytes.
    """
    kind, flags, body = _ENCODERS[type(submessage)](submessage, order)
    if len(body) > _MAX_BODY:
        raise ValueError(f"submessage of {len(body)} bytes exceeds {_MAX_BODY} bytes")
    flags |= kinds.LITTLE_FLAG if order == LITTLE else 0
    return kinds.SUBMESSAGE_HEAD[order].pack(kind, flags, len(body)) + body


def destination_bytes(prefix: bytes) -> bytes:
    """Return the submessage that says for which participant the following ones are."""
    return _DESTINATION_HEAD + prefix


def _gap(gap: Gap, order: Order) -> _Parts:
    numbers = (*halves(gap.start), *halves(gap.rest.base))
    head = kinds.GAP_HEAD[order].pack(gap.reader, gap.writer, *numbers)
    return kinds.GAP, 0, head + bits_bytes(gap.rest.base, gap.rest.numbers, order)


def _destination(destination: Destination, _: Order) -> _Parts:
    return kinds.INFO_DST, 0, destination.prefix


def _source(source: SourceInfo, order: Order) -> _Parts:
    body = kinds.SOURCE_BODY[order].pack(kinds.VERSION, source.vendor, source.prefix)
    return kinds.INFO_SRC, 0, body


def _timestamp(timestamp: Timestamp, order: Order) -> _Parts:
    if timestamp.time is None:
        return kinds.INFO_TS, kinds.INVALID_FLAG, b""
    return kinds.INFO_TS, 0, kinds.TIME_BODY[order].pack(*time_halves(timestamp.time))


def _data(data: Data, order: Order) -> _Parts:
    distance, number = kinds.DATA_HEAD.size - kinds.TO_INLINE, data.number
    head = kinds.DATA_HEAD[order].pack(
        0, distance, data.reader, data.writer, number >> 32, number & LOW
    )
    inline = b"" if data.inline_qos is None else parameters_bytes(data.inline_qos)
    flags = kinds.INLINE_FLAG if inline else 0
    if data.payload is not None:
        flags |= kinds.KEY_FLAG if data.is_key else kinds.PAYLOAD_FLAG
    return kinds.DATA, flags, b"".join((head, inline, data.payload or b""))


def _fragment(fragment: DataFragment, order: Order) -> _Parts:
    head = kinds.FRAGMENT_HEAD[order].pack(
        0,
        kinds.FRAGMENT_HEAD.size - kinds.TO_INLINE,
        fragment.reader,
        fragment.writer,
        *halves(fragment.number),
        fragment.first,
        fragment.count,
        fragment.fragment_size,
        fragment.sample_size,
    )
    inline = b"" if fragment.inline_qos is None else parameters_bytes(fragment.inline_qos)
    flags = kinds.INLINE_FLAG if inline else 0
    flags |= kinds.FRAGMENT_KEY_FLAG if fragment.is_key else 0
    return kinds.DATA_FRAG, flags, b"".join((head, inline, fragment.payload))


def _heartbeat(heartbeat: WriterHeartbeat | FragmentHeartbeat, order: Order) -> _Parts:
    ends = heartbeat.reader, heartbeat.writer
    if isinstance(heartbeat, FragmentHeartbeat):
        numbers = (*halves(heartbeat.number), heartbeat.last, heartbeat.count)
        return kinds.HEARTBEAT_FRAG, 0, kinds.HEARTBEAT_FRAG_BODY[order].pack(*ends, *numbers)
    first, last = heartbeat.first, heartbeat.last
    span = first >> 32, first & LOW, last >> 32, last & LOW, heartbeat.count
    flags = kinds.FINAL_FLAG if heartbeat.is_final else 0
    flags |= kinds.ALIVE_FLAG if heartbeat.is_alive else 0
    return kinds.HEARTBEAT, flags, kinds.HEARTBEAT_BODY[order].pack(*ends, *span)


def _nack(nack: AckNack | FragmentNack, order: Order) -> _Parts:
    missing: NumberSet = nack.missing
    tail = bits_bytes(missing.base, missing.numbers, order) + kinds.COUNT[order].pack(nack.count)
    ends = nack.reader, nack.writer
    if isinstance(nack, FragmentNack):
        head = kinds.NACK_FRAG_HEAD[order].pack(*ends, *halves(nack.number), missing.base)
        return kinds.NACK_FRAG, 0, head + tail
    head = kinds.ACK_NACK_HEAD[order].pack(*ends, *halves(missing.base))
    return kinds.ACK_NACK, kinds.FINAL_FLAG if nack.is_final else 0, head + tail


def _reply(reply: ReplyLocators, order: Order) -> _Parts:
    body = _locators(reply.unicast, order)
    if not reply.multicast:
        return kinds.INFO_REPLY, 0, body
    return kinds.INFO_REPLY, kinds.MULTICAST_FLAG, body + _locators(reply.multicast, order)


def _locators(locators: tuple[Locator, ...], order: Order) -> bytes:
    return U32[order].pack(len(locators)) + b"".join(
        locator_bytes(locator, order) for locator in locators
    )


_ENCODERS: dict[type[Any], Callable[[Any, Order], _Parts]] = {
    Data: _data,
    DataFragment: _fragment,
    AckNack: _nack,
    FragmentNack: _nack,
    WriterHeartbeat: _heartbeat,
    FragmentHeartbeat: _heartbeat,
    Gap: _gap,
    Destination: _destination,
    SourceInfo: _source,
    Timestamp: _timestamp,
    ReplyLocators: _reply,
}
