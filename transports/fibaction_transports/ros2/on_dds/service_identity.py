"""The identity of a request: which client has sent it, and its number there.

The middlewares write it in two ways, and each reads its own only. Fast DDS has it in the inline
QoS: a request names the reader of its client's replies, and a reply the same reader and the number
of the request's sample. Cyclone DDS has a header of 16 bytes ahead of the message, in requests and
replies alike, which the server returns as it is. Our own ends write it as Fast DDS does.
"""

from __future__ import annotations

import struct
from typing import Final

from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.messages.ids import OWN_VENDOR, Guid
from fibaction_transports.rtps.messages.layout import ENCAPSULATION
from fibaction_transports.rtps.messages.parameters import (
    FAST_DDS_RELATED_SAMPLE_IDENTITY,
    RELATED_SAMPLE_IDENTITY,
    SampleIdentity,
    identity_value,
)

UNKNOWN_NUMBER: Final = -(2**32)
"""The number in the identity of a request of Fast DDS: that of the sample itself counts."""
CLIENT_SIZE: Final = 8
"""Bytes of the ID of a client in a header."""
_HEADER = struct.Struct("<8sq")


def identity_items(identity: SampleIdentity) -> list[tuple[int, bytes]]:
    """Return an identity as inline QoS."""
    value = identity_value(identity)
    return [(FAST_DDS_RELATED_SAMPLE_IDENTITY, value), (RELATED_SAMPLE_IDENTITY, value)]


def identity_in(sample: Sample) -> SampleIdentity | None:
    """Return the identity in the inline QoS of a sample; None if there is none."""
    if sample.inline_qos is None:
        return None
    related = sample.inline_qos.identity(RELATED_SAMPLE_IDENTITY)
    if related is None:
        related = sample.inline_qos.identity(FAST_DDS_RELATED_SAMPLE_IDENTITY)
    return related


def header_of(client: bytes, number: int) -> bytes:
    """Return the header of a request; `client` has 8 bytes."""
    return _HEADER.pack(client, number)


def number_in(header: bytes) -> tuple[bytes, int]:
    """Return the client and the number in a header."""
    client, number = _HEADER.unpack(header)
    return client, number


def with_header(header: bytes, payload: bytes) -> bytes:
    """Return a payload with a header ahead of its message."""
    return payload[:ENCAPSULATION] + header + payload[ENCAPSULATION:]


def split_header(payload: bytes) -> tuple[bytes, bytes] | None:
    """Return the header of a payload, and the payload without it; None if it is too short."""
    end = ENCAPSULATION + _HEADER.size
    if len(payload) < end:
        return None
    return payload[ENCAPSULATION:end], payload[:ENCAPSULATION] + payload[end:]


def client_of(reader: Guid) -> bytes:
    """Return the ID of a client in headers, made of the GUID of its reader of replies.

    A server sends replies to all clients, so each needs an ID of its own: the first random bytes of
    the participant's GUID, and the number of the reader in it.
    """
    random, number = reader.prefix[len(OWN_VENDOR) :], reader.entity[:-1]
    return random[: CLIENT_SIZE - 2] + number[-2:]
