"""The diagnosis of a graph of ROS: the actions in it, and why one of them cannot be used.

It may be the quality of service, by the policies of ROS, or other versions of the types. All
policies of DDS are compared in `rtps.qos`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from typing import Any, NamedTuple

import anyio

from fibaction.border.abc import Diagnosis
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.names import ActionNames, action_names
from fibaction_transports.ros2.node.middlewares import Middlewares
from fibaction_transports.ros2.node.parts import FEEDBACK, NO_HASH, EndInfo
from fibaction_transports.ros2.node.ros_node import RosAdapter, RosNode
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


NO_ACTION = "nodes were heard, and none of them serves an action"


async def diagnose_graph(
    adapter: RosAdapter,
    settings: RosSettings,
    there: Middlewares,
    hints: list[str],
    seconds: float,
    action: str = "",
) -> Diagnosis:
    """Listen for some seconds; then say what is in the graph, and what may be wrong.

    `hints` say why nodes may be elsewhere.

    Raises:
        TransportError: As for `RosAdapter.open`.
    """
    async with adapter.open() as ros:
        await anyio.sleep(seconds)
        links = await ros.links()
        nodes = sorted(ros.nodes() - {ros.full_name})
        actions = served_actions(ros)
        problems = list(action_problems(ros, settings, action)) if action else []
        if action and not problems and (problem := _version_problem(ros, action)):
            problems.append(problem)
    if links.trouble:
        hints = [links.trouble, *hints]
    elif not (nodes or hints):
        hints = ["no other node was heard"]
    elif nodes and not (actions or problems):
        hints = [NO_ACTION, *hints]
    facts = {
        **there.facts(),
        **links.facts,
        "nodes": nodes,
        "actions": actions,
        **({"problems": problems} if action else {}),
    }
    return Diagnosis(bool(nodes and not problems), facts, (*problems, *hints))


def served_actions(ros: RosNode) -> list[dict[str, Any]]:
    """Return the actions that are served, each with its type and the nodes of its servers."""
    return [
        {
            "name": topic.removesuffix(FEEDBACK),
            "type": type_name,
            "servers": sorted({end.node for end in ros.publishers(topic) if end.node}),
        }
        for topic, type_name in ros.served_actions()
    ]


def action_problems(ros: RosNode, settings: RosSettings, action: str) -> Iterator[str]:
    """Yield a sentence if an action has no server, and if its quality of service does not match."""
    names = action_names(ros.resolve, action)
    full = names.feedback.removesuffix(FEEDBACK)
    known = [topic.removesuffix(FEEDBACK) for topic, _ in ros.served_actions()]
    if full not in known:
        near = get_close_matches(full, known, 1)
        yield f"the action {full} has no server{f'; did you mean {near[0]}?' if near else ''}"
    if mismatch := explain_mismatch(ros, names, settings):
        yield f"{full}: {mismatch}"


def _version_problem(ros: RosNode, action: str) -> str:
    names = action_names(ros.resolve, action)
    type_name = dict(ros.served_actions())[names.feedback]
    found = ros.types.find_to_follow(type_name, action)
    return explain_versions(ros, names, found.impl)
