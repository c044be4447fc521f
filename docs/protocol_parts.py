"""Generated parts of docs/protocol.md: messages, descriptions of actions, and limits."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import textwrap
from pathlib import Path
from typing import Any, get_args

import msgspec
from msgspec import inspect as types
from page_parts import table

from fibaction.types.action import ActionInfo
from fibaction.wire import messages
from fibaction.wire.settings import Limits
from fibaction.words.intake import IntakeMode, ScheduleInfo

GOLDEN = Path(__file__).resolve().parent.parent / "tests" / "support" / "golden.py"
"""Bytes of one message of each type: with these the tests pin the format."""

MEANINGS = {
    "id": "ID of the request that this message makes or belongs to.",
    "action": "Name of the action.",
    "goal_id": "ID of the goal.",
    "goal": "The goal, a payload.",
    "credit": "`GoalChanged` messages that the server may send before more credit.",
    "stamp": "Time when the goal was accepted: nanoseconds since 1970, by the server's clock.",
    "status": "[Goal status](#statuses).",
    "reason": "Explanation for a person; may be empty.",
    "text": "Explanation for a person.",
    "version": "Version of the protocol: 1.",
    "heartbeat": "Longest time between two messages of this side, in seconds.",
    "count": "Messages that the server may send in addition to those already granted.",
    "number": "Number of the feedback message among the feedback of the attempt, from 1.",
    "payload": "The feedback message, a payload.",
    "result": "The result, a payload; nil if there is none.",
    "return_code": "[Return code](#return-codes).",
    "goals": "Goals whose cancel was accepted: ID, stamp and status of each.",
    "actions": "Description of each action.",
    "name": "Name of the action.",
    "type_name": "ROS 2 type of the action; empty if it has none.",
    "feedback": "JSON Schema of a feedback message.",
    "latest": "True if the server's policy gives a slow reader the newest feedback only.",
    "after": "Number of the feedback after which the stream begins; nil: with the next feedback.",
    "CancelGoals.goal_id": "ID of a goal; nil or zeros: see [canceling](#canceling).",
    "CancelGoals.stamp": "Latest stamp of the goals; nil or 0: see [canceling](#canceling).",
    "mode": "`open`, `hold`, `refuse` or `drain`.",
    "Operate.mode": "`open`, `hold`, `refuse` or `drain`; nil to change nothing.",
    "Ended.status": "Last [goal status](#statuses): 4, 5 or 6; 0 if the server does not know it.",
    "Ended.place": "Number of the last feedback that was sent or left out.",
    "GoalChanged.stamp": "Time when the goal was accepted, as in `Following`; 0 if `status` is 0.",
    "GoalChanged.status": "[Goal status](#statuses); 0 if the server has forgotten the goal.",
    "ActionInfo.goal": "JSON Schema of a goal.",
    "ActionInfo.result": "JSON Schema of a result.",
}
"""Meaning of each field that has no docstring, by its name.

