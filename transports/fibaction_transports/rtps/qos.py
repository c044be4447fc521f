"""Quality of service: what endpoints announce, and the reasons why two of them do not match."""

from __future__ import annotations

import math
import struct
from enum import IntEnum

from msgspec import Struct

from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.layout import duration_bytes
from fibaction_transports.rtps.messages.parameters import Parameters

_XCDR1 = 0
_BLOCKING = 0.1
"""The time that a writer may wait for room, as DDS announces it by default, in seconds."""
_REPRESENTATION = struct.pack("<Ihxx", 1, _XCDR1)
_ROUNDING = 1e-6
"""The most by which a duration differs, in seconds, after it was written and read again."""
_SHARED = 0
_ENTIRE_TOPIC = [""]


class Reliability(IntEnum):
    """The policy for lost samples. The greater value serves the smaller."""

    BEST_EFFORT = 1
    RELIABLE = 2


class Durability(IntEnum):
    """The samples that a late reader gets. The greater value serves the smaller."""

    VOLATILE = 0
    TRANSIENT_LOCAL = 1
    TRANSIENT = 2
    PERSISTENT = 3


class Liveliness(IntEnum):
    """The way in which a writer shows that it is alive. The greater value serves the smaller."""

    AUTOMATIC = 0
    BY_PARTICIPANT = 1
    BY_TOPIC = 2


class Qos(Struct, frozen=True, kw_only=True):
    """Quality of service of an endpoint: offered by a writer, requested by a reader."""

    reliability: Reliability = Reliability.RELIABLE
    durability: Durability = Durability.VOLATILE
    depth: int | None = 10
    """Number of newest samples to keep; None keeps all."""
    deadline: float = math.inf
    """Longest time between two samples, in seconds. It is matched, not watched."""
    liveliness: Liveliness = Liveliness.AUTOMATIC
    liveliness_lease: float = math.inf
    """Seconds after which a silent writer is not alive."""
    lifespan: float = math.inf
    """Seconds after which a sample is not sent any more, nor kept for late readers."""
    ownership: int = _SHARED
    destination_order: int = 0
    partitions: tuple[str, ...] = ()
    representations: tuple[int, ...] = (_XCDR1,)
    """The forms of serialized data that are offered or accepted."""

    @property
    def is_reliable(self) -> bool:
        """True if lost samples are sent again."""
        return self.reliability == Reliability.RELIABLE

    @property
    def is_transient_local(self) -> bool:
        """True if a late reader gets the samples that are kept, or asks for them."""
        return self.durability >= Durability.TRANSIENT_LOCAL


def mismatches(offered: Qos, requested: Qos) -> list[str]:
    """Return the reasons why a reader does not get the samples of a writer; none if it does."""
    found = [
        f"{name}: the writer offers {_word(offer)}, the reader requests {_word(request)}"
        for name, offer, request in (
            ("reliability", offered.reliability, requested.reliability),
            ("durability", offered.durability, requested.durability),
            ("liveliness", offered.liveliness, requested.liveliness),
            ("destination order", offered.destination_order, requested.destination_order),
        )
        if offer < request
    ]
    found += [
        f"{name}: the writer offers {offer:g} s, the reader requests {request:g} s"
        for name, offer, request in (
            ("deadline", offered.deadline, requested.deadline),
            ("liveliness lease", offered.liveliness_lease, requested.liveliness_lease),
        )
        if offer > request + _ROUNDING
    ]
    if offered.ownership != requested.ownership:
        found.append("ownership: one end is shared, the other exclusive")
    ours, theirs = offered.partitions or _ENTIRE_TOPIC, requested.partitions or _ENTIRE_TOPIC
    if not set(ours) & set(theirs):
        found.append(f"partitions: {', '.join(ours)} and {', '.join(theirs)} have none in common")
    if offered.representations[0] not in requested.representations:
        found.append("data representation: the reader does not accept the form of the writer")
    return found


def _word(value: int) -> str:
    return value.name.lower() if isinstance(value, IntEnum) else str(value)


def qos_items(qos: Qos) -> list[tuple[int, bytes]]:
    """Return the parameters that announce a quality of service; most defaults are left out."""
    items = [
        (pids.RELIABILITY, struct.pack("<I", qos.reliability) + duration_bytes(_BLOCKING)),
        (pids.DURABILITY, struct.pack("<I", qos.durability)),
        (pids.HISTORY, struct.pack("<II", qos.depth is None, qos.depth or 0)),
        (
            pids.LIVELINESS,
            struct.pack("<I", qos.liveliness) + duration_bytes(qos.liveliness_lease),
        ),
        (pids.DEADLINE, duration_bytes(qos.deadline)),
        (pids.DATA_REPRESENTATION, _REPRESENTATION),
    ]
    if qos.lifespan < math.inf:
        items.append((pids.LIFESPAN, duration_bytes(qos.lifespan)))
    return items


def read_qos(parameters: Parameters, *, is_writer: bool) -> Qos:
    """Read what an endpoint announces; the defaults of DDS hold for what it leaves out.

    Raises:
        InvalidPacket: A parameter is too short.
        ValueError: A kind is unknown.
    """
    default = Reliability.RELIABLE if is_writer else Reliability.BEST_EFFORT
    history = parameters.octets(pids.HISTORY, 8)
    is_all, depth = (0, 1) if history is None else struct.unpack(parameters.order + "II", history)
    return Qos(
        reliability=Reliability(parameters.u32(pids.RELIABILITY, default)),
        durability=Durability(parameters.u32(pids.DURABILITY, Durability.VOLATILE)),
        depth=None if is_all else depth,
        deadline=parameters.duration(pids.DEADLINE, math.inf),
        liveliness=Liveliness(parameters.u32(pids.LIVELINESS, Liveliness.AUTOMATIC)),
        liveliness_lease=parameters.duration(pids.LIVELINESS, math.inf, offset=4),
        lifespan=parameters.duration(pids.LIFESPAN, math.inf),
        ownership=parameters.u32(pids.OWNERSHIP, _SHARED),
        destination_order=parameters.u32(pids.DESTINATION_ORDER, 0),
        partitions=tuple(parameters.texts(pids.PARTITION)),
        representations=_representations(parameters),
    )


def _representations(parameters: Parameters) -> tuple[int, ...]:
    value = parameters.octets(pids.DATA_REPRESENTATION, 4)
    if value is None:
        return (_XCDR1,)
    whole = parameters.all(pids.DATA_REPRESENTATION)[0]
    (count,) = struct.unpack(parameters.order + "I", value)
    count = min(count, (len(whole) - 4) // 2)
    return struct.unpack_from(f"{parameters.order}{count}h", whole, 4) or (_XCDR1,)
