"""Feedback of one goal after the other, and how far the goal is by the rule for progress.

The rule is there twice, in Python and in the console, and both are tested with this table.
"""

from __future__ import annotations

from typing import Any

CASES: list[tuple[list[dict[str, Any]], list[float | None]]] = [
    ([{"done": 3, "total": 12, "text": ""}, {"done": 12, "total": 12, "text": "x"}], [0.25, 1.0]),
    ([{"done": 3, "total": None, "text": ""}], [None]),
    ([{"done": 3, "total": 0, "text": ""}, {"done": 3, "total": -4, "text": ""}], [None, None]),
    ([{"done": 15, "total": 10}, {"done": -1, "total": 10}], [1.0, 0.0]),
    ([{"file": "a", "completed": 1, "total": 2}], [0.5]),
    ([{"current": 1, "total": 2}], [0.5]),
    ([{"progress": 3, "total": 4}], [0.75]),
    ([{"done": 1}], [None]),
    ([{"total": 4}], [None]),
    ([{"percent": 50}], [0.5]),
    ([{"percent_complete": 0.5}], [0.005]),
    ([{"progress": 0.25}, {"progress": 1.0}], [0.25, 1.0]),
    ([{"progress": 1}, {"progress": 2}, {"progress": 1}], [1.0, 0.02, 0.01]),
    ([{"progress": 120}], [1.0]),
    ([{"progress": -1}], [0.0]),
    ([{"step": 1}], [None]),
]
