"""The tools of a bridge: each action as a tool (`ToolAction`), as clients list it, and its
arguments in a call.

The schemas of a tool are made from the JSON Schemas of a goal and of a result. The input of a tool
is always an object. A goal that is one is the input itself; any other goal, for example a number,
is the field `goal` of the input. The output tells about the goal, and has the result as the field
`result`. The arguments come beside the request of the SDK if they came by HTTP.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from mcp.server.context import ServerRequestContext
from mcp_types import CallToolRequestParams, Tool, ToolAnnotations

from fibaction.border.abc import Connection
from fibaction.border.peer_text import excerpt, shortened
from fibaction.types.action import ActionInfo
from fibaction.wire.auth import Peer
from fibaction.words.plain_data import is_list, is_map
from fibaction.words.statuses import GoalStatus
from fibaction_transports._agents.robot_actions import AgentPolicy, RobotAction, RobotActions

SEND, STATUS, CANCEL = "send_goal", "goal_status", "cancel_goal"
"""Names of the tools that a bridge has in addition to one for each action."""
GOAL = "goal"
"""The field of the input that a goal has which is not an object."""
_PREFIX = "#/$defs/"
_CHOICES = ("anyOf", "oneOf", "allOf")
"""Keywords that language models' interfaces do not take at the root of an input schema."""
LONGEST_DESCRIPTION = 1000
"""Characters of a description that a server gives."""

INSTRUCTIONS = """\
These tools send goals to machines: robots, devices, long jobs. A goal may move something, so send \
one only if the user wants it, and never the same one again without a reason.
A tool answers when its goal has ended, or after {patience:g} s with the note that it still runs: \
then call goal_status with its goal_id, or cancel_goal to stop it. An error says why, for example \
why the goal was rejected."""
READ_ONLY = "You can look at the goals of machines here with goal_status, and send none."

_GOAL_ID = {"type": "string", "description": "The goal's ID, 32 hexadecimal digits."}


class ToolAction(RobotAction):
    """One action that is served now, and its tool, whose name is the label."""

    def __init__(self, server: str, info: ActionInfo, connection: Connection, label: str):
        super().__init__(server, info, connection, label)
        self.input = tool_input(info.goal, is_needed=self.goals.needs_goal)
        self.output = tool_output(info.result, (status.name for status in GoalStatus))


ToolActions = RobotActions[ToolAction]


def instructions(policy: AgentPolicy) -> str:
    """Return the text that introduces the tools to the model."""
    return READ_ONLY if policy.read_only else INSTRUCTIONS.format(patience=policy.patience)


def tool_list(actions: Mapping[str, ToolAction], policy: AgentPolicy) -> list[Tool]:
    """Return all tools, in an order that does not change."""
    if policy.read_only:
        return [_status_tool(policy)]
    own = [_action_tool(actions[name], policy) for name in sorted(actions)]
    return [*own, _send_tool(sorted(actions)), _status_tool(policy), _cancel_tool(policy)]


def _action_tool(action: ToolAction, policy: AgentPolicy) -> Tool:
    info = action.info
    kind = f", of the type {excerpt(info.type_name)}" if info.type_name else ""
    text = f"Send a goal to the action {action.title}{kind}, and wait for its result."
    if info.description:
        text += f" {shortened(info.description, LONGEST_DESCRIPTION)}"
    if policy.asks(action.server, info.name):
        text += " The user is asked before the goal is sent."
    return Tool(
        name=action.label,
        title=action.title,
        description=text,
        input_schema=action.input.schema,
        output_schema=action.output,
        annotations=_moves(),
    )


def _send_tool(names: list[str]) -> Tool:
    tool: dict[str, Any] = {"type": "string", "description": "The name of the action's tool."}
    if names:
        tool["enum"] = names
    return Tool(
        name=SEND,
        title="Send a goal",
        description=(
            f"Send a goal that takes long, and answer at once with its goal_id. Follow it with"
            f" {STATUS}, stop it with {CANCEL}."
        ),
        input_schema=_object(
            {
                "tool": tool,
                GOAL: {"description": "The input of that tool.", "type": "object", "default": {}},
            },
            required=["tool"],
        ),
        annotations=_moves(),
    )


def _status_tool(policy: AgentPolicy) -> Tool:
    return Tool(
        name=STATUS,
        title="Goal status",
        description=(
            "Tell how a goal is doing, with its newest feedback, and its result when it has ended."
            " Without a goal_id, list the servers, their actions and the goals of all clients."
        ),
        input_schema=_object({"goal_id": _GOAL_ID, "wait": _wait(policy, 0)}),
        annotations=ToolAnnotations(read_only_hint=True, open_world_hint=False),
    )


def _cancel_tool(policy: AgentPolicy) -> Tool:
    return Tool(
        name=CANCEL,
        title="Cancel a goal",
        description=(
            "Stop a goal before its end. The user is asked if you have not sent it yourself."
        ),
        input_schema=_object({"goal_id": _GOAL_ID, "wait": _wait(policy, 5)}, required=["goal_id"]),
        annotations=ToolAnnotations(
            read_only_hint=False, destructive_hint=True, idempotent_hint=True, open_world_hint=False
        ),
    )


def _wait(policy: AgentPolicy, default: float) -> dict[str, Any]:
    return {
        "type": "number",
        "minimum": 0,
        "maximum": policy.patience,
        "default": min(default, policy.patience),
        "description": "Seconds to wait for the end of the goal.",
    }


