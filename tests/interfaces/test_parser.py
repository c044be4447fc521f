from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, strategies

from fibaction.interfaces.definitions import FieldType, InterfaceError, MessageDefinition
from fibaction.interfaces.parser import parse_action, parse_message
from fibaction.interfaces.ros_types import PRIMITIVES

FILE = Path("Lift.msg")


def parse(text: str) -> MessageDefinition:
    return parse_message(text, FILE)


def error(text: str) -> str:
    with pytest.raises(InterfaceError) as caught:
        parse(text)
    return str(caught.value)


def comments(text: str) -> dict[str, str]:
    """Return the comments on the message, under an empty name, and on its fields and constants."""
    found = parse(text)
    fields = {field.name: field.comment for field in found.fields}
    return {"": found.comment, **fields, **{one.name: one.comment for one in found.constants}}


@pytest.mark.parametrize(
    "text",
    [
        "int33", "Int32[", "int32]", "int32[-1]", "int32[0]", "int32[<=]", "int32[<3]",
        "string<=0", "string<=", "a/b/Pose", "geometry_msgs/pose", "Geometry/Pose", "pkg_/Pose",
        "/Pose", "int32[9999999999]", "int32[2][2]",
    ],
)  # fmt: skip
def test_an_invalid_type_is_rejected(text: str) -> None:
    assert error(f"# x\n{text} name") == (
        "Lift.msg:2: expected a type like 'int32', 'string<=10', 'float64[3]' or"
        f" 'geometry_msgs/Pose', found {text!r}"
    )


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("time stamp", "1: expected 'builtin_interfaces/Time', found 'time'"),
        (
            "int32<=5 x",
            "1: expected '<=' behind a string only, or within '[]', found 'int32<=5'",
        ),
        (
            "Pose pose 1",
            "1: expected no default, because messages have their own, found '1'",
        ),
        (
            "int32 a\n\nint32\n",
            "3: expected a type and a name, like 'int32 order', found 'int32'",
        ),
        (
            "int8 a\nint8 b\nint8 a",
            "3: expected a unique name, found 'a', which line 1 defines",
        ),
        (
            "int8 A=1\nint8 A=1",
            "2: expected a unique name, found 'A', which line 1 defines",
        ),
    ],
)
def test_an_invalid_line_is_rejected_with_what_was_expected(text: str, problem: str) -> None:
    assert error(text) == f"Lift.msg:{problem}"


@pytest.mark.parametrize("name", ["Order", "2nd", "a__b", "a_", "_a", "größe", "a.b"])
def test_an_invalid_field_name_is_rejected(name: str) -> None:
    assert error(f"int32 {name}") == (
        "Lift.msg:1: expected a field's name, like 'frame_id' (lower case, no '__'),"
        f" found {name!r}"
    )


def test_a_constant_has_a_type_a_name_and_a_value() -> None:
    found = parse('int8 MOST=-0x10\nstring WHO = "a b"\nfloat32 PI_2 =1.5').constants

    assert [(one.type, one.name, one.value) for one in found] == [
        ("int8", "MOST", -16),
        ("string", "WHO", "a b"),
        ("float32", "PI_2", 1.5),
    ]


@pytest.mark.parametrize("name", ["most", "MOST_", "A__B", "_A", "A b"])
def test_an_invalid_constant_name_is_rejected(name: str) -> None:
    assert error(f"int8 {name} = 1") == (
        f"Lift.msg:1: expected a constant's name, like 'MAX_SPEED', before the '=', found {name!r}"
    )


@pytest.mark.parametrize("kind", ["int8[]", "string<=5", "Pose"])
def test_a_constant_that_is_not_a_primitive_is_rejected(kind: str) -> None:
    assert error(f"{kind} A = 1") == (
        f"Lift.msg:1: expected a constant's type, like 'int32' or 'string', found {kind!r}"
    )


@pytest.mark.parametrize("line", ["--- ", " ---", "---\t"])
def test_blanks_around_a_separator_are_an_error(line: str) -> None:
    with pytest.raises(
        InterfaceError, match=r"Lift\.action:2: expected a line '---' without blanks"
    ):
        parse_action(f"int32 a\n{line}\n---\n", Path("Lift.action"))


def test_a_type_with_its_folder_gets_a_hint() -> None:
    assert error("geometry_msgs/msg/Pose pose") == (
        "Lift.msg:1: expected 'geometry_msgs/Pose', without 'msg', found 'geometry_msgs/msg/Pose'"
    )


