"""Topics of a node at `dds://` beside Cyclone DDS in another process."""

from __future__ import annotations

import uuid

import anyio
import pytest

from fibaction_transports.ros2 import open_node
from tests.lossy.bad_network import Weather, bad_network
from tests.transports.cyclone.partner import needs_cyclone, partner

pytestmark = [pytest.mark.anyio, needs_cyclone, pytest.mark.timeout(120)]

STRING = "std_msgs/msg/String"
SIZES = [("a", 1), ("b", 8_000_000), *((letter, 3) for letter in "cdefghij" * 20)]
EXPECTED = [[letter, times, 1] for letter, times in SIZES]
LATE = {"depth": len(SIZES), "late": True}


async def test_late_readers_get_all_that_was_kept_over_a_network_that_loses_a_tenth() -> None:
    name, deep = f"t{uuid.uuid4().hex}", len(SIZES)
    there, back = f"{name}/there", f"{name}/back"
    with bad_network(Weather(0.1), seed=1, inwards=True), anyio.fail_after(90):
        async with partner("topics") as cyclone, open_node("dds://ours") as node:
            told = node.publisher(f"/{there}", STRING, qos="transient_local", depth=deep)
            for letter, times in SIZES:
                await told.publish({"data": letter * times})
            await cyclone.ask("read", topic=f"rt/{there}", name="in", **LATE)
            assert await cyclone.ask("heard", count=deep, name="in") == EXPECTED

            await cyclone.ask("write", topic=f"rt/{back}", name="out", **LATE)
            await cyclone.ask("send", texts=SIZES, name="out")
            heard = node.subscribe(f"/{back}", STRING, qos="transient_local", depth=deep)
            found = [(await heard.next()).data for _ in SIZES]
            assert found == [letter * times for letter, times in SIZES]
