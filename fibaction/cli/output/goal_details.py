"""Outcomes and details of goals, each asked for once, for `fibaction goals` and `fibaction top`.

Feedback and statuses arrive by themselves; a goal, its result and the reason of its end do not.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import anyio
from msgspec.structs import replace

from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.goal_table import GoalRow
from fibaction.cli.output.progress import on_one_line
from fibaction.cli.output.yaml_text import as_yaml
from fibaction.cli.process.exit_codes import message_of
from fibaction.observe.monitor import AnyClient, GoalKey, Monitor
from fibaction.words.errors import ActionError
from fibaction.words.goals import GoalID, Outcome

MOST_ENDS = 50
"""Goals whose outcomes are asked for, the newest: each is a request, and a result may be large."""
GOALS_ASKED_AT_ONCE = 10
"""Goals that are asked for at once."""
ENDS_TIMEOUT = 2.0
"""Seconds for all of them; the list is shown then, without those that have not come."""
DETAILS_TIMEOUT = 5.0
"""Seconds for a detail of one goal."""


class Outcomes:
    """The outcomes of the newest goals that have ended, each asked for once."""

    def __init__(self, most: int = MOST_ENDS) -> None:
        self._most = most
        self._known: dict[GoalID, Outcome[Any]] = {}

    async def of(
        self,
        clients: Mapping[str, AnyClient],
        rows: Sequence[GoalRow],
        timeout: float = ENDS_TIMEOUT,
    ) -> list[GoalRow]:
        """Return the rows, those of the newest goals that have ended with their outcomes."""
        newest = [row for row in rows if not row.info.status.is_active][-self._most :]
        ids = {row.info.goal_id for row in newest}
        self._known = {key: one for key, one in self._known.items() if key in ids}
        limit = anyio.CapacityLimiter(GOALS_ASKED_AT_ONCE)

        async def ask(row: GoalRow) -> None:
            client, goal_id = clients[row.action], row.info.goal_id
            try:
                async with limit:
                    raw = await client.endpoint.get_result(goal_id)
            except ActionError:
                return  # it may be forgotten by now
            self._known[goal_id] = raw.readable(client.action.result.decode)

        with anyio.move_on_after(timeout):
            async with anyio.create_task_group() as tasks:
                for row in newest:
                    if row.info.goal_id not in self._known:
                        tasks.start_soon(ask, row)
        return [with_outcome(row, self._known.get(row.info.goal_id)) for row in rows]


def with_outcome(row: GoalRow, outcome: Outcome[Any] | None) -> GoalRow:
    """Return the row with an outcome."""
    return row if outcome is None else replace(row, outcome=outcome, end=end_of(outcome))


def end_of(outcome: Outcome[Any]) -> str:
    """Return the reason; where there is none, the result on one line."""
    if outcome.reason:
        return excerpt(outcome.reason)
    return "" if outcome.result is None else excerpt(on_one_line(outcome.result))


class Detail(NamedTuple):
    """A detail as text."""

    line: str
    """On one line."""
    text: str
    """In full, with a heading; large values are cut."""


_ASKED = Detail("", "")


class DetailQuestion(NamedTuple):
    """A question about a goal, and where its answer goes."""

    what: str
    key: GoalKey
    answers: dict[GoalKey, Detail]
    ask: Callable[[GoalKey], Awaitable[Detail]]


class GoalDetails:
    """The ends of goals, and the goals as they were sent."""

    def __init__(self, monitor: Monitor, timeout: float = DETAILS_TIMEOUT) -> None:
        self._monitor = monitor
        self._timeout = timeout
        self._ends: dict[GoalKey, Detail] = {}
        self._requests: dict[GoalKey, Detail] = {}

    def end(self, key: GoalKey) -> Detail:
        """Return the reason and the result of a goal; empty until they have come."""
        return self._ends.get(key, _ASKED)

    def request(self, key: GoalKey) -> Detail:
        """Return the goal as it was sent; empty until it has come, and if it cannot be had."""
        return self._requests.get(key, _ASKED)

    def keep(self, keys: Collection[GoalKey]) -> None:
        """Forget all goals but these."""
        for details in (self._ends, self._requests):
            for key in details.keys() - set(keys):
                del details[key]

    def unknown(self, ended: Iterable[GoalKey], active: Iterable[GoalKey]) -> list[DetailQuestion]:
        """Return the questions for the ends of some goals, and for other goals as they were sent.

        Goals that were asked for before are left out; the returned questions count as asked.
        """
        wanted = [DetailQuestion("result", key, self._ends, self._ask_end) for key in ended]
        wanted += [DetailQuestion("goal", key, self._requests, self._ask_request) for key in active]
        questions = [question for question in wanted if question.key not in question.answers]
        for question in questions:
            question.answers[question.key] = _ASKED
        return questions

    async def ask(self, questions: Iterable[DetailQuestion]) -> None:
        """Ask the questions, some at once, and keep the answers."""
        limit = anyio.CapacityLimiter(GOALS_ASKED_AT_ONCE)

        async def ask(question: DetailQuestion) -> None:
            async with limit:
                question.answers[question.key] = await _answer(question, self._timeout)

        async with anyio.create_task_group() as tasks:
            for question in questions:
                tasks.start_soon(ask, question)

    async def _ask_end(self, key: GoalKey) -> Detail:
        outcome = await self._monitor.outcome(key)
        parts = [f"Reason: {excerpt(outcome.reason)}"] if outcome.reason else []
        if outcome.result is not None:
            parts.append(f"Result:\n{as_yaml(outcome.result, indent=2)}")
        return Detail(end_of(outcome), "\n".join(parts) or "There is no result.")

    async def _ask_request(self, key: GoalKey) -> Detail:
        goal = await self._monitor.request(key)
        return _ASKED if goal is None else Detail("", f"Goal:\n{as_yaml(goal, indent=2)}")


async def _answer(question: DetailQuestion, timeout: float) -> Detail:
    """Return the answer; the reason instead, if it cannot be had."""
    reason = f"there was no answer within {timeout:g} s"
    with anyio.move_on_after(timeout):
        try:
            return await question.ask(question.key)
        except ActionError as exc:
            reason = excerpt(message_of(exc))
    return Detail("", f"The {question.what} cannot be had: {reason}")
