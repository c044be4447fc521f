"""Values between JSON data and A2A, whose numbers are floats; and pages of tasks."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from a2a.types import ListTasksRequest, Task, TaskState
from google.protobuf.json_format import MessageToDict

from fibaction.schema.payload import JsonCodec
from fibaction.types.action import ActionInfo
from fibaction_transports.a2a.agent_card import Skill
from fibaction_transports.a2a.documents import data_part, has_inexact, shown_text
from fibaction_transports.a2a.task_views import AFTER_RESULT, page_of, position_of, status_of

ANY = JsonCodec({}, "result")


@pytest.mark.parametrize(
    "data", [None, True, 3, 2**53, 0.5, 1e300, "x", [1, [2]], {"a": {"b": [None]}}]
)
def test_data_comes_back_as_it_was(data: Any) -> None:
    assert MessageToDict(data_part(ANY, msgspec.msgpack.encode(data)).data) == data


def test_a_whole_number_that_is_too_large_is_told_as_text() -> None:
    part = data_part(ANY, msgspec.msgpack.encode({"a": [2**60, True, -(2**60)]}))
    told = {"a": ["1152921504606846976", True, "-1152921504606846976"]}
    assert MessageToDict(part.data) == told


def test_what_a2a_cannot_carry_is_a_text() -> None:
    deep: list[Any] = []
    for _ in range(300):
        deep = [deep]
    assert data_part(ANY, msgspec.msgpack.encode(deep)).text.startswith("[[[")
    assert data_part(ANY, b"\xc1").text.startswith("the message cannot be shown: ")


def test_a_result_is_a_text_for_models_unless_it_is_long() -> None:
    texts = [shown_text(ANY, msgspec.msgpack.encode(one)) for one in ("x", {"a": 1}, "x" * 10_001)]
    assert texts == ["x", '{"a":1}', ""]


def test_inexact_numbers_are_found() -> None:
    assert has_inexact({"a": [1, 2**53]})
    assert not has_inexact({"a": [1, 2.0**60, True, "x"]})


def test_positions_are_in_the_order_of_the_updates() -> None:
    assert position_of("17") == (1, 17)
    assert AFTER_RESULT == position_of("result") > position_of("2.1") > position_of("17")


class _Connection:
    def endpoint(self, info: ActionInfo) -> None:
        """Return nothing: no goal is sent."""


@pytest.mark.parametrize(
    ("schema", "examples", "text"),
    [
        ({"type": "string", "description": "A word."}, ['""'], " A word. "),
        ({"type": "object", "x": "y" * 4000}, ["{}"], "Send a goal to the action a."),
    ],
)
def test_a_skill_tells_what_its_goals_are(
    schema: dict[str, Any], examples: list[str], text: str
) -> None:
    info = ActionInfo("a", goal=schema, feedback={}, result={})
    skill: Any = Skill("", info, _Connection(), "a")  # type: ignore[arg-type]  # it is not called
    told = skill.in_card(is_asked=False)
    assert list(told.examples) == examples
    assert text in told.description
    assert ("yyyy" in told.description) is False


def tasks(*seconds: int) -> list[Task]:
    state = TaskState.TASK_STATE_WORKING
    return [Task(id=f"{n}", context_id="c", status=status_of(state, n)) for n in seconds]


def test_pages_have_each_task_once_the_newest_first() -> None:
    all_of_them = tasks(3, 1, 2, 5, 4)
    found, request = list[str](), ListTasksRequest(page_size=2)
    for _ in range(3):
        page = page_of(all_of_them, request)
        found += [task.id for task in page.tasks]
        assert page.total_size == 5
        request.page_token = page.next_page_token
    assert found == ["5", "4", "3", "2", "1"]
    assert page.next_page_token == ""


def test_tasks_are_listed_by_context_state_and_time() -> None:
    assert len(page_of(tasks(1, 2), ListTasksRequest(context_id="c")).tasks) == 2
    assert not page_of(tasks(1, 2), ListTasksRequest(context_id="d")).tasks
    failed = ListTasksRequest(status=TaskState.TASK_STATE_FAILED)
    assert not page_of(tasks(1, 2), failed).tasks
    late = ListTasksRequest()
    late.status_timestamp_after.FromMilliseconds(2000)
    assert [task.id for task in page_of(tasks(1, 2, 3), late).tasks] == ["3", "2"]
