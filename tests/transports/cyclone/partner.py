"""Processes with Cyclone DDS, and when tests with them are left out.

`cyclonedds` is in the dependency group `test` where there is a wheel of it.
"""

from __future__ import annotations

import os
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from importlib.util import find_spec

import pytest

from tests.ros2.stock.process import Peer, peer
from tests.ros2.stock.waiting import eventually

IS_LEFT_OUT = find_spec("cyclonedds") is None and os.environ.get("FIBACTION_CYCLONE") != "required"
"""True if tests with Cyclone DDS are skipped; the check of the project requires them."""
needs_cyclone = pytest.mark.skipif(IS_LEFT_OUT, reason="cyclonedds is not installed")

LAST_PARTICIPANT = 31
"""The greatest number of a participant that others without multicast look for."""
CONFIG = f"""
<CycloneDDS><Domain Id="any">
  <General>
    <Interfaces><NetworkInterface name="lo"/></Interfaces>
    <AllowMulticast>false</AllowMulticast>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex>
    <MaxAutoParticipantIndex>{LAST_PARTICIPANT}</MaxAutoParticipantIndex>
    <LeaseDuration>{{lease}}</LeaseDuration>
    <Peers><Peer Address="127.0.0.1"/></Peers>
  </Discovery>
</Domain></CycloneDDS>
"""
"""Settings of Cyclone DDS: this machine only, found at the ports of the first participants."""


OF_FAST_DDS = "with invalid type object"
"""The end of Cyclone's complaints, now and then, of what Fast DDS answers when it is asked for a
type. Participants of fibaction send no descriptions of types."""


@asynccontextmanager
async def partner(module: str, *arguments: str, lease: str = "10 s") -> AsyncGenerator[Peer, None]:
    """Run a module of this package in a process of its own.

    It must not complain, as Cyclone does of each packet that breaks its rules.
    """
    config = CONFIG.format(lease=lease)
    name = f"{__package__}.{module}"
    # Without a preloaded Cyclone DDS of another version, as tests of ROS 2 may run with.
    async with peer(name, *arguments, CYCLONEDDS_URI=config, LD_PRELOAD="") as found:
        yield found
        complaints = found.complaints().splitlines()
        rest = [line for line in complaints if not line.endswith(OF_FAST_DDS)]
        assert not rest, "\n".join(rest)


async def matched(cyclone: Peer, count: int = 1, *names: str) -> None:
    """Wait until readers or writers of a process have so many partners."""
    for name in names or ("",):

        async def look(name: str = name) -> int:
            return int(await cyclone.ask("matches", name=name))

        await eventually(look, lambda found: found == count)
