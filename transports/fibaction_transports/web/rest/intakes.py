"""The way in which actions take goals, in the REST interface: in lists, and to change it."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import msgspec

from fibaction.border.abc import Endpoint
from fibaction.border.http_access import Refused
from fibaction.feeds.intakes import intakes_of
from fibaction.words.intake import IntakeMode

LARGEST_CHANGE = 10_000
"""Bytes of a change, at most."""


class WantedIntake(msgspec.Struct, forbid_unknown_fields=True):
    """A change that a client sends."""

    mode: IntakeMode
    """`hold` to pause the action, so that new goals wait; `refuse` to pause it and reject them;
    `drain` to reject them, and let all others end; `open` to take goals again."""
    reason: str = ""
    """The reason, for people."""
    worker: str = ""
    """The only worker of a fleet that it is about; empty for all."""


def wanted_in(body: bytes) -> WantedIntake:
    """Return the change in the body of a request.

    Raises:
        Refused: It is not one.
    """
    try:
        return msgspec.json.decode(body, type=WantedIntake)
    except msgspec.MsgspecError as exc:
        raise Refused(422, f"a change has a mode, and may have a reason: {exc}") from None


async def all_described(endpoints: Collection[Endpoint]) -> list[dict[str, Any]]:
    """Return the descriptions of actions, each with `away` while its server is, and with `intake`
    while it takes no goals as usual.
    """
    described = [msgspec.structs.asdict(endpoint.info) for endpoint in endpoints]
    intakes = await intakes_of(endpoints)
    for endpoint, members in zip(endpoints, described, strict=True):
        if endpoint.absence is not None:
            members["away"] = endpoint.absence
        elif (intake := intakes.get(endpoint.info.name)) is not None:
            members["intake"] = {"mode": intake.mode, "text": intake.text}
    return described