def _object(properties: dict[str, Any], required: list[str] | None = None) -> dict[str, Any]:
    schema: dict[str, Any] = {"type": "object", "properties": properties}
    if required:
        schema["required"] = required
    return {**schema, "additionalProperties": False}


def _moves() -> ToolAnnotations:
    return ToolAnnotations(
        read_only_hint=False, destructive_hint=True, idempotent_hint=False, open_world_hint=True
    )


# Schemas


class ToolInput(NamedTuple):
    """The input of a tool."""

    schema: dict[str, Any]
    is_wrapped: bool
    """True if the goal is the field `goal` of the input."""

    def goal_in(self, arguments: Mapping[str, Any]) -> Any:
        """Return the goal that the arguments of a call contain; `{}` if it is missing."""
        return arguments.get(GOAL, {}) if self.is_wrapped else dict(arguments)


def tool_input(goal: Mapping[str, Any], *, is_needed: bool = True) -> ToolInput:
    """Return the input of a tool that sends goals of that schema. If none is needed, the field
    `goal` may be missing.
    """
    definitions = goal.get("$defs", {})
    root = {name: part for name, part in goal.items() if name != "$defs"}
    body = _resolved(root, definitions)
    is_wrapped = body.get("type") != "object" or any(name in body for name in _CHOICES)
    schema: dict[str, Any]
    if is_wrapped:
        schema = {"type": "object", "properties": {GOAL: root}}
        schema |= {"required": [GOAL]} if is_needed else {}
    elif body.get("properties") == {} and not body.get("additionalProperties"):
        schema = {"type": "object", "additionalProperties": False}
    else:
        schema = dict(body)
    if "properties" in schema:
        schema.setdefault("additionalProperties", False)
    if used := _used(schema, definitions):
        schema["$defs"] = used
    return ToolInput(schema, is_wrapped)


def tool_output(result: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Return the schema of what a tool answers for an action with results of that schema.

    `names` are those of the statuses. No field is required: a goal that still runs has no result,
    and an answer that is too long has only its beginning.
    """
    definitions = result.get("$defs", {})
    root = {name: part for name, part in result.items() if name != "$defs"}
    used = _used(root, definitions)
    known = {f"{_PREFIX}{name}" for name in used}
    if not known.issuperset(_references([root, used])):
        root, used = {}, {}  # it refers to itself as a whole, or to something outside
    schema: dict[str, Any] = {
        "type": "object",
        "properties": {
            "goal_id": {"type": "string"},
            "action": {"type": "string"},
            "status": {"enum": list(names)},
            "result": _with_nulls(root),
            "reason": {"type": "string"},
            "feedback_count": {"type": "integer"},
            "feedback": {},
        },
    }
    return schema | ({"$defs": _with_nulls(used)} if used else {})


def _with_nulls(part: Any) -> Any:
    """Return a schema that allows null for each number: NaN and infinities are null in JSON."""
    if is_list(part):
        return [_with_nulls(one) for one in part]
    if not is_map(part):
        return part
    made = {name: _with_nulls(one) for name, one in part.items()}
    return made | {"type": ["number", "null"]} if part.get("type") == "number" else made


def _resolved(schema: dict[str, Any], definitions: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema that a chain of references ends with; empty if it has no end."""
    for _ in range(len(definitions) + 1):
        reference = schema.get("$ref")
        if reference is None:
            return schema
        schema = definitions.get(str(reference).removeprefix(_PREFIX), {})
    return {}


def _used(schema: Any, definitions: Mapping[str, Any]) -> dict[str, Any]:
    """Return the definitions that a schema refers to, even through others."""
    used: dict[str, Any] = {}
    todo = [schema]
    while todo:
        for reference in _references(todo.pop()):
            name = reference.removeprefix(_PREFIX)
            if name in definitions and name not in used:
                used[name] = definitions[name]
                todo.append(definitions[name])
    return {name: part for name, part in definitions.items() if name in used}


def _references(schema: Any) -> Iterator[str]:
    todo = [schema]
    while todo:
        part = todo.pop()
        if is_map(part):
            if isinstance(reference := part.get("$ref"), str):
                yield reference
            todo.extend(part.values())
        elif is_list(part):
            todo.extend(part)


CALL = "tools/call"


def take_arguments(request: dict[str, Any]) -> dict[str, Any] | None:
    """Take the arguments out of the call of a tool; return None if it is not one."""
    params = request.get("params")
    if request.get("method") != CALL or not is_map(params):
        return None
    arguments = params.get("arguments")
    if not is_map(arguments):
        return None
    params["arguments"] = {}
    return dict(arguments)


def state_of(context: ServerRequestContext[Any, Any]) -> dict[str, Any]:
    """Return what the HTTP server knows about a request; nothing if it came otherwise."""
    scope: dict[str, Any] = getattr(context.request, "scope", {})
    state: dict[str, Any] = scope.get("state", {})
    return state


def with_arguments(
    context: ServerRequestContext[Any, Any], params: CallToolRequestParams
) -> CallToolRequestParams:
    """Return the parameters of a call with the arguments that were taken out of its request."""
    arguments = state_of(context).get("documents")
    return params if arguments is None else params.model_copy(update={"arguments": arguments})


def client_of(context: ServerRequestContext[Any, Any]) -> str:
    """Return the name that belongs to the client's token; empty if the transport has no tokens."""
    client: Peer | None = state_of(context).get("client")
    return "" if client is None else client.name
