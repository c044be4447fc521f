"""The explanations why a server that is in the graph cannot be reached or used: its quality of
service, and other versions of its types.

The former names the policies of ROS. All policies of DDS are compared in `rtps.qos`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.names import ActionNames
from fibaction_transports.ros2.node.parts import NO_HASH, EndInfo
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.settings import RosSettings


class _Way(NamedTuple):
    """One direction of a part of an action, between a server and this client."""

    setting: str
    part: str
    servers: Sequence[EndInfo]
    """The ends of servers."""
    ours: EndQos
    is_to_server: bool = False


def explain_mismatch(ros: RosNode, full: ActionNames, settings: RosSettings) -> str:
    """Return a sentence that says which parts of a server do not match, and what to do; empty if
    there is no server, or if all of it matches.
    """
    if not ros.matches_by_qos:
        return ""
    wrong: dict[str, None] = {}
    advice: dict[str, dict[str, str]] = {}
    for way in _ways(ros, full, settings):
        for server in way.servers:
            pair = (way.ours, server.qos) if way.is_to_server else (server.qos, way.ours)
            for policy in qos.unmet(*pair):
                theirs, ours = qos.word(server.qos, policy), qos.word(way.ours, policy)
                verbs = ("wants", "offers") if way.is_to_server else ("offers", "wants")
                wrong[f"{way.part}: it {verbs[0]} {theirs}, and this client {verbs[1]} {ours}"] = (
                    None
                )
                if qos.has_words(policy):
                    advice.setdefault(way.setting, {})[policy] = theirs
    if not wrong:
        return ""
    words = ", ".join(f"{name}={','.join(of.values())!r}" for name, of in advice.items())
    remedy = f"connect with {words}, or change the server" if words else "change the server"
    return f"there is a server, and its QoS does not match: {'; '.join(wrong)}; {remedy}"


def _ways(ros: RosNode, full: ActionNames, settings: RosSettings) -> Iterator[_Way]:
    feedback = qos.feedback(settings.feedback_depth, settings.feedback_qos)
    status = qos.subscribed_status(settings.status_qos)
    services = qos.services(settings.services_qos)
    yield _Way("feedback_qos", "feedback", ros.publishers(full.feedback), feedback)
    yield _Way("status_qos", "status", ros.publishers(full.status), status)
    for name in (full.send_goal, full.cancel_goal, full.get_result):
        part = f"service {name.rpartition('/')[2]}"
        readers, writers = ros.request_readers(name), ros.answer_writers(name)
        yield _Way("services_qos", part, readers, services, is_to_server=True)
        yield _Way("services_qos", part, writers, services)


_SHOWN = len("RIHS01_") + 8
"""Characters of a hash that are shown."""


def explain_versions(ros: RosNode, full: ActionNames, impl: Any) -> str:
    """Return a sentence that says which types of a server are other versions than here, and what to
    do; empty if there is none, or if hashes are not known. One server with the right versions is
    enough.

    Two ends with another definition of a type match in DDS, and read each other's bytes wrongly; in
    Zenoh they do not hear each other. The hashes that ends announce tell the versions apart.
    """
    wrong: list[str] = []
    goals, results = impl.SendGoalService, impl.GetResultService
    for message_type, service_type, ends in (
        (goals.Request, goals, ros.request_readers(full.send_goal)),
        (results.Response, results, ros.answer_writers(full.get_result)),
        (impl.FeedbackMessage, None, ros.publishers(full.feedback)),
    ):
        ours = ros.types.version(message_type, service_type)
        theirs = {end.type_hash for end in ends}
        if ours is not None and theirs and theirs.isdisjoint({*ours[1:], ""}):
            there = ", ".join(_short(one) for one in sorted(theirs))
            wrong.append(f"{ours.type_name} is {there} there, and {_short(ours.type_hash)} here")
    if not wrong:
        return ""
    if any(end.type_hash == NO_HASH for end in ros.request_readers(full.send_goal)):
        return "its server is of ROS 2 Humble: append ?type_hashes=false to the URL"
    return (
        f"its server has another version of the types: {'; '.join(wrong)}; use the interface files"
        " with which the server was built, at both ends"
    )


def _short(type_hash: str) -> str:
    return f"{type_hash[:_SHOWN]}.."
