from __future__ import annotations

import ast

import pytest
from hypothesis import given, strategies

from fibaction.interfaces.layout import WIDTH, Group, Text, broken, flat, laid_out, quoted

LONG = "word " * 30


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("plain", '"plain"'),
        ("it's", '"it\'s"'),
        ('a "b"', "'a \"b\"'"),
        ('it\'s "b"', "'it\\'s \"b\"'"),
        ("'it's' \"b\"", '"\'it\'s\' \\"b\\""'),
        ("back\\slash", '"back\\\\slash"'),
    ],
)
def test_a_string_has_the_quotes_that_take_fewer_backslashes(text: str, expected: str) -> None:
    assert quoted(text) == expected


@given(strategies.text())
def test_any_quoted_string_is_that_string(text: str) -> None:
    assert ast.literal_eval(quoted(text)) == text


def test_what_fits_is_in_one_line() -> None:
    group = Group("f(", ["1", Group("g(", ["2"], ")"), Text("x=", "3")], ")")

    assert flat(group) == 'f(1, g(2), x="3")'
    assert laid_out("y = ", group, ",", 4) == ['    y = f(1, g(2), x="3"),']


def test_a_group_that_does_not_fit_has_a_line_for_each_item() -> None:
    name = "n" * 40
    group = Group("f(", [name, Group("g(", [name, name], ")")], ")")

    assert laid_out("y = ", group, "", 4) == [
        "    y = f(",
        f"        {name},",
        "        g(",
        f"            {name},",
        f"            {name},",
        "        ),",
        "    )",
    ]


def test_a_group_can_be_broken_that_would_fit() -> None:
    assert broken("y = ", Group("f(", ["1"], ")"), "", 0) == ["y = f(", "    1,", ")"]


def test_a_name_that_does_not_fit_is_left_as_it_is() -> None:
    assert laid_out("y = ", "n" * 100, "", 0) == [f"y = {'n' * 100}"]


def test_nothing_is_gained_by_breaking_an_empty_string() -> None:
    assert laid_out(f"{'n' * 100} = ", Text("", ""), "", 0) == [f'{"n" * 100} = ""']


def test_a_string_that_fits_into_a_line_of_its_own_is_not_broken() -> None:
    text = "one\n" + "w" * 76

    assert laid_out("order = ", Text("", text), "", 0) == ["order = (", f"    {quoted(text)}", ")"]


def test_a_string_is_broken_at_its_lines_and_between_words() -> None:
    assert laid_out("y = ", Text("x=", f"one\n\n{LONG}"), "", 0) == [
        "y = x=(",
        '    "one\\n"',
        '    "\\n"',
        f'    "{"word " * 15}word"',
        f'    "{" word" * 14} "',
        ")",
    ]


@given(strategies.text(), strategies.integers(0, 40))
def test_any_broken_string_is_that_string(text: str, indent: int) -> None:
    text = f"{LONG}{text}"
    lines = laid_out("", Text("", text), "", indent)

    assert ast.literal_eval("\n".join(line[indent:] for line in lines)) == text
    assert all(len(line) <= WIDTH for line in lines[1 : len(LONG) // WIDTH])
