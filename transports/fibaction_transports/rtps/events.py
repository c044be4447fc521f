"""The events of a participant: samples, matches, and participants that come and leave."""

from __future__ import annotations

from typing import TypeAlias

from msgspec import Struct

from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.messages.ids import Guid


class SampleReceived(Struct, frozen=True):
    """A reader has received a sample."""

    reader: Guid
    sample: Sample


class SamplesLost(Struct, frozen=True):
    """A writer has samples no longer that its reliable reader has not received."""

    reader: Guid
    writer: Guid
    count: int


class CaughtUp(Struct, frozen=True):
    """A reader has the samples that it was missing, as far as its writers have told."""

    reader: Guid


class EndpointMatched(Struct, frozen=True):
    """An endpoint of this participant and one of another exchange samples from now on."""

    local: Guid
    remote: Guid


class EndpointUnmatched(Struct, frozen=True):
    """An endpoint of this participant and one of another exchange samples no longer."""

    local: Guid
    remote: Guid


class QosMismatch(Struct, frozen=True):
    """Two endpoints of one topic do not match."""

    local: Guid
    remote: Guid
    reasons: tuple[str, ...]
    """A sentence for each policy that differs."""


class LivelinessChanged(Struct, frozen=True):
    """A matched writer has been silent for its lease of liveliness, or is alive again."""

    reader: Guid
    writer: Guid
    is_alive: bool


class TypesAnswered(Struct, frozen=True):
    """A participant has answered a question about its types."""

    prefix: bytes
    number: int
    """The number of the question."""
    types: bytes
    """The types with their IDs, as on the wire; empty if it does not tell them."""


class ParticipantFound(Struct, frozen=True):
    """Another participant is there."""

    prefix: bytes
    vendor: bytes
    name: str
    user_data: bytes


class ParticipantLost(Struct, frozen=True):
    """Another participant has left, or has been silent for its lease."""

    prefix: bytes
    has_left: bool
    """True if it has said so itself."""


Event: TypeAlias = (
    SampleReceived
    | SamplesLost
    | CaughtUp
    | EndpointMatched
    | EndpointUnmatched
    | QosMismatch
    | LivelinessChanged
    | TypesAnswered
    | ParticipantFound
    | ParticipantLost
)