An entry with the name of a message overrides the docstring."""


def messages_part() -> str:
    """Return the section on every message: its form, its fields, and the bytes of an example."""
    client, server = get_args(messages.FromClient), get_args(messages.FromServer)
    groups = {
        "From either side": [kind for kind in client if kind in server],
        "From the client": [kind for kind in client if kind not in server],
        "From the server": [kind for kind in server if kind not in client],
    }
    bytes_of = golden_bytes()
    return "\n\n".join(
        f"### {title}\n\n" + "\n\n".join(_message(kind, bytes_of[kind]) for kind in kinds)
        for title, kinds in groups.items()
    )


def golden_bytes() -> dict[type, str]:
    """Return the pinned bytes of one message of each type, in hexadecimal."""
    spec = importlib.util.spec_from_file_location("golden", GOLDEN)
    assert spec is not None
    assert spec.loader is not None
    golden = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(golden)
    return {type(message): digits for message, digits in golden.GOLDEN}


def _message(kind: type[msgspec.Struct], digits: str) -> str:
    tag = kind.__struct_config__.tag
    form = ", ".join((str(tag), *kind.__struct_fields__))
    example = _shown(msgspec.msgpack.decode(bytes.fromhex(digits)))
    parts = [f"#### {kind.__name__}", f"`[{form}]`", _prose(kind.__doc__)]
    if kind.__struct_fields__:
        parts.append(_fields(kind))
    parts.append(f"```text\n{example}\n{digits}\n```")
    return "\n\n".join(parts)


def _fields(kind: type[msgspec.Struct], title: str = "Field") -> str:
    described = types.type_info(kind)
    assert isinstance(described, types.StructType)
    docs = docs_of_fields(kind)
    rows: list[list[str]] = []
    for field in described.fields:
        default = "" if field.required else f"`{_shown(_default(field))}`"
        meaning = (
            MEANINGS.get(f"{kind.__name__}.{field.name}")
            or docs[field.name]
            or MEANINGS[field.name]
        )
        rows.append([f"`{field.name}`", _wire(field.type), default, meaning])
    return table([title, "Type", "Default", "Meaning"], rows)


def _default(field: types.Field) -> object:
    return field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()


def docs_of_fields(kind: type) -> dict[str, str]:
    """Return the docstring of each field in the source; empty for a field without one."""
    (described,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(described, ast.ClassDef)
    docs: dict[str, str] = {}
    field = ""
    for node in described.body:
        match node:
            case ast.AnnAssign(target=ast.Name(id=field)):
                docs[field] = ""
            case ast.Expr(value=ast.Constant(value=str(text))) if field:
                docs[field] = _prose(text)
            case _:
                field = ""
    return docs


def _prose(text: str | None) -> str:
    return " ".join((text or "").split())


def _wire(described: types.Type) -> str:
    """Return the name of a type on the wire."""
    match described:
        case types.NoneType():
            return "nil"
        case types.BoolType():
            return "boolean"
        case types.StrType():
            return "text"
        case types.BytesType(min_length=None):
            return "bytes"
        case types.BytesType(min_length=length):
            return f"{length} bytes"
        case types.IntType():
            return "integer" + _range(described)
        case types.EnumType(cls=cls) if cls is IntakeMode:
            return "text"
        case types.EnumType(cls=cls):
            numbers = [int(one.value) for one in cls]
            return f"integer, {min(numbers)} to {max(numbers)}"
        case types.FloatType():
            return "number" + _range(described)
        case types.UnionType():
            return " or ".join(map(_wire, described.types))
        case types.ListType():
            return f"array of {_wire(described.item_type)}"
        case types.TupleType():
            return f"({'; '.join(map(_wire, described.item_types))})"
        case types.StructType(cls=cls) if cls is ActionInfo:
            return "[action descriptions](#descriptions-of-actions)"
        case types.StructType(cls=cls) if cls is ScheduleInfo:
            return "[schedule](#schedules)"
        case types.DictType():
            return "map"
    raise TypeError(f"a field of type {described} is new in a message: name it here")


def _range(described: types.IntType | types.FloatType) -> str:
    least, most = described.ge, described.le
    if described.lt is not None:
        most = described.lt - 1
    if described.gt is not None:
        return f", more than {described.gt:g}, at most {most:g}"
    if least is None:
        return ""
    power = {2**31 - 1: "2^31-1", 2**63 - 1: "2^63-1"}
    return f", {least} to {power.get(int(most or 0), most)}"


def _shown(value: Any) -> str:
    """Return a decoded value in the notation of RFC 8949, where byte strings are like h'00ff'."""
    if isinstance(value, bytes):
        return f"h'{value.hex()}'"
    if isinstance(value, list):
        return f"[{', '.join(map(_shown, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_shown(key)}: {_shown(one)}' for key, one in value.items())}}}"
    return msgspec.json.encode(value).decode()


def descriptions_part() -> str:
    """Return the table of the keys of an action's description."""
    return _fields(ActionInfo, "Key")


def schedules_part() -> str:
    """Return the table of the keys of a schedule."""
    return _fields(ScheduleInfo, "Key")


def limits_part() -> str:
    """Return the table of the default limits of a server of fibaction."""
    return _fields(Limits, "Limit")
