"""The description of the REST interface: OpenAPI 3.1, from the JSON Schemas of the actions.

It says what the server checks, so that what it allows is accepted, and what it does not allow is
rejected: generators of clients and of requests take it at its word.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from fibaction import __version__
from fibaction.feeds.statistics import ActionStatistics
from fibaction.schema.payload import GoalCodec, PayloadError
from fibaction.types.action import ActionInfo
from fibaction.words.goal_query import CANCEL_TEXT, LABEL_TEXT, STATUSES, TIME_TEXT
from fibaction.words.intake import Intake
from fibaction.words.meta import MAX_KEYS
from fibaction.words.statuses import GoalStatus
from fibaction_transports.web.rest.actions import WantedIntake
from fibaction_transports.web.rest.goal_events import LONGEST_WAIT
from fibaction_transports.web.rest.goal_list import LARGEST_OFFSET, SORT_WORDS
from fibaction_transports.web.rest.openapi_schemas import (
    SHARED,
    Names,
    example_of,
    moved,
    of_structs,
)

Json = dict[str, Any]

API_VERSION = "1"
"""The version of the interface."""

_ID = {"type": "string", "pattern": "^[0-9a-f]{32}$"}
_ONE_ID = {"type": "string", "pattern": "^(?!0{32}$)[0-9a-f]{32}$"}
_STATUS = {"type": "string", "enum": [status.name for status in GoalStatus]}
_STAMP = {
    "type": "string",
    "pattern": "^[0-9]+$",
    "description": "Time of the acceptance: nanoseconds since 1970.",
}
_SCHEMA = {"type": "object", "description": "JSON Schema; empty for any value."}
_TEXT = {"type": "string"}
_NUMBER = {"type": "integer"}


def _text(description: str) -> Json:
    return _TEXT | {"description": description}


def _object(description: str, required: Json, optional: Json | None = None) -> Json:
    return {
        "type": "object",
        "description": description,
        "properties": required | (optional or {}),
        "required": list(required),
    }


_SHARED_SCHEMAS: Json = {
    "Problem": _object(
        "Problem details as in RFC 9457.",
        {
            "type": _TEXT,
            "title": _TEXT,
            "status": _NUMBER,
            "detail": _text("The reason, for people."),
        },
    ),
    "Action": _object(
        "An action, and the schemas of its messages.",
        {
            "name": _TEXT,
            "type_name": _text("Its type of ROS 2; may be empty."),
            "goal": _SCHEMA,
            "feedback": _SCHEMA,
            "result": _SCHEMA,
        },
        {
            "intake": _object(
                "Only while the action is paused, or its server drains.",
                {"mode": _TEXT | {"enum": ["hold", "refuse", "drain"]}, "text": _text("Why.")},
            ),
            "no_levers": _text("Only if it can be neither paused nor drained from here; why."),
            "schedule": {
                "allOf": [{"$ref": SHARED + "ScheduleInfo"}, _object("A phrase.", {"text": _TEXT})]
            },
            "away": _object(
                "Only while the server of the action cannot be reached.",
                {
                    "since": {"type": "number", "description": "Seconds since 1970."},
                    "reason": _text("The newest error."),
                },
            ),
        },
    ),
    "Goal": _object(
        "A goal, and how far it is.",
        {"goal_id": _ID, "stamp": _STAMP, "status": _STATUS},
        {
            "attempt": _NUMBER,
            "began_at": _text("Time of the begin, as the stamp."),
            "ended_at": _text("Time of the end, as the stamp."),
            "waited": {"type": "number", "description": "Seconds until the begin."},
            "ran": {"type": "number", "description": "Seconds from the begin to the end."},
            "reason": _text("Why it was canceled or aborted."),
            "parent": {"$ref": SHARED + "Parent"},
            "worker": _text("The worker of a fleet that has it."),
            "checkpoint": {"description": "That of a goal which was given up; null if none."},
            "labels": {
                "type": "object",
                "description": "The labels that its client has given it.",
                "additionalProperties": _TEXT,
            },
        },
    ),
    "Parent": _object(
        "The goal whose executor has sent this one, and the step.", {"goal_id": _ID, "step": _TEXT}
    ),
    "FoundGoal": {
        "description": "A goal, and the action that it is of.",
        "allOf": [
            {"$ref": SHARED + "Goal"},
            {"type": "object", "required": ["action"], "properties": {"action": _TEXT}},
        ],
    },
    "Found": _object(
        "A page of the goals that a search has found.",
        {
            "total": _NUMBER | {"description": "The number of all goals that were found."},
            "goals": {"type": "array", "items": {"$ref": SHARED + "FoundGoal"}},
            "away": {
                "type": "array",
                "items": _TEXT,
                "description": "The actions whose servers cannot be asked.",
            },
        },
    ),
    "Cancel": _object(
        "The answer to a cancel.",
        {
            "code": _TEXT,
            "goals_canceling": {"type": "array", "items": {"$ref": SHARED + "Goal"}},
            "reason": _TEXT,
        },
    ),
}
_PROBLEM = {
    "description": "A problem.",
    "content": {"application/problem+json": {"schema": {"$ref": SHARED + "Problem"}}},
}
_PROBLEMS = {"4XX": _PROBLEM, "default": _PROBLEM}
_RERUN = {"type": "object", "required": ["goal_id"], "properties": {"goal_id": _ONE_ID}}
_LOG_LINE = {
    "type": "object",
    "required": ["at", "level", "logger", "text"],
    "properties": {
        "at": {"type": "string", "description": "Nanoseconds since 1970."},
        "level": _TEXT,
        "logger": _TEXT,
        "text": _TEXT,
    },
}
_LOG = {
    "type": "object",
    "required": ["lines"],
    "properties": {"lines": {"type": ["array", "null"], "items": _LOG_LINE}},
}
_GOAL_ID = {"name": "goal_id", "in": "path", "required": True, "schema": _ONE_ID}


def _parameter(name: str, description: str, schema: Json) -> Json:
    return {"name": name, "in": "query", "description": description, "schema": schema}


_WAIT = _parameter(
    "wait",
    "Seconds to wait for the end of the goal before the answer.",
    {"type": "number", "minimum": 0, "maximum": LONGEST_WAIT},
)
_LIMIT = _parameter(
    "limit",
    "Goals of a page, in the order of acceptance; without it all are listed.",
    {"type": "integer", "minimum": 1},
)
_AFTER_PAGE = _parameter(
    "after",
    "The cursor in the header Link of the page before.",
    {"type": "string", "pattern": r"^[0-9]{1,19}\.[0-9a-f]{32}$"},
)
_PARENT = _parameter("parent", "Only goals that the executor of this goal has sent.", _ONE_ID)
_STATUSES = _parameter(
    "status",
    "Only goals with this status; may be given several times.",
    {"type": "array", "minItems": 1, "items": {"type": "string", "enum": [*STATUSES]}},
)
_LABEL = {"type": "string", "pattern": LABEL_TEXT}
_CLIENT = _parameter(
    "client", "Only goals whose client has this text in it.", {"type": "string", "minLength": 1}
)
_LABELS, _NEW_LABELS = (
    _parameter(
        "label",
        f"{what}, such as `order=17`; may be given several times.",
        {"type": "array", "minItems": 1, "maxItems": MAX_KEYS, "items": _LABEL},
    )
    for what in ("Only goals with this label", "A label of the goal, to find it again")
)
_TIME = {"type": "string", "anyOf": [{"format": "date-time"}, {"pattern": TIME_TEXT}]}
_SINCE, _UNTIL = (
    _parameter(
        name,
        f"Only goals that were accepted at this time or {when}: a time of ISO 8601,"
        " a stamp, or `10m` for ten minutes ago.",
        _TIME,
    )
    for name, when in (("since", "later"), ("until", "earlier"))
)
_STATISTICS_SINCE = _parameter(
    "since", "The begin of the longer span, one day ago without it; otherwise as for goals.", _TIME
)
_CANCEL_TIME = {"type": "string", "anyOf": [{"format": "date-time"}, {"pattern": CANCEL_TEXT}]}
_BEFORE = _UNTIL | {"name": "before", "schema": _CANCEL_TIME}
_PAST = _parameter(
    "past",
    "With `true`, also the goals that the server has forgotten and that its store"
    " keeps as its history; always in pages.",
    {"type": "boolean"},
)
_SEARCHING = (
    _parameter(
        "action",
        "Only goals of this action; may be given several times.",
        {"type": "array", "minItems": 1, "items": _TEXT},
    ),
    _parameter(
        "search",
        "Only goals that have each of these words in their action, ID, status, client, worker,"
        " reason, labels or parent; upper and lower case are the same.",
        _TEXT,
    ),
    _parameter(
        "sort",
        "The order; with a dash in front, the last first.",
        {"type": "string", "enum": [*SORT_WORDS], "default": "-accepted"},
    ),
    _parameter("limit", "Goals of the answer.", {"type": "integer", "minimum": 1}),
    _parameter(
        "offset",
        "Goals before those of the answer.",
        {"type": "integer", "minimum": 0, "maximum": LARGEST_OFFSET},
    ),
)
_GOAL_FILTERS = (_STATUSES, _CLIENT, _LABELS, _SINCE, _UNTIL, _PARENT)
_NEXT = {
    "Link": {
        "description": "The address of the next page, with rel=next; absent on the last one.",
        "schema": {"type": "string"},
    }
}
_AFTER = _parameter(
    "after",
    "The ID of the last event that is known, as in the header Last-Event-ID.",
    {"type": "string", "pattern": r"^(end|([1-9][0-9]{0,8}\.)?[0-9]{1,18})$"},
)

_TIMES = _parameter(
    "times",
    "With `true`, the data of feedback is `at`, the time at which it was reported in nanoseconds"
    " since 1970, and `feedback`.",
    {"type": "boolean"},
)

_DESCRIPTIONS = {
    "describe": "The action, with the JSON Schemas of its messages.",
    "stats": "How many goals were accepted and ended, why some failed, and how long they waited"
    " and ran: in the last ten minutes, and since a time. An answer may be some seconds old.",
    "intake": "Whether new goals are accepted, wait or are rejected, and who has changed that.",
    "operate": "Pauses the action, drains its server, or lets it take goals again. It needs the"
    " permission `OPERATE`, and is noted with the name of the client.",
    "list": "The goals that the server remembers, all or those that you choose. With `limit` they"
    " come in pages.",
    "send": "The answer comes at once, or with `wait` at the end of the goal. If you accept"
    " `text/event-stream`, it is the events of the goal.",
    "put": "As for POST. If you send the same goal again under its ID, it still runs once.",
    "cancel_all": "Asks all goals to stop, or those that you choose.",
    "status": "The status, and the result once the goal has ended; with `wait`, the answer waits"
    " for the end.",
    "cancel": "Asks the goal to stop. It ends when its executor has cleaned up.",
    "rerun": "Runs a goal that was given up again, as a new goal from its last checkpoint, and"
    " tells the ID of that. It needs the permission `OPERATE`.",
    "log": "The newest log records of the goal's executor, the oldest first; null if the server"
    " keeps none.",
    "events": "The events of a goal, from its first feedback or from the one after `after`.",
}


def describe(actions: Iterable[ActionInfo], root: str, *, asks_for_tokens: bool) -> Json:
    """Return the description of an interface whose paths are below `root`."""
    infos = list(actions)
    listed = {"type": "array", "items": _ref("Action")}
    all_actions = {
        "summary": "List the actions.",
        "description": "All actions of this server, each with the JSON Schemas of its messages.",
        "operationId": "list_actions",
        "tags": ["actions"],
        "responses": {"200": _answer("The actions.", listed)} | _PROBLEMS,
    }
    search = {
        "summary": "Search goals.",
        "description": "The goals of all actions that you choose, those of the histories included:"
        " one page, and the number of all of them.",
        "operationId": "search_goals",
        "tags": ["actions"],
        "parameters": [*_GOAL_FILTERS, *_SEARCHING],
        "responses": {"200": _answer("The goals.", _ref("Found"))} | _PROBLEMS,
    }
    paths: Json = {"/actions": {"get": all_actions}, "/goals": {"get": search}}
    schemas = _SHARED_SCHEMAS | of_structs(ActionStatistics, Intake, WantedIntake)
    schema_names, operations = Names(*schemas), Names("list_actions", "search_goals")
    for info in infos:
        _Described(info, schemas, schema_names, operations).add(paths)
    described: Json = {
        "openapi": "3.1.0",
        "info": {
            "title": "Actions",
            "version": API_VERSION,
            "description": "Goals that take time: send them, follow them, cancel them.",
            "x-fibaction": __version__,
        },
        "servers": [{"url": root or "/"}],
        "tags": [{"name": "actions", "description": "The actions of this server."}]
        + [
            {"name": info.name, "description": info.description or f"Goals of {info.name}."}
            for info in infos
        ],
        "paths": paths,
        "components": {"schemas": schemas},
        "security": [],
    }
    if asks_for_tokens:
        bearer = {"type": "http", "scheme": "bearer"}
        described["components"]["securitySchemes"] = {"token": bearer}
        described["security"] = [{"token": []}]
    return described


class _Described:
    """One action, whose schemas are added to the shared ones."""

    def __init__(
        self, info: ActionInfo, schemas: Json, schema_names: Names, operations: Names
    ) -> None:
        self._info = info
        self._operations = operations
        name = info.name
        self._goal, feedback, result, self._status = (
            schema_names.unique(f"{name}.{part}")
            for part in ("goal", "feedback", "result", "status")
        )
        schemas |= moved(info.goal, self._goal, schema_names, is_goal=True)
        self._example = example_of(info.goal) if schemas[self._goal] else {}
        self._body = _ref(self._goal)
        self._is_needed = _needs_goal(info)
        if not self._is_needed:
            self._body = {"anyOf": [self._body, _EMPTY]}
        schemas |= moved(info.feedback, feedback, schema_names)
        schemas |= moved(info.result, result, schema_names)
        schemas[self._status] = {
            "description": f"A goal of {name}, and its result once it has ended.",
            "allOf": [
                _ref("Goal"),
                {
                    "type": "object",
                    "properties": {
                        "result": {"anyOf": [_ref(result), {"type": "null"}]},
                    },
                },
            ],
        }
        self._events = f"Server-sent events; the data of feedback is of {feedback}."

    def add(self, paths: Json) -> None:
        """Add the paths of the action."""
        name = self._info.name
        base = f"/actions/{name.replace('/', '%2F') if name[0] in '/~' else name}"
        answer = {"200": _answer("The action.", _ref("Action"))}
        described = self._operation("describe", "Describe the action.", answer)
        paths.setdefault(base, {"get": described})  # a list of goals at this address goes first
        paths[f"{base}/stats"] = {"get": self._statistics()}
        paths[f"{base}/intake"] = self._intake()
        paths[f"{base}/goals"] = self._goals()
        paths[f"{base}/goals/{{goal_id}}"] = self._one_goal()
        again = {"201": _answer("The goal runs again.", _RERUN)}
        paths[f"{base}/goals/{{goal_id}}/rerun"] = {
            "post": self._operation("rerun", "Run a given-up goal again.", again, _GOAL_ID)
        }
        log = {"200": _answer("The log records.", _LOG)}
        paths[f"{base}/goals/{{goal_id}}/log"] = {
            "get": self._operation("log", "Tell the log of a goal.", log, _GOAL_ID)
        }
        events = {"200": {"description": self._events, "content": _STREAM}, "204": _NO_MORE}
        paths[f"{base}/goals/{{goal_id}}/events"] = {
            "get": self._operation("events", "Follow a goal.", events, _GOAL_ID, _AFTER, _TIMES)
        }

    def _statistics(self) -> Json:
        told = {"200": _answer("The statistics.", _ref("ActionStatistics"))}
        return self._operation("stats", "Tell the statistics.", told, _STATISTICS_SINCE)

    def _intake(self) -> Json:
        told = {"200": _answer("The way in which it takes goals.", _ref("Intake"))}
        body = {"application/json": {"schema": _ref("WantedIntake")}}
        return {
            "get": self._operation("intake", "Tell how goals are taken.", told),
            "put": self._operation("operate", "Pause, resume or drain.", told)
            | {"requestBody": {"required": True, "content": body}},
        }

    def _goals(self) -> Json:
        goals = _answer("Goals.", {"type": "array", "items": _ref("Goal")}) | {"headers": _NEXT}
        # Not the events as well: a generator would make them another type of each answer.
        sent = {
            "200": _answer("The goal was known by its key.", _ref(self._status)),
            "201": _answer("The goal was accepted.", _ref(self._status)),
        }
        return {
            "get": self._operation(
                *("list", "List the goals.", {"200": goals}),
                *(*_GOAL_FILTERS, _PAST, _LIMIT, _AFTER_PAGE),
            ),
            "post": self._sending("send", "Send a goal.", sent, *_SENDING, _KEY),
            "delete": self._operation(
                *("cancel_all", "Cancel goals.", _CANCELED), *(*_GOAL_FILTERS, _BEFORE)
            ),
        }

    def _one_goal(self) -> Json:
        found = {"200": _answer("The goal.", _ref(self._status))}
        sent = {
            "200": _answer("The goal was known.", _ref(self._status)),
            "201": _answer("The goal was accepted.", _ref(self._status)),
        }
        return {
            "get": self._operation("status", "Get status and result.", found, _GOAL_ID, _WAIT),
            "put": self._sending("put", "Send a goal with an ID of your own.", sent, *_PUT),
            "delete": self._operation("cancel", "Cancel the goal.", _CANCELED, _GOAL_ID),
        }

    def _sending(self, verb: str, summary: str, answers: Json, *parameters: Json) -> Json:
        content = {"application/json": {"schema": self._body, **self._example}}
        body = {"requestBody": {"required": self._is_needed, "content": content}}
        return self._operation(verb, summary, answers, *parameters) | body

    def _operation(self, verb: str, summary: str, answers: Json, *parameters: Json) -> Json:
        texts = [self._info.description] if verb in _SENDING_VERBS else []
        described: Json = {
            "summary": summary,
            "description": "\n\n".join(filter(None, [*texts, _DESCRIPTIONS[verb]])),
            "operationId": self._operations.unique(f"{verb}.{self._info.name}"),
            "tags": [self._info.name],
        }
        if parameters:
            described["parameters"] = list(parameters)
        return described | {"responses": answers | _PROBLEMS}


def _needs_goal(info: ActionInfo) -> bool:
    try:
        return GoalCodec(info.goal).needs_goal
    except PayloadError:  # its schema cannot be used
        return True


def _ref(name: str) -> Json:
    return {"$ref": SHARED + name}


def _answer(description: str, schema: Json) -> Json:
    return {"description": description, "content": {"application/json": {"schema": schema}}}


_EMPTY = {"type": ["null", "object"], "maxProperties": 0, "description": "No goal."}
_SENDING_VERBS = ("send", "put")
_CANCELED = {"202": _answer("The cancel was accepted.", _ref("Cancel"))}
_SENDING = (_WAIT, _NEW_LABELS)
_KEY = {
    "name": "Idempotency-Key",
    "in": "header",
    "description": "A text of your own: the same goal with the same key runs once.",
    "schema": {"type": "string"},
}
_PUT = (_GOAL_ID, *_SENDING)
_STREAM: Json = {"text/event-stream": {}}
_NO_MORE = {"description": "There is nothing after the event with the ID `end`."}
