"""Payloads of discovery: an encapsulation header and a list of parameters, in either byte order."""

from __future__ import annotations

from fibaction_transports.rtps.endpoints.sample import ENCAPSULATION
from fibaction_transports.rtps.messages.errors import InvalidPacket
from fibaction_transports.rtps.messages.layout import BIG, LITTLE, Order
from fibaction_transports.rtps.messages.parameters import (
    Parameters,
    parameters_bytes,
    read_parameters,
)

_LITTLE_LIST = b"\x00\x03\x00\x00"
_ORDERS: dict[bytes, Order] = {b"\x00\x02": BIG, b"\x00\x03": LITTLE}


def list_payload(parameters: Parameters) -> bytes:
    """Return a little-endian list of parameters as a payload."""
    return _LITTLE_LIST + parameters_bytes(parameters)


def read_list(payload: bytes | memoryview) -> Parameters:
    """Read a payload that is a list of parameters.

    Raises:
        InvalidPacket: It is something else, or the list is broken.
    """
    order = _ORDERS.get(bytes(payload[:2]))
    if order is None:
        raise InvalidPacket(f"encapsulation {bytes(payload[:2]).hex()} is not a list of parameters")
    return read_parameters(payload, order, ENCAPSULATION)[0]
