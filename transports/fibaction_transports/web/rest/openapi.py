"""The description of the REST interface: OpenAPI 3.1, from the JSON Schemas of the actions."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from fibaction.border.plain_values import is_list, is_map
from fibaction.types.action import ActionInfo
from fibaction.words.statuses import GoalStatus

Json = dict[str, Any]

API_VERSION = "1"
"""The version of the interface."""

_ID = {"type": "string", "pattern": "^[0-9a-f]{32}$"}
_STATUS = {"type": "string", "enum": [status.name for status in GoalStatus]}
_STAMP = {"type": "string", "description": "Time of the acceptance: nanoseconds since 1970."}
_SHARED_SCHEMAS: Json = {
    "Problem": {
        "type": "object",
        "description": "Problem details as in RFC 9457.",
        "properties": {
            "type": {"type": "string"},
            "title": {"type": "string"},
            "status": {"type": "integer"},
            "detail": {"type": "string", "description": "The reason, for people."},
        },
        "required": ["type", "title", "status", "detail"],
    },
    "Goal": {
        "type": "object",
        "properties": {
            "goal_id": _ID,
            "stamp": _STAMP,
            "status": _STATUS,
            "attempt": {"type": "integer"},
            "began_at": {"type": "string", "description": "Time of the begin, as the stamp."},
            "ended_at": {"type": "string", "description": "Time of the end, as the stamp."},
            "reason": {"type": "string", "description": "Why it was canceled or aborted."},
            "parent": {
                "type": "object",
                "description": "The goal whose executor has sent this one, and the step.",
                "properties": {"goal_id": _ID, "step": {"type": "string"}},
                "required": ["goal_id", "step"],
            },
        },
        "required": ["goal_id", "stamp", "status"],
    },
    "Cancel": {
        "type": "object",
        "properties": {
            "code": {"type": "string"},
            "goals_canceling": {"type": "array", "items": {"$ref": "#/components/schemas/Goal"}},
            "reason": {"type": "string"},
        },
    },
}
_PROBLEM = {
    "description": "A problem.",
    "content": {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}},
}
_GOAL_ID = {"name": "goal_id", "in": "path", "required": True, "schema": _ID}
_WAIT = {
    "name": "wait",
    "in": "query",
    "description": "Seconds to wait for the end of the goal before the answer.",
    "schema": {"type": "number", "minimum": 0},
}
_BEFORE = {
    "name": "before",
    "in": "query",
    "description": "Only goals that were accepted at or before this stamp.",
    "schema": {"type": "string"},
}
_LIMIT = {
    "name": "limit",
    "in": "query",
    "description": "Goals of a page, in the order of acceptance; without it all are listed.",
    "schema": {"type": "integer", "minimum": 1},
}
_AFTER_PAGE = {
    "name": "after",
    "in": "query",
    "description": "The cursor in the header Link of the page before.",
    "schema": {"type": "string"},
}
_PARENT = {
    "name": "parent",
    "in": "query",
    "description": "Only goals that the executor of this goal has sent.",
    "schema": _ID,
}
_NEXT = {
    "Link": {
        "description": "The address of the next page, with rel=next; absent on the last one.",
        "schema": {"type": "string"},
    }
}
_AFTER = {
    "name": "after",
    "in": "query",
    "description": "The ID of the last event that is known, as in the header Last-Event-ID.",
    "schema": {"type": "string"},
}


def describe(actions: Iterable[ActionInfo], root: str, *, asks_for_tokens: bool) -> Json:
    """Return the description of an interface whose paths are below `root`."""
    paths: Json = {
        "/actions": {"get": _operation("List the actions.", "list_actions", _anything("Actions."))}
    }
    schemas = dict(_SHARED_SCHEMAS)
    for info in actions:
        _add(info, paths, schemas)
    described: Json = {
        "openapi": "3.1.0",
        "info": {"title": "Actions", "version": API_VERSION},
        "servers": [{"url": root or "/"}],
        "paths": paths,
        "components": {"schemas": schemas},
    }
    if asks_for_tokens:
        bearer = {"type": "http", "scheme": "bearer"}
        described["components"]["securitySchemes"] = {"token": bearer}
        described["security"] = [{"token": []}]
    return described


def _add(info: ActionInfo, paths: Json, schemas: Json) -> None:
    """Add one action to the paths and the schemas."""
    name = re.sub(r"[^A-Za-z0-9_]", ".", info.name)
    for part in ("goal", "feedback", "result"):
        schemas[f"{name}.{part}"] = _moved(getattr(info, part), f"{name}.{part}", schemas)
    result: Json = {"anyOf": [_ref(f"{name}.result"), {"type": "null"}]}
    schemas[f"{name}.status"] = {
        "allOf": [_ref("Goal")],
        "properties": {"result": result, "reason": {"type": "string"}},
    }
    body = {
        "required": True,
        "content": {"application/json": {"schema": _ref(f"{name}.goal")}},
    }
    goal = _answer("The goal.", f"{name}.status")
    stream = {"text/event-stream": {"schema": {"type": "string"}}}
    sent = {"description": "The goal was accepted.", "content": {**goal["content"], **stream}}
    events = {"description": f"Events; feedback is of {name}.feedback.", "content": stream}
    cancel = _answer("The cancel was accepted.", "Cancel")
    goals = {"type": "array", "items": _ref("Goal")}
    content = {"application/json": {"schema": goals}}
    listed = {"description": "Goals.", "content": content, "headers": _NEXT}
    base = f"/actions/{info.name.replace('/', '%2F') if info.name[0] in '/~' else info.name}"
    described = _operation("Describe the action.", f"describe.{name}", _anything("The action."))
    paths.setdefault(base, {"get": described})  # a list of goals at this address comes before it
    paths[f"{base}/goals"] = {
        "get": _operation(
            *("List the goals.", f"list.{name}", {"200": listed}), _LIMIT, _AFTER_PAGE, _PARENT
        ),
        "post": _operation("Send a goal.", f"send.{name}", {"201": sent}, _WAIT)
        | {"requestBody": body},
        "delete": _operation("Cancel goals.", f"cancel_all.{name}", {"202": cancel}, _BEFORE),
    }
    one = {"200": goal}
    paths[f"{base}/goals/{{goal_id}}"] = {
        "get": _operation("Get status and result.", f"status.{name}", one, _GOAL_ID, _WAIT),
        "put": _operation(
            "Send a goal with an ID of your own.",
            f"put.{name}",
            {"200": sent, "201": sent},
            _GOAL_ID,
            _WAIT,
        )
        | {"requestBody": body},
        "delete": _operation("Cancel the goal.", f"cancel.{name}", {"202": cancel}, _GOAL_ID),
    }
    paths[f"{base}/goals/{{goal_id}}/events"] = {
        "get": _operation("Follow a goal.", f"events.{name}", {"200": events}, _GOAL_ID, _AFTER)
    }


def _operation(summary: str, operation: str, answers: Json, *parameters: Json) -> Json:
    described: Json = {"summary": summary, "operationId": operation}
    if parameters:
        described["parameters"] = list(parameters)
    return described | {"responses": answers | {"default": _PROBLEM}}


def _ref(name: str) -> Json:
    return {"$ref": f"#/components/schemas/{name}"}


def _answer(description: str, schema: str) -> Json:
    return {
        "description": description,
        "content": {"application/json": {"schema": _ref(schema)}},
    }


def _anything(description: str) -> Json:
    return {"200": {"description": description, "content": {"application/json": {"schema": {}}}}}


def _moved(schema: Json, name: str, schemas: Json) -> Json:
    """Return a schema whose definitions are among the `schemas`, below a name of its own.

    A schema that refers to itself, or that is too deep, is left out: it allows any value.
    """
    try:
        rest: Json = _renamed(schema, name)
    except RecursionError:
        return {}
    for key, part in rest.pop("$defs", {}).items():
        schemas[f"{name}.{key}"] = part
    return rest


def _renamed(part: Any, name: str) -> Any:
    """Return a part of a schema with its references pointing to where the definitions are moved."""
    if is_map(part):
        return {
            key: f"#/components/schemas/{name}.{item.removeprefix('#/$defs/')}"
            if key == "$ref" and isinstance(item, str) and item.startswith("#/$defs/")
            else f"#/components/schemas/{name}"
            if key == "$ref" and item == "#"
            else _renamed(item, name)
            for key, item in part.items()
        }
    return [_renamed(item, name) for item in part] if is_list(part) else part
