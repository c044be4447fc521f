from __future__ import annotations

from pathlib import Path

from fibaction.interfaces.definitions import FieldType, SourceLine


def test_an_error_names_the_file_the_line_and_what_was_expected() -> None:
    error = SourceLine(Path("Lift.action"), 3, "int32").error("a name", "int32")

    assert str(error) == "Lift.action:3: expected a name, found 'int32'"
    assert (error.path, error.line) == (Path("Lift.action"), 3)
    assert error.problem == "expected a name, found 'int32'"
    assert isinstance(error, ValueError)


def test_a_type_that_is_not_a_primitive_is_a_message() -> None:
    assert FieldType("Pose").is_message
    assert not FieldType("wstring").is_message
