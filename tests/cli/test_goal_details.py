"""The details of goals for `top`: each is asked for once, and an answer that fails says why."""

from __future__ import annotations

from typing import Any

import anyio
import pytest

from fibaction import ConnectionLost, GoalID, GoalStatus, Outcome
from fibaction.cli.output.goal_details import Detail, GoalDetails
from fibaction.observe.monitor import GoalKey, Monitor

pytestmark = pytest.mark.asyncio
ONE, TWO = (GoalKey("pick", GoalID(bytes([number]) * 16)) for number in (1, 2))


class Answering(Monitor):
    """A monitor with fixed answers; an exception is raised, and None never comes."""

    def __init__(self, outcome: Any = None, request: Any = None) -> None:
        super().__init__()
        self.answers = {"outcome": outcome, "request": request}
        self.asked: list[GoalKey] = []

    async def outcome(self, key: GoalKey) -> Outcome[Any]:
        answer: Outcome[Any] = await self._answer(key, "outcome")
        return answer

    async def request(self, key: GoalKey) -> Any:
        return await self._answer(key, "request")

    async def _answer(self, key: GoalKey, name: str) -> Any:
        self.asked.append(key)
        answer = self.answers[name]
        if isinstance(answer, Exception):
            raise answer
        if answer is Ellipsis:
            await anyio.sleep_forever()
        return answer


@pytest.mark.parametrize(
    ("outcome", "expected"),
    [
        (
            Outcome(GoalStatus.ABORTED, {"meters": 2}, "stuck\x1b"),
            Detail("stuck\\x1b", "Reason: stuck\\x1b\nResult:\n  meters: 2"),
        ),
        (Outcome(GoalStatus.SUCCEEDED, 0), Detail("0", "Result:\n  0")),
        (Outcome(GoalStatus.CANCELED), Detail("", "There is no result.")),
        (ConnectionLost("it is dead"), Detail("", "The result cannot be had: it is dead")),
        (..., Detail("", "The result cannot be had: there was no answer within 0.01 s")),
    ],
)
async def test_the_end_of_a_goal_is_its_reason_and_its_result(
    outcome: Any, expected: Detail
) -> None:
    timeout = 0.01 if outcome is Ellipsis else 10
    details = GoalDetails(Answering(outcome), timeout)
    await details.ask(details.unknown([ONE], []))

    assert details.end(ONE) == expected
    assert details.end(TWO) == Detail("", "")


@pytest.mark.parametrize(
    ("request_", "text"),
    [
        ({"order": 3}, "Goal:\n  order: 3"),
        (None, ""),
        (ConnectionLost("it is dead"), "The goal cannot be had: it is dead"),
    ],
)
async def test_a_goal_is_shown_as_it_was_sent(request_: Any, text: str) -> None:
    details = GoalDetails(Answering(request=request_))
    await details.ask(details.unknown([], [ONE]))

    assert details.request(ONE).text == text


async def test_each_detail_is_asked_for_once_until_its_goal_is_forgotten() -> None:
    monitor = Answering(Outcome(GoalStatus.CANCELED), 1)
    details = GoalDetails(monitor)
    questions = details.unknown([ONE, TWO], [TWO])
    assert details.unknown([ONE, TWO], [TWO]) == []
    await details.ask(questions)
    details.keep([TWO])
    assert [question.key for question in details.unknown([ONE, TWO], [TWO])] == [ONE]

    assert sorted(monitor.asked) == [ONE, TWO, TWO]
