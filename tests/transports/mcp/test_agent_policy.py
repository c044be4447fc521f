"""The rules for what a model may do."""

from __future__ import annotations

import math
from typing import Any

import pytest

from fibaction_transports.mcp import AgentPolicy


@pytest.mark.parametrize(
    ("pattern", "server", "action", "matches"),
    [
        ("drive", "", "drive", True),
        ("drive", "", "/drive", True),
        ("/drive", "", "drive", True),
        ("drive", "", "drives", False),
        ("drive", "", "Drive", False),
        ("arm/*", "", "arm/drive/far", True),
        ("arm/*", "", "leg/drive", False),
        ("drive", "left", "drive", True),
        ("left:drive", "left", "drive", True),
        ("left:drive", "right", "drive", False),
        ("left:*", "", "drive", False),
        ("left/*", "left", "drive", False),
    ],
)
def test_a_pattern_names_actions(pattern: str, server: str, action: str, matches: bool) -> None:
    assert AgentPolicy(allow=(pattern,)).allows(server, action) is matches
    assert AgentPolicy(unasked=(pattern,)).asks(server, action) is not matches


def test_patterns_may_come_from_a_generator() -> None:
    patterns: Any = (each for each in ("arm/*", "look"))
    policy = AgentPolicy(allow=patterns)
    assert [policy.allows("", each) for each in ("look", "arm/a", "leg")] == [True, True, False]


@pytest.mark.parametrize("patience", [0, -1, math.inf, math.nan])
def test_the_patience_is_a_number_of_seconds(patience: float) -> None:
    with pytest.raises(ValueError, match="patience must be finite"):
        AgentPolicy(patience=patience)


def test_an_empty_pattern_is_an_error() -> None:
    with pytest.raises(ValueError, match="cannot be empty"):
        AgentPolicy(allow=("",))