def test_comments_describe_the_field_beside_them() -> None:
    text = (
        "# The message,\n"
        "#   and more of it.\n"
        "\n"
        "# Above.\n"
        "int32 a # Behind.\n"
        "  # Below.\n"
        "\n"
        "## Before a gap,\n"
        "\n"
        "# and after.\n"
        "int32 MOST=1\n"
        "int32 b\n"
        "# Describes nothing.\n"
    )

    assert comments(text) == {
        "": "The message,\n  and more of it.",
        "a": "Above.\nBehind.\nBelow.",
        "MOST": "Before a gap,\nand after.",
        "b": "",
    }


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", {"": ""}),
        ("# Nothing to say.", {"": "Nothing to say."}),
        ("\n  # lost\nint32 a", {"": "", "a": ""}),
        ("# a\0b\x1b[1mc", {"": "a b [1mc"}),
    ],
    ids=["no comment", "comments only", "indented above all fields", "control characters"],
)
def test_comments_at_the_edges_of_the_rule(text: str, expected: dict[str, str]) -> None:
    assert comments(text) == expected


@pytest.mark.parametrize(
    ("text", "fields"),
    [
        ("int32 order 5\nint32[<=2] few [1, 2]", [("order", 5, ""), ("few", [1, 2], "")]),
        ("int32\ta\t5\r\nint32 b\r\n", [("a", 5, ""), ("b", None, "")]),
        ('string a "x # y"', [("a", '"x', 'y"')]),
    ],
    ids=["a bounded array", "tabs and line ends of Windows", "a comment within quotes, as in ROS"],
)
def test_a_field_has_a_name_a_default_and_a_comment(
    text: str, fields: list[tuple[str, object, str]]
) -> None:
    assert [(one.name, one.default, one.comment) for one in parse(text).fields] == fields


def test_an_action_is_a_goal_a_result_and_a_feedback() -> None:
    text = "# The goal.\nint32 a\n---\n# The result.\nint32 a\n---\nint32 a\n"
    goal, result, feedback = parse_action(text, Path("Lift.action"))

    found = [
        (part.name, part.fields[0].name, part.fields[0].line, part.comment)
        for part in (goal, result, feedback)
    ]
    assert found == [
        ("Lift_Goal", "a", 2, "The goal."),
        ("Lift_Result", "a", 5, "The result."),
        ("Lift_Feedback", "a", 7, ""),
    ]


@pytest.mark.parametrize(
    ("text", "line", "count"),
    [("", 1, 0), ("int32 a\n---\nint32 b", 3, 1), ("---\n---\nint32 a\n---\n", 4, 3)],
)
def test_an_action_without_three_parts_is_rejected(text: str, line: int, count: int) -> None:
    with pytest.raises(InterfaceError) as caught:
        parse_action(text, Path("Lift.action"))

    assert str(caught.value) == (
        f"Lift.action:{line}: expected two lines '---', between goal and result and between"
        f" result and feedback, found {count}"
    )


names = strategies.from_regex(r"[a-z](_?[a-z0-9]){0,5}", fullmatch=True)
messages = strategies.from_regex(r"[A-Z][A-Za-z0-9]{0,5}", fullmatch=True)


@strategies.composite
def types(draw: strategies.DrawFn) -> FieldType:
    base = draw(strategies.sampled_from(sorted(PRIMITIVES)) | messages)
    package = "" if base in PRIMITIVES else draw(strategies.just("") | names)
    lengths = strategies.integers(1, 10**6)
    characters = draw(strategies.none() | lengths) if "string" in base else None
    is_array = draw(strategies.booleans())
    size = draw(strategies.none() | lengths) if is_array else None
    bound = draw(strategies.none() | lengths) if is_array and size is None else None
    return FieldType(base, package, characters, is_array, size, bound)


def written(kind: FieldType) -> str:
    text = f"{kind.package}/{kind.base}" if kind.package else kind.base
    if kind.characters is not None:
        text += f"<={kind.characters}"
    if kind.size is not None:
        return f"{text}[{kind.size}]"
    if kind.bound is not None:
        return f"{text}[<={kind.bound}]"
    return f"{text}[]" if kind.is_array else text


@given(types(), names)
def test_any_field_is_read_again_from_its_text(kind: FieldType, name: str) -> None:
    (field,) = parse(f"{written(kind)} {name}").fields

    assert (field.type, field.name, field.default) == (kind, name, None)


pieces = strategies.sampled_from(
    ["int32", "string", "<=", "[", "]", "3", " ", "\t", "a", "A", "=", "#", '"', "'", "---", "\n"]
)


@given(strategies.text() | strategies.lists(pieces).map("".join))
def test_any_text_is_a_message_or_an_error_with_a_line(text: str) -> None:
    try:
        parse(text)
    except InterfaceError as exc:
        assert 1 <= exc.line <= len(text.splitlines())  # noqa: PT017 - no error is as good
