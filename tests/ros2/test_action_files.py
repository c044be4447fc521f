"""Interface files, read without ROS, against ROS's own parser and the classes that it generates."""

from __future__ import annotations

import re
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, strategies

from fibaction.action_files import load_action
from fibaction.interfaces.definitions import FieldType, InterfaceError, MessageDefinition
from fibaction.interfaces.files import read_action
from fibaction.interfaces.parser import parse_message
from fibaction.interfaces.structs import make_structs
from fibaction_transports.ros2.convert.message_classes import message_kind
from fibaction_transports.ros2.on_rclpy.rclpy_types import RclpyTypes

_parser: Any = import_module("rosidl_adapter.parser")

SHARE = Path(sys.prefix) / "share"
ACTIONS = sorted(SHARE.glob("*/action/*.action"))
MESSAGES = sorted(SHARE.glob("*/msg/*.msg"))
PARTS = ("goal", "feedback", "result")


def name_of(path: Path) -> str:
    return f"{path.parent.parent.name}/{path.stem}"


every_action = pytest.mark.parametrize("path", ACTIONS, ids=name_of)
every_message = pytest.mark.parametrize("path", MESSAGES, ids=name_of)


def bare(schema: Any) -> Any:
    """A schema without descriptions: ROS's classes have no comments."""
    if isinstance(schema, dict):
        return {
            key: bare(value)
            for key, value in schema.items()
            if key != "description" or not isinstance(value, str)
        }
    return [bare(one) for one in schema] if isinstance(schema, list) else schema


def constants(kind: type) -> dict[str, Any]:
    found = {name: value for name, value in vars(kind).items() if name.isupper()}
    # ROS has one `byte` as bytes.
    return {name: ord(one) if isinstance(one, bytes) else one for name, one in found.items()}


def check_that_they_agree(ours: Any, theirs: Any) -> None:
    assert bare(msgspec.json.schema(ours)) == bare(msgspec.json.schema(theirs))
    assert msgspec.to_builtins(ours()) == msgspec.to_builtins(theirs())
    assert constants(ours) == constants(theirs)


def test_there_are_files_of_many_packages() -> None:
    assert {path.parent.parent.name for path in ACTIONS} >= {"test_msgs", "fibaction_test_msgs"}
    assert {path.parent.parent.name for path in MESSAGES} >= {"std_msgs", "geometry_msgs"}
    assert len(MESSAGES) > 100


@every_action
def test_a_loaded_action_is_the_one_that_ros_has(path: Path) -> None:
    action = load_action(path)
    ros = RclpyTypes().find(action.type_name)

    assert action.type_name == f"{path.parent.parent.name}/action/{path.stem}"
    for part, theirs in zip(PARTS, (ros.types[0], ros.types[1], ros.types[2]), strict=True):
        check_that_they_agree(getattr(action, part).type, theirs)
        assert bare(getattr(action.info, part)) == bare(getattr(ros.info(action.name), part))
    ros.codecs(action.info)  # raises if they do not match


@every_message
def test_a_message_is_the_one_that_ros_has(path: Path, tmp_path: Path) -> None:
    file = tmp_path / "Holder.action"
    file.write_text(f"{name_of(path)} it\n---\n---\n")
    ours = make_structs(read_action(file, search=[SHARE]))[path.stem]
    theirs = getattr(import_module(f"{path.parent.parent.name}.msg"), path.stem)

    check_that_they_agree(ours, message_kind(theirs).default)


# Against ROS's own parser: of types, names, values and comments.


def like_ros(kind: FieldType, package: str) -> str:
    """A type as ROS's parser writes it."""
    text = f"{kind.package or package}/{kind.base}" if kind.is_message else kind.base
    if kind.characters is not None:
        text += f"<={kind.characters}"
    if not kind.is_array:
        return text
    length = kind.size if kind.bound is None else f"<={kind.bound}"
    return f"{text}[{'' if length is None else length}]"


def described(found: MessageDefinition) -> Any:
    def plain(value: Any) -> Any:
        return list(value) if isinstance(value, bytes) else value

    return (
        [(like_ros(one.type, "a_msgs"), one.name, plain(one.default)) for one in found.fields],
        [(one.type, one.name, one.value) for one in found.constants],
    )


def described_by_ros(found: Any) -> Any:
    """Return what ROS's parser has read, without the escapes that its way by IDL reads."""

    def unescaped(value: Any) -> Any:
        return re.sub(r"\\(['\"])", r"\1", value) if isinstance(value, str) else value

    return (
        [(str(one.type), one.name, unescaped(one.default_value)) for one in found.fields],
        [(one.type, one.name, unescaped(one.value)) for one in found.constants],
    )


@every_message
def test_a_message_is_read_as_ros_s_parser_reads_it(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    ours, theirs = parse_message(text, path), _parser.parse_message_string("a_msgs", "It", text)

    assert described(ours) == described_by_ros(theirs)
    comments = [ours.comment, *(field.comment for field in ours.fields)]
    for comment, other in zip(comments, (theirs, *theirs.fields), strict=True):
        if "unit" not in other.annotations:  # which ROS has taken out of the comment
            assert comment.split() == " ".join(other.annotations.get("comment", ())).split()


kinds = strategies.sampled_from(
    [
        *("int8", "uint64", "byte", "bool", "float32", "string", "wstring", "string<=4"),
        *("Pose", "a/Pose"),
    ]
)
lengths = strategies.sampled_from(["", "", "[]", "[2]", "[<=3]", "[0]"])
names = strategies.sampled_from(["a", "b_c", "d2", "A", "B_1", "e__f"])
elements = strategies.sampled_from(
    [
        *("1", "-7", "300", "0x1F", "1.5", "true", "False", "word", "two words", "\\"),
        *('"one"', "'two'", '" a, b "', "'it\\'s'", '"say \\"so\\""', '""'),
    ]
)
arrays = strategies.lists(elements, max_size=4).map(lambda some: f"[{', '.join(some)}]")
# In arrays ROS makes something of quotes that do not match; that is not followed.
unmatched = strategies.sampled_from(["", '"half', "x'y", '"a"b"', "'", "[1", "[1, ]"])
values = elements | arrays | unmatched
tails = strategies.builds(
    "{}{}{}".format,
    strategies.sampled_from(["", " ", "  ", "=", " = "]),
    values,
    strategies.sampled_from(["", " ", " # more", "#"]),
)
lines = strategies.builds("{}{} {}{}".format, kinds, lengths, names, tails)


@given(lines)
def test_what_ros_s_parser_takes_is_taken_and_means_the_same(line: str) -> None:
    try:
        theirs = _parser.parse_message_string("a_msgs", "It", line)
    except Exception:  # whatever it raises for what it does not take, IndexError included
        theirs = None
    try:
        ours = parse_message(line, Path("It.msg"))
    except InterfaceError as exc:
        assert theirs is None, exc  # noqa: PT017 - no error is as good
    else:
        assert theirs is None or described(ours) == described_by_ros(theirs)


# Over ROS
