from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, strategies

from fibaction.interfaces.definitions import FieldType, InterfaceError, SourceLine
from fibaction.interfaces.parser import read_single, read_value

LINE = SourceLine(Path("Lift.action"), 3, "")


def value(base: str, text: str, **settings: Any) -> Any:
    return read_value(LINE, FieldType(base, **settings), text)


def error(base: str, text: str, **settings: Any) -> str:
    with pytest.raises(InterfaceError) as caught:
        value(base, text, **settings)
    assert caught.value.line == 3
    return caught.value.problem


@pytest.mark.parametrize(
    ("base", "text", "expected"),
    [
        ("bool", "true", True),
        ("bool", "False", False),
        ("bool", "1", True),
        ("bool", "0", False),
        ("int32", "-0x10", -16),
        ("int8", "-128", -128),
        ("uint64", "18446744073709551615", 2**64 - 1),
        ("byte", "0b11", 3),
        ("char", "255", 255),
        ("int32", "007", 7),
        ("float32", "1", 1.0),
        ("float64", "-2.5e-3", -0.0025),
        ("string", "bare words", "bare words"),
        ("string", '"  with spaces "', "  with spaces "),
        ("wstring", "'it\\'s'", "it's"),
        ("string", '"it\'s \\"said\\""', 'it\'s "said"'),
        ("string", '"', ""),
        ("string", "'tis", "'tis"),
        ("string", "", ""),
        # As rosidl_adapter, rosidl_parser and rosidl_generator_py of Kilted read them.
        ("string", r'"x\ty"', "x\ty"),
        ("string", r'"x\\y"', "x\\y"),
        ("string", r'"x\\\\y"', "x\\y"),
        ("string", r'"tab\\tno"', "tab\tno"),
        ("string", r'"\x41\101"', "AA"),
    ],
)
def test_a_single_value_is_read_as_ros_reads_it(base: str, text: str, expected: object) -> None:
    found = value(base, text)

    assert found == expected
    assert type(found) is type(expected)


@pytest.mark.parametrize(
    ("base", "text", "problem"),
    [
        ("bool", "yes", "expected 'true' or 'false', found 'yes'"),
        ("int8", "128", "expected int8 from -128 to 127, found '128'"),
        ("uint16", "-1", "expected uint16 from 0 to 65535, found '-1'"),
        ("byte", "256", "expected byte from 0 to 255, found '256'"),
        (
            "uint64",
            "18446744073709551616",
            "expected uint64 from 0 to 18446744073709551615, found '18446744073709551616'",
        ),
        ("int32", "1.5", "expected int32 from -2147483648 to 2147483647, found '1.5'"),
        ("float32", "fast", "expected a float32, like '1.5', found 'fast'"),
        ("float64", "nan", "expected a float64, like '1.5', found 'nan'"),
        ("float64", "1e999", "expected a float64, like '1.5', found '1e999'"),
        ("string", '"a"b"', 'expected \\" for a quote within a string, found \'"a"b"\''),
    ],
)
def test_an_invalid_value_is_rejected(base: str, text: str, problem: str) -> None:
    assert error(base, text) == problem


@pytest.mark.parametrize(
    ("base", "text", "expected"),
    [
        ("int32", "[]", []),
        ("int32", "[1, -2,3 ]", [1, -2, 3]),
        ("bool", "[true,false]", [True, False]),
        ("uint8", "[1, 255]", b"\x01\xff"),
        ("byte", "[]", b""),
        ("char", "[65]", b"A"),
        ("string", "[\"one\", 'two', three ]", ["one", "two", "three"]),
        ("string", '["a, b", "c"]', ["a, b", "c"]),
        ("string", '["say \\"so\\"", \'it\\\'s\']', ['say "so"', "it's"]),
        ("string", "[]", []),
        # As Kilted's tools read them.
        ("string", r'["a\tb", "c\\d"]', ["a\tb", "c\\d"]),
        ("string", r'["\\\"", "*"]', ['\\"",', '*"']),
    ],
)
def test_an_array_is_read_as_ros_reads_it(base: str, text: str, expected: object) -> None:
    assert value(base, text, is_array=True) == expected


@pytest.mark.parametrize(
    ("text", "settings", "problem"),
    [
        ("1, 2", {}, "expected an array like '[1, 2]', found '1, 2'"),
        ("[1, 2", {}, "expected an array like '[1, 2]', found '[1, 2'"),
        ("[1, ]", {}, "expected int8 from -128 to 127, found ''"),
        ("[1]", {"size": 2}, "expected 2 elements, found '[1]'"),
        ("[1, 2]", {"bound": 1}, "expected at most 1 elements, found '[1, 2]'"),
    ],
)
def test_an_invalid_array_is_rejected(text: str, settings: dict[str, int], problem: str) -> None:
    assert error("int8", text, is_array=True, **settings) == problem


def test_a_size_a_bound_and_a_length_are_limits() -> None:
    assert value("int8", "[1, 2]", is_array=True, size=2) == [1, 2]
    assert value("int8", "[1, 2]", is_array=True, bound=2) == [1, 2]
    assert value("string", '"four"', characters=4) == "four"


def test_invalid_strings_are_rejected() -> None:
    too_long = "expected a string of at most 4 characters, found 'fives'"

    assert error("string", "fives", characters=4) == too_long
    assert error("string", '["fives"]', is_array=True, characters=4) == too_long
    assert error("string", '["a", ,"b"]', is_array=True) == (
        'expected strings like \'["one", "two"]\', found \',"b"\''
    )
    assert error("string", '["a", "b]', is_array=True) == (
        'expected strings like \'["one", "two"]\', found \'"b\''
    )


@given(strategies.text(strategies.characters(exclude_characters="\\")))
def test_any_quoted_string_is_read(text: str) -> None:
    quoted = '"' + text.replace('"', '\\"') + '"'

    assert read_single(LINE, FieldType("string"), quoted) == text


@given(strategies.lists(strategies.floats(allow_nan=False, allow_infinity=False)))
def test_any_array_of_numbers_is_read(numbers: list[float]) -> None:
    assert value("float64", json.dumps(numbers), is_array=True) == numbers


@given(
    strategies.text(),
    strategies.sampled_from(["bool", "byte", "int8", "uint64", "float32", "string"]),
    strategies.booleans(),
)
def test_any_text_is_a_value_or_an_error(text: str, base: str, is_array: bool) -> None:
    try:
        value(base, text, is_array=is_array)
    except InterfaceError as exc:
        assert exc.problem.startswith("expected ")  # noqa: PT017 - no error is as good
