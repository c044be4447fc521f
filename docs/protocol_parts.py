"""The marked parts of docs/protocol.md: messages, descriptions of actions, and limits."""

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

from fibaction.action import ActionInfo
from fibaction.wire import messages
from fibaction.wire.settings import Limits

GOLDEN = Path(__file__).resolve().parent.parent / "tests" / "golden.py"
"""The bytes of a message of each type, by which the tests pin the format."""

MEANINGS = {
    "id": "The request that this is, or belongs to.",
    "action": "The action's name.",
    "goal_id": "The goal's ID.",
    "goal": "The goal itself: a payload.",
    "credit": "How many `GoalChanged` may come before more credit.",
    "stamp": "When the goal was accepted: nanoseconds since 1970, by the server's clock.",
    "status": "A [goal status](#statuses).",
    "reason": "Why, for a person to read; may be empty.",
    "text": "A sentence, for a person to read.",
    "version": "Of the protocol: 1.",
    "heartbeat": "Seconds: at least so often this side will send something.",
    "count": "How much more credit there is.",
    "number": "The feedback's place among all feedback of the goal: 1, 2, 3 and so on.",
    "payload": "The feedback itself.",
    "result": "The result, a payload; nil if there is none.",
    "return_code": "A [return code](#return-codes).",
    "goals": "The goals whose cancel was accepted: ID, stamp, status.",
    "actions": "Each action that is served here.",
    "name": "The action's name.",
    "type_name": "Its ROS 2 type, or empty.",
    "feedback": "The JSON Schema of a feedback message.",
    "latest": "Whether a reader who is late wants the newest feedback only: the server's policy.",
    "after": "Begin behind the feedback of that number; nil: with what comes from now on.",
    "CancelGoals.goal_id": "The goal it is about; nil or zeros: see below.",
    "CancelGoals.stamp": "Goals accepted at or before it; nil or 0: see below.",
    "Ended.status": "4, 5 or 6: a [goal status](#statuses); 0: the server does not know.",
    "Ended.place": "The number of the feedback that was sent last, or skipped.",
    "GoalChanged.stamp": "When it was accepted; 0 if `status` is 0.",
    "GoalChanged.status": "A [goal status](#statuses); 0: the server has forgotten the goal.",
    "ActionInfo.goal": "The JSON Schema of a goal.",
    "ActionInfo.result": "The JSON Schema of a result.",
}
"""What a field is, by its name; its own docstring counts unless the message is named here, too."""


def messages_part() -> str:
    """Every message: its form, its fields, and the bytes of one."""
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
    """For each message type the bytes of one message, in hexadecimal: what the tests check."""
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
    docs = _docs_of_fields(kind)
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


def _docs_of_fields(kind: type) -> dict[str, str]:
    """What stands below each field in the source; nothing for a field that says it all."""
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
    """A type, as the peer sees it."""
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
        case types.DictType():
            return "map"
    raise TypeError(f"no message had a {described} before: say how it looks on the wire")


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
    """A decoded value, in the notation of RFC 8949: byte strings are like h'00ff'."""
    if isinstance(value, bytes):
        return f"h'{value.hex()}'"
    if isinstance(value, list):
        return f"[{', '.join(map(_shown, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_shown(key)}: {_shown(one)}' for key, one in value.items())}}}"
    return msgspec.json.encode(value).decode()


def descriptions_part() -> str:
    """The keys of the description of an action."""
    return _fields(ActionInfo, "Key")


def limits_part() -> str:
    """What a server of fibaction lets a client use, if nothing else is said."""
    return _fields(Limits, "Limit")
