"""The endpoints of other participants, within limits."""

from __future__ import annotations

from fibaction_transports.rtps.discovery.endpoint_data import EndpointData
from fibaction_transports.rtps.limits import RtpsLimits
from fibaction_transports.rtps.messages.ids import Guid


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
