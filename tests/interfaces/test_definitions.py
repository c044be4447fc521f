from __future__ import annotations

from pathlib import Path

from fibaction.interfaces.definitions import FieldType, InterfaceError, Line

LINE = Line(Path("Lift.action"), 3, "int32")


def test_an_error_says_the_file_the_line_and_what_was_expected() -> None:
    error = LINE.expected("a name", "int32")

    assert str(error) == "Lift.action:3: expected a name, found 'int32'"
    assert error.path == Path("Lift.action")
    assert error.line == 3
    assert error.problem == "expected a name, found 'int32'"


def test_an_error_is_a_value_error() -> None:
    assert issubclass(InterfaceError, ValueError)


def test_a_type_that_is_no_primitive_is_a_message() -> None:
    assert FieldType("Pose").is_message
    assert not FieldType("wstring").is_message
