"""A drone for tests in a browser: its goals have times, and fields that a person names."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from datetime import date, datetime
from typing import Annotated, Any

import anyio
import msgspec

from fibaction import Action, GoalHandle


class Fix(msgspec.Struct):
    """A place on the earth."""

    latitude: float = 48.137
    longitude: float = 11.575


class Area(msgspec.Struct):
    """An area around the start, with a name."""

    radius: Annotated[float, msgspec.Meta(extra_json_schema={"x-unit": "m"})] = 10.0


class Flight(msgspec.Struct):
    """A way to fly, and when."""

    start: Annotated[datetime, msgspec.Meta(tz=True)]
    day: date
    route: list[Fix] = msgspec.field(default_factory=lambda: [Fix(), Fix(48.139, 11.58)])
    labels: dict[str, str] = {}
    areas: dict[str, Area] = msgspec.field(default_factory=lambda: {"near": Area()})


FLY = Action("fly", goal=Flight, feedback=Fix, result=str)


async def fly(goal: GoalHandle[Flight]) -> AsyncGenerator[Any, None]:
    """Fly to each place of the route, then tell what the goal is."""
    for place in goal.request.route:
        for share in range(1, 6):
            yield Fix(place.latitude - 0.0003 / share, place.longitude + 0.0004 / share)
            await anyio.sleep(0.01)
    yield repr(goal.request)
