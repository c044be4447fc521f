"""`fibaction.words.progress`: how far a goal has come, and the mark of a result."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import pydantic
import pytest

from fibaction import Progress, Return
from fibaction.words.progress import ProgressMeter
from tests.support.progress_cases import CASES


@dataclass
class Copied:
    completed: int
    total: int


class Model(pydantic.BaseModel):
    percent: float


def fraction_of(meter: ProgressMeter, feedback: Any) -> float | None:
    progress = meter.read(feedback)
    return None if progress is None else progress.fraction


@pytest.mark.parametrize(("feedbacks", "fractions"), CASES)
def test_fields_of_the_feedback_tell_how_far(
    feedbacks: list[Any], fractions: list[float | None]
) -> None:
    meter = ProgressMeter()
    assert [fraction_of(meter, feedback) for feedback in feedbacks] == fractions


def test_the_first_field_that_tells_counts() -> None:
    meter = ProgressMeter()
    assert meter.read({"fraction": 0.25, "percent": 99}) == Progress(0.25, 1)
    assert [*meter.fields] == ["fraction"]
    assert meter.read({"fraction": 0.25, "done": 1, "total": 2}) == Progress(1, 2)
    assert [*meter.fields] == ["done", "total"]


def test_objects_of_all_kinds_are_read_by_their_fields() -> None:
    meter = ProgressMeter()
    assert meter.read(Progress(1, 4, "wash")) == Progress(1, 4, "wash")
    assert meter.read(Progress(1, text="wash")) == Progress(1, None, "wash")
    assert meter.read(Copied(3, 4)) == Progress(3, 4)
    assert meter.read(Model(percent=20)) == Progress(20, 100)


@pytest.mark.parametrize(
    "feedback",
    [{"progress": True}, {"progress": "half"}, {"done": "1", "total": 2}, [1], 5, None, "text", {}],
)
def test_other_feedback_tells_nothing(feedback: object) -> None:
    meter = ProgressMeter()
    meter.read({"percent": 1})
    assert (meter.read(feedback), meter.fields) == (None, ())


def test_a_text_of_another_type_is_none() -> None:
    assert ProgressMeter().read({"done": 1, "total": 2, "text": 5}) == Progress(1, 2)


def test_the_counts_and_the_text_are_a_label() -> None:
    assert Progress(3, 10, "unpacking").label == "3/10 unpacking"
    assert Progress(0.5).label == "0.5"


def test_a_number_that_is_not_finite_is_no_progress_and_no_total() -> None:
    meter = ProgressMeter()
    assert meter.read({"done": math.inf, "total": 4}) is None
    assert meter.read({"percent": math.nan}) is None
    assert meter.read({"done": 1, "total": math.inf}) == Progress(1)


def test_it_shows_the_value_that_it_marks() -> None:
    assert repr(Return([1])) == "Return([1])"
    assert Return("x").value == "x"
