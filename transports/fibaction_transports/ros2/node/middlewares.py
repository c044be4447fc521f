"""The middleware that nodes of ROS use here: what the environment says, and who listens."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

import anyio

from fibaction.border.peer_text import excerpt

RMW: Final = "RMW_IMPLEMENTATION"
"""The variable by which ROS chooses its middleware."""
RMW_ZENOH: Final = "rmw_zenoh_cpp"
ROUTER_PORT: Final = 7447
"""The port of a router of Zenoh."""
LOOKED_AT = ROUTER_PORT
"""The port at which a router is looked for; tests have another one."""
LOCALHOST: Final = "localhost"
PATIENCE: Final = 1.0
"""Seconds that a host has to answer."""


def is_zenoh_named(environ: Mapping[str, str]) -> bool:
    """Return whether the environment says that nodes of ROS use Zenoh."""
    return environ.get(RMW) == RMW_ZENOH


class Middlewares(NamedTuple):
    """The signs of middlewares here."""

    named: str
    """The middleware that the environment names; empty if none."""
    routers: Sequence[str]
    """The hosts at which a router of Zenoh listens."""

    def facts(self) -> dict[str, Any]:
        """Return them as facts of a diagnosis."""
        routers = [f"{host}:{LOOKED_AT}" for host in self.routers]
        return {"rmw_implementation": self.named or "not set", "zenoh_routers": routers}

    def advice(self, *, at_zenoh: bool) -> Iterator[str]:
        """Yield why nodes may be at another middleware than that of a transport."""
        if at_zenoh:
            if self.named not in ("", RMW_ZENOH):
                yield f"{RMW} is {excerpt(self.named)}, whose nodes are not in Zenoh: use dds://"
            return
        if self.named == RMW_ZENOH:
            yield f"{RMW} is {RMW_ZENOH}, whose nodes are not in DDS: use zenoh://"
        for host in self.routers:
            url = "zenoh://" if host == LOCALHOST else f"zenoh://{host}"
            yield (
                f"a router of Zenoh listens at {host}:{LOOKED_AT}, so nodes on {RMW_ZENOH} may be"
                f" there, which are not in DDS: use {url}"
            )


async def middlewares_at(hosts: Sequence[str]) -> Middlewares:
    """Look for signs of middlewares, at these hosts and in the environment."""
    found: list[str] = []

    async def look_at(host: str) -> None:
        with anyio.move_on_after(PATIENCE), suppress(OSError):
            async with await anyio.connect_tcp(host, LOOKED_AT):
                found.append(host)

    async with anyio.create_task_group() as tasks:
        for host in hosts:
            tasks.start_soon(look_at, host)
    return Middlewares(os.environ.get(RMW, ""), [host for host in hosts if host in found])
