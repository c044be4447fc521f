"""The diagnosis of a domain: what a node hears in some seconds, and why it may hear nothing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import anyio
from msgspec import Struct

from fibaction.border.abc import Diagnosis
from fibaction.words.errors import TransportError
from fibaction_transports.ros2.client.diagnosis import (
    NO_ACTION,
    action_problems,
    served_actions,
)
from fibaction_transports.ros2.names import action_names
from fibaction_transports.ros2.node.middlewares import Middlewares
from fibaction_transports.ros2.node.parts import FEEDBACK
from fibaction_transports.ros2.on_dds.node import DdsAdapter, DdsNode
from fibaction_transports.ros2.on_dds.topics import topic_name
from fibaction_transports.ros2.settings import RosSettings
from fibaction_transports.ros2.without_ros.messages.message_type import read_hashes, ros_type
from fibaction_transports.rtps.messages.ids import CYCLONE_DDS, FAST_DDS, OWN_VENDOR
from fibaction_transports.rtps.ports import (
    GROUPS,
    LOCALHOST,
    LOCALHOSTS,
    DiscoveryRange,
    DomainSettings,
    data_port,
    discovery_port,
    multicast_port,
)

_MESSAGE = "_FeedbackMessage"
_VENDORS = {FAST_DDS: "Fast DDS", CYCLONE_DDS: "Cyclone DDS", OWN_VENDOR: "fibaction"}


class DomainView(Struct, frozen=True, kw_only=True):
    """The participants, nodes and actions that a node has heard, and its own addresses."""

    settings: DomainSettings
    interfaces: tuple[str, ...]
    peers: list[dict[str, Any]]
    participants: list[dict[str, Any]]
    nodes: list[str]
    actions: list[dict[str, Any]]
    datagrams: dict[str, int]
    is_only_here: bool
    """True if all participants are on this machine."""
    ports: tuple[int, int]


async def diagnose_domain(
    adapter: DdsAdapter, ends: RosSettings, there: Middlewares, seconds: float, action: str = ""
) -> Diagnosis:
    """Listen in a domain for some seconds; then say what was heard, and what may be wrong.

    Raises:
        TransportError: The sockets cannot be opened, or a static peer is unknown.
    """
    settings, origins = adapter.domain(), adapter.origins()
    async with adapter.open() as node:
        await anyio.sleep(seconds)
        view = _view(node, settings, origins)
        own = node.network.addresses
        problems = list(_problems(node, ends, action)) if action else []
    facts = {
        **there.facts(),
        "domain": {"number": settings.domain, "from": origins["domain"]},
        "discovery": {"range": settings.discovery_range.value, "from": origins["range"]},
        "static_peers": view.peers,
        "own_addresses": list(own.hosts),
        "own_ports": {
            "participant": own.number,
            "discovery": view.ports[0],
            "samples": view.ports[1],
        },
        "multicast": {
            "group": ", ".join(_groups(settings)),
            "joined_at": list(own.interfaces),
        },
        "participants": view.participants,
        "nodes": view.nodes,
        "actions": view.actions,
        "datagrams": view.datagrams,
        **({"problems": problems} if action else {}),
    }
    is_found = not problems if action else bool(view.participants)
    elsewhere = there.advice(at_zenoh=False)
    return Diagnosis(is_found, facts, (*advice(view, problems), *elsewhere, *adapter.left_out()))


def _groups(settings: DomainSettings) -> Iterator[str]:
    """Yield the groups of multicast with their port."""
    port = multicast_port(settings.domain)
    for version in settings.ip_versions:
        for group in GROUPS[version]:
            yield f"[{group}]:{port}" if version == 6 else f"{group}:{port}"


# What was heard


def _view(node: DdsNode, settings: DomainSettings, origins: dict[str, str]) -> DomainView:
    own, participant = node.network.addresses, node.network.participant
    remotes = participant.remote_participants
    endpoints = [end.guid.prefix for end in participant.remote_endpoints]
    here = {*own.hosts, *LOCALHOSTS.values()}
    sources = {remote.source for remote in remotes}
    return DomainView(
        settings=settings,
        interfaces=own.interfaces,
        peers=[
            {
                "host": host,
                "address": address,
                "from": origins["peers"],
                "heard": address in sources,
            }
            for host, address in zip(settings.static_peers, own.peers, strict=False)
        ],
        participants=[
            {
                "host": remote.source,
                "vendor": _VENDORS.get(remote.data.vendor, remote.data.vendor.hex()),
                "name": remote.data.name,
                "endpoints": endpoints.count(remote.data.prefix),
            }
            for remote in remotes
        ],
        nodes=sorted(
            name for remote in remotes for name in node.graph.nodes_of(remote.data.prefix)
        ),
        actions=served_actions(node),
        datagrams=_datagrams(node),
        is_only_here=sources <= here,
        ports=(discovery_port(settings.domain, own.number), data_port(settings.domain, own.number)),
    )


def _datagrams(node: DdsNode) -> dict[str, int]:
    counters = node.network.participant.counters
    return {
        "received": counters.datagrams - counters.own,
        "own": counters.own,
        "invalid": counters.invalid,
        "of_other_domains": counters.of_other_domains,
        "over_limit": counters.over_limit,
        "forged": counters.forged,
        "withheld": counters.withheld,
        "unsent": counters.unsent,
    }


# What is wrong


def _problems(node: DdsNode, ends: RosSettings, action: str) -> Iterator[str]:
    """Yield a sentence for each reason why an action cannot be used."""
    yield from action_problems(node, ends, action)
    full = action_names(node.resolve, action).feedback.removesuffix(FEEDBACK)
    yield from _type_problems(node, full)


def _type_problems(node: DdsNode, full: str) -> Iterator[str]:
    writers = [
        end
        for end in node.network.participant.remote_endpoints_on(topic_name(full + FEEDBACK))
        if end.guid.is_writer
    ]
    types = sorted({ros_type(end.type_name).removesuffix(_MESSAGE) for end in writers})
    if len(types) > 1:
        yield f"{full} has servers of several types: {', '.join(types)}"
    for type_name in types:
        try:
            found = node.types.find(type_name, full)
        except TransportError as exc:
            yield str(exc)
            continue
        ours: str = found.impl.FeedbackMessage.type_hash
        theirs = {read_hashes(end.user_data).of_type for end in writers} - {""}
        if len(types) == 1 and theirs - {ours}:
            yield (
                f"the feedback of {type_name} has other fields at the server than in the interface"
                " files here: copy the files of the server"
            )


def advice(view: DomainView, problems: list[str]) -> Iterator[str]:
    """Yield what to do, by what was heard; last the problems of the action, if it is named."""
    if not view.participants:
        yield _why_nothing(view)
    elif not view.nodes:
        first, last = view.ports
        yield (
            "participants were heard, and none of their nodes: a firewall may block the UDP ports"
            f" {first} and {last} here, or they are not of ROS, or more seconds are needed"
        )
    else:
        if view.is_only_here:
            yield _beyond(view, "only programs of this machine were heard")
        if not (view.actions or problems):
            yield NO_ACTION
    for peer in view.peers:
        if view.participants and not peer["heard"]:
            yield f"nothing was heard from the static peer {peer['host']}: does it let UDP in?"
    yield from problems


def _why_nothing(view: DomainView) -> str:
    reach = view.settings.discovery_range
    if reach is DiscoveryRange.OFF:
        return "discovery is OFF, so nothing is looked for: use discovery=SUBNET"
    if view.datagrams["of_other_domains"]:
        return (
            f"what was heard is in another domain than {view.settings.domain}, or has a domain tag:"
            " set the same ROS_DOMAIN_ID at both ends"
        )
    if view.datagrams["received"]:
        return "datagrams have arrived, and none of them announced a participant of DDS"
    if reach is DiscoveryRange.SUBNET and not view.datagrams["own"]:
        return (
            "no datagram has arrived, not even those that were sent to multicast here: this machine"
            " blocks multicast; allow it in the firewall, or name the robot with peers=HOST"
        )
    return _beyond(view, "no datagram of another participant has arrived")


def _beyond(view: DomainView, what: str) -> str:
    """Return what to do to hear other machines."""
    if view.settings.discovery_range is DiscoveryRange.LOCALHOST and not view.peers:
        return f"{what}, and other machines are not looked for: use discovery=SUBNET to hear them"
    if view.interfaces == (LOCALHOST,):
        return f"{what}: multicast has only the loopback interface here; is there a network?"
    return (
        f"{what}: multicast may be blocked, so name the robot with peers=HOST or ROS_STATIC_PEERS;"
        f" is ROS_DOMAIN_ID {view.settings.domain} there, too?"
    )
