from __future__ import annotations

import datetime
import math
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from msgspec.msgpack import Ext

from fibaction.cli.output import yaml_text
from fibaction.cli.output.yaml_text import as_yaml

# What msgpack carries: text without lone surrogates, integers of 64 bits.
scalars = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
    | st.binary(max_size=20)
)
keys = st.text(st.characters(exclude_categories=["Cs"]), max_size=10) | st.integers(-9, 9)
values: st.SearchStrategy[Any] = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(keys, inner, max_size=5),
    max_leaves=30,
)


@given(values)
def test_any_value_is_read_again_from_its_yaml(value: Any) -> None:
    assert yaml.safe_load(as_yaml(value)) == value


@given(st.text() | st.lists(st.text(), max_size=3) | st.dictionaries(st.text(), st.text()))
def test_no_text_can_control_the_terminal(value: Any) -> None:
    assert all(c.isprintable() or c == "\n" for c in as_yaml(value))


def test_a_message_looks_as_ros_prints_it() -> None:
    value = {
        "order": 3,
        "name": "a b",
        "done": True,
        "nothing": None,
        "numbers": [0, 1],
        "pose": {"x": 1.5, "y": 2.0, "frame": "map"},
        "points": [{"x": 1, "tags": ["a"]}, [1, 2]],
        "empty": [],
        "none": {},
    }

    assert as_yaml(value, indent=4).splitlines() == [
        "    order: 3",
        "    name: a b",
        "    done: true",
        "    nothing: null",
        "    numbers:",
        "    - 0",
        "    - 1",
        "    pose:",
        "      x: 1.5",
        "      y: 2.0",
        "      frame: map",
        "    points:",
        "    - x: 1",
        "      tags:",
        "      - a",
        "    - - 1",
        "      - 2",
        "    empty: []",
        "    none: {}",
    ]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (math.nan, ".nan"),
        (math.inf, ".inf"),
        (-math.inf, "-.inf"),
        (1e300, "1.0e+300"),
        ("yes", "'yes'"),
        ("y", "y"),
        ("12", "'12'"),
        ("füñf 鳥 🤖", "füñf 鳥 🤖"),
        ("a: b", "'a: b'"),
        ("two\nlines", '"two\\nlines"'),
        ("\x1b[31m\x9b\u202e", '"\\e[31m\\x9B\\u202e"'),
        ("\U000e0001", '"\\U000E0001"'),
        (b"hi", '!!binary "aGk="'),
        (datetime.datetime(2026, 1, 2, 3, tzinfo=datetime.UTC), "2026-01-02 03:00:00+00:00"),
        (Ext(5, b"x"), "'extension 5: eA=='"),
        ((1, 2), "- 1\n- 2"),
        ({(1, 2): 3}, "(1, 2): 3"),
    ],
)
def test_each_kind_of_value_has_its_text(value: object, text: str) -> None:
    assert as_yaml(value) == text


def test_an_object_that_appears_twice_is_written_twice() -> None:
    time = datetime.datetime(2026, 1, 2)

    assert as_yaml([time, time]).splitlines() == ["- 2026-01-02 00:00:00"] * 2


def test_long_lists_texts_and_bytes_are_cut_and_say_how_much_is_left_out() -> None:
    text = as_yaml({"numbers": list(range(50_000)), "text": "x" * 5_000_000, "bytes": b"x" * 1001})
    found = yaml.safe_load(text)

    assert found["numbers"] == [*range(128), "... and 49872 more"]
    assert found["text"] == "x" * 1000 + "... and 4999000 more characters"
    assert found["bytes"].endswith("eA==... and 1 more bytes")


def test_large_maps_are_cut_and_say_how_much_is_left_out() -> None:
    found = yaml.safe_load(as_yaml({f"f{number}": 1 for number in range(1000)}))

    assert list(found) == [*(f"f{number}" for number in range(128)), "..."]
    assert found["..."] == "and 872 more"


@pytest.mark.parametrize("full", [False, True])
def test_the_number_of_all_values_is_limited(full: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(yaml_text, "MAX_VALUES_IN_FULL" if full else "MAX_VALUES", 50)
    value = [[{"a": [1, 2, 3]}] * 100] * 100

    lines = as_yaml(value, full=full).splitlines()

    assert len(lines) < 60
    assert lines[-1] == "- '... and 99 more'"


def test_in_full_nothing_is_cut() -> None:
    value = {"numbers": list(range(1000)), "text": "x" * 5000, "bytes": b"x" * 5000}

    assert yaml.safe_load(as_yaml(value, full=True)) == value


def test_a_value_that_is_too_deep_ends_at_some_level() -> None:
    value: list[Any] = []
    for _ in range(500):
        value = [value]

    assert as_yaml(value).endswith("- '... deeper than 50 levels'")
