"""A scout: a participant that looks at the graph next to a node of another middleware.

rclpy tells what it knows of the graph, and not what it knows to be missing: Fast DDS takes one or
two seconds to find ten nodes, with pauses longer than one. Our RTPS knows of each participant
whether all of its endpoints have come, and mostly has them after 0.2 s. A scout has no node, so
others see nothing of it in the graph.
"""

from __future__ import annotations

import os
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

from fibaction.words.errors import TransportError
from fibaction_transports.ros2.on_dds.graph import DdsGraph, NodeName
from fibaction_transports.rtps.events import Event, ParticipantLost, SampleReceived
from fibaction_transports.rtps.network import open_network
from fibaction_transports.rtps.ports import DomainSettings

_NO_NODE = NodeName("", "/")


@asynccontextmanager
async def open_scout(domain: int) -> AsyncGenerator[DdsGraph, None]:
    """Look at the graph of a domain, with the other settings of ROS in the environment.

    Raises:
        TransportError: The sockets cannot be opened, or a variable of the environment has a value
            that ROS does not know.
    """
    found: list[DdsGraph] = []

    def handle(event: Event) -> None:
        for graph in found:
            if isinstance(event, ParticipantLost):
                graph.forget(event.prefix)
            elif isinstance(event, SampleReceived):
                graph.receive(event.sample)

    try:
        settings = DomainSettings.from_environment({**os.environ, "ROS_DOMAIN_ID": str(domain)})
    except ValueError as exc:
        raise TransportError(str(exc)) from exc
    async with open_network(settings, handle) as network:
        found.append(DdsGraph(network, _NO_NODE))
        yield found[0]
