"""The diagnosis of a graph of ROS: the actions in it, and why one of them cannot be used."""

from __future__ import annotations

from collections.abc import Iterator
from difflib import get_close_matches
from typing import Any

import anyio

from fibaction.border.abc import Diagnosis
from fibaction_transports.ros2.client.mismatches import explain_mismatch, explain_versions
from fibaction_transports.ros2.names import action_names
from fibaction_transports.ros2.node.graph_view import FEEDBACK
from fibaction_transports.ros2.node.middlewares import Middlewares
from fibaction_transports.ros2.node.ros_node import RosAdapter, RosNode
from fibaction_transports.ros2.settings import RosSettings

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
