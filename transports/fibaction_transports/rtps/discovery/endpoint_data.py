"""The announcement of an endpoint: the data of SEDP."""

from __future__ import annotations

from msgspec import Struct

from fibaction_transports.rtps.discovery.payloads import list_payload
from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.errors import InvalidPacket
from fibaction_transports.rtps.messages.ids import PARTICIPANT, Guid
from fibaction_transports.rtps.messages.locators import Locator
from fibaction_transports.rtps.messages.parameters import Parameters
from fibaction_transports.rtps.messages.type_questions import read_type_id
from fibaction_transports.rtps.qos import Qos, qos_items, read_qos


class EndpointData(Struct, frozen=True, kw_only=True):
    """An endpoint, as its participant announces it."""

    guid: Guid
    topic: str
    type_name: str
    qos: Qos
    user_data: bytes = b""
    type_id: bytes = b""
    """The ID of its type in XTypes, if it announces one."""
    locators: tuple[Locator, ...] = ()
    """Addresses of the endpoint itself; if there are none, those of its participant hold."""


def endpoint_payload(data: EndpointData) -> bytes:
    """Return the announcement of an endpoint."""
    items = [
        (pids.ENDPOINT_GUID, data.guid),
        (pids.PARTICIPANT_GUID, data.guid.prefix + PARTICIPANT),
        (pids.TOPIC_NAME, pids.text_value(data.topic)),
        (pids.TYPE_NAME, pids.text_value(data.type_name)),
        (pids.KEY_HASH, data.guid),
        *qos_items(data.qos),
        *pids.locator_items(pids.UNICAST_LOCATOR, data.locators),
    ]
    if data.user_data:
        items.append((pids.USER_DATA, pids.blob_value(data.user_data)))
    return list_payload(Parameters(tuple(items)))


def read_endpoint(parameters: Parameters, guid: Guid) -> EndpointData:
    """Read the announcement of the endpoint with this identifier.

    Raises:
        InvalidPacket: It has no topic or type, or a parameter is broken.
    """
    topic, type_name = parameters.text(pids.TOPIC_NAME), parameters.text(pids.TYPE_NAME)
    if not topic or not type_name:
        raise InvalidPacket("announcement of an endpoint has no topic or no type")
    try:
        qos = read_qos(parameters, is_writer=guid.is_writer)
    except ValueError as error:
        raise InvalidPacket(f"quality of service of topic {topic!r}: {error}") from error
    return EndpointData(
        guid=guid,
        topic=topic,
        type_name=type_name,
        qos=qos,
        user_data=parameters.blob(pids.USER_DATA) or b"",
        type_id=read_type_id(parameters),
        locators=tuple(parameters.locators(pids.UNICAST_LOCATOR)),
    )
