"""The explanation why a server that is in the graph cannot be used: its types are other versions.

Two ends with another definition of a type match in DDS, and read each other's bytes wrongly. The
hashes that endpoints announce tell the versions apart.
"""

from __future__ import annotations

from typing import Any

from fibaction_transports.ros2.names import ActionNames
from fibaction_transports.ros2.node.ros_node import RosNode

_SHOWN = len("RIHS01_") + 8
"""Characters of a hash that are shown."""


def explain_versions(ros: RosNode, full: ActionNames, impl: Any) -> str:
    """Return a sentence that says which types of a server are other versions than here, and what to
    do; empty if there is none, or if hashes are not known. One server with the right versions is
    enough.
    """
    wrong: list[str] = []
    for message_type, ends in (
        (impl.SendGoalService.Request, ros.request_readers(full.send_goal)),
        (impl.GetResultService.Response, ros.answer_writers(full.get_result)),
        (impl.FeedbackMessage, ros.publishers(full.feedback)),
    ):
        ours = ros.types.version(message_type)
        theirs = {end.type_hash for end in ends}
        if ours is not None and theirs and theirs.isdisjoint({ours.type_hash, ""}):
            there = ", ".join(_short(one) for one in sorted(theirs))
            wrong.append(f"{ours.type_name} is {there} there, and {_short(ours.type_hash)} here")
    if not wrong:
        return ""
    return (
        f"its server has another version of the types: {'; '.join(wrong)}; use the interface files"
        " with which the server was built, at both ends"
    )


def _short(type_hash: str) -> str:
    return f"{type_hash[:_SHOWN]}.."
