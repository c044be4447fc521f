"""The announcement of a participant: the data of SPDP."""

from __future__ import annotations

import struct

from msgspec import Struct

from fibaction_transports.rtps.discovery.payloads import list_payload
from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.errors import InvalidPacket
from fibaction_transports.rtps.messages.ids import OWN_VENDOR, PARTICIPANT
from fibaction_transports.rtps.messages.kinds import VERSION
from fibaction_transports.rtps.messages.layout import duration_bytes
from fibaction_transports.rtps.messages.locators import Locator
from fibaction_transports.rtps.messages.parameters import Parameters

DEFAULT_LEASE = 100.0
"""The lease of a participant that does not tell its own, in seconds."""

PUBLICATIONS_ANNOUNCER = 1 << 2
PUBLICATIONS_DETECTOR = 1 << 3
SUBSCRIPTIONS_ANNOUNCER = 1 << 4
SUBSCRIPTIONS_DETECTOR = 1 << 5
LIVELINESS_ANNOUNCER = 1 << 10
LIVELINESS_DETECTOR = 1 << 11
ASKS_ABOUT_TYPES = 1 << 12 | 1 << 15
"""A writer of questions about types, and a reader of the answers."""
ANSWERS_TYPES = 1 << 13 | 1 << 14
OWN_ENDPOINTS = 0xC3F | ASKS_ABOUT_TYPES
"""The endpoints of discovery that this implementation has."""


class ParticipantData(Struct, frozen=True, kw_only=True):
    """A participant, as it announces itself."""

    prefix: bytes
    vendor: bytes = OWN_VENDOR
    name: str = ""
    user_data: bytes = b""
    lease: float = DEFAULT_LEASE
    """Seconds after which it is gone, if it has not announced itself again."""
    endpoints: int = OWN_ENDPOINTS
    """The endpoints of discovery that it has, a bit for each."""
    domain: int | None = None
    """The domain that it is in; None if it does not tell."""
    domain_tag: str = ""
    discovery_locators: tuple[Locator, ...] = ()
    data_locators: tuple[Locator, ...] = ()


def participant_payload(data: ParticipantData) -> bytes:
    """Return the announcement of a participant."""
    items = [
        (pids.PROTOCOL_VERSION, VERSION),
        (pids.VENDOR_ID, data.vendor),
        (pids.PARTICIPANT_GUID, data.prefix + PARTICIPANT),
        *pids.locator_items(pids.METATRAFFIC_UNICAST_LOCATOR, data.discovery_locators),
        *pids.locator_items(pids.DEFAULT_UNICAST_LOCATOR, data.data_locators),
        (pids.LEASE, duration_bytes(data.lease)),
        (pids.BUILTIN_ENDPOINTS, struct.pack("<I", data.endpoints)),
        (pids.ENTITY_NAME, pids.text_value(data.name)),
        (pids.USER_DATA, pids.blob_value(data.user_data)),
    ]
    if data.domain is not None:
        items.append((pids.DOMAIN_ID, struct.pack("<I", data.domain)))
    return list_payload(Parameters(tuple(items)))


def read_participant(parameters: Parameters, vendor: bytes) -> ParticipantData:
    """Read the announcement of a participant.

    Raises:
        InvalidPacket: It does not tell which participant it is, or a parameter is broken.
    """
    guid = parameters.guid(pids.PARTICIPANT_GUID)
    if guid is None:
        raise InvalidPacket("announcement does not name its participant")
    domain = parameters.octets(pids.DOMAIN_ID, 4)
    return ParticipantData(
        prefix=guid.prefix,
        vendor=vendor,
        name=parameters.text(pids.ENTITY_NAME) or "",
        user_data=parameters.blob(pids.USER_DATA) or b"",
        lease=parameters.duration(pids.LEASE, DEFAULT_LEASE),
        endpoints=parameters.u32(pids.BUILTIN_ENDPOINTS, 0),
        domain=None if domain is None else parameters.u32(pids.DOMAIN_ID, 0),
        domain_tag=parameters.text(pids.DOMAIN_TAG) or "",
        discovery_locators=tuple(parameters.locators(pids.METATRAFFIC_UNICAST_LOCATOR)),
        data_locators=tuple(parameters.locators(pids.DEFAULT_UNICAST_LOCATOR)),
    )
