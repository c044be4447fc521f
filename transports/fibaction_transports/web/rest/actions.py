"""The way in which actions take goals, in the REST interface: in lists, and to change it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection
from typing import Any

import msgspec

from fibaction.border.abc import Endpoint
from fibaction.border.http_access import Refused
from fibaction.feeds.intakes import intakes_of
from fibaction.words.intake import NO_LEVERS, IntakeMode

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


async def all_described(
    endpoints: Collection[Endpoint], may_observe: Callable[[str], Awaitable[bool]]
) -> list[dict[str, Any]]:
    """Return the descriptions of actions, each with `away` while its server is, with `intake` while
    it takes no goals as usual, with `no_levers` if that cannot be changed, and with the `schedule`
    of its server. A client that may not observe an action learns neither who has paused it nor the
    schedule.
    """
    described = [msgspec.structs.asdict(endpoint.info) for endpoint in endpoints]
    intakes = await intakes_of(endpoints)
    for endpoint, members in zip(endpoints, described, strict=True):
        name = endpoint.info.name
        if endpoint.absence is not None:
            members["away"] = endpoint.absence
        elif (intake := intakes.get(name)) is not None:
            observes = await may_observe(name)
            if not intake.has_levers:
                members["no_levers"] = NO_LEVERS
            if intake.mode is not IntakeMode.OPEN:
                text = intake.text if observes else intake.text_for_all
                members["intake"] = {"mode": intake.mode, "text": text}
            if observes and (schedule := intake.schedule) is not None:
                members["schedule"] = {"text": schedule.text, **msgspec.to_builtins(schedule)}
    return described
