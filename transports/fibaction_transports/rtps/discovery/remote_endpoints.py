"""The endpoints of other participants: their announcements (SEDP), and a table within limits."""

from __future__ import annotations

from msgspec import Struct

from fibaction_transports.rtps.discovery.type_lookup import read_type_id
from fibaction_transports.rtps.limits import RtpsLimits
from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.ids import PARTICIPANT, Guid
from fibaction_transports.rtps.messages.layout import InvalidPacket
from fibaction_transports.rtps.messages.locators import Locator
from fibaction_transports.rtps.messages.parameters import Parameters, list_payload
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


class RemoteEndpoints:
    """A table of the endpoints that other participants have announced."""

    def __init__(self, limits: RtpsLimits) -> None:
        self._limits = limits
        self._of: dict[bytes, dict[Guid, EndpointData]] = {}
        self._topics: dict[str, dict[Guid, EndpointData]] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def get(self, guid: Guid) -> EndpointData | None:
        """Return an endpoint; None if it is not known."""
        return self._of.get(guid.prefix, {}).get(guid)

    def all(self) -> list[EndpointData]:
        """Return all endpoints."""
        return [data for of_one in self._of.values() for data in of_one.values()]

    def on_topic(self, topic: str) -> list[EndpointData]:
        """Return the endpoints of a topic."""
        return list(self._topics.get(topic, {}).values())

    def add(self, data: EndpointData) -> bool:
        """Add an endpoint that is not known; return False if there are too many."""
        of_one = self._of.get(data.guid.prefix, {})
        limits = self._limits
        if self._count >= limits.endpoints or len(of_one) >= limits.endpoints_of_one:
            return False
        self._of.setdefault(data.guid.prefix, of_one)[data.guid] = data
        self._topics.setdefault(data.topic, {})[data.guid] = data
        self._count += 1
        return True

    def remove(self, guid: Guid) -> EndpointData | None:
        """Remove an endpoint, and return it; None if it is not known."""
        of_one = self._of.get(guid.prefix, {})
        data = of_one.pop(guid, None)
        if data is None:
            return None
        if not of_one:
            del self._of[guid.prefix]
        of_topic = self._topics[data.topic]
        del of_topic[guid]
        if not of_topic:
            del self._topics[data.topic]
        self._count -= 1
        return data

    def of_participant(self, prefix: bytes) -> list[Guid]:
        """Return the endpoints of a participant."""
        return list(self._of.get(prefix, ()))
