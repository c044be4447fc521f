"""`cancel`: of one goal and of many, as processes and in this process."""

from __future__ import annotations

import datetime
import json

import anyio
import pytest

from fibaction import (
    ConnectionLost,
    GoalID,
    connect,
    serve,
)
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import levers
from fibaction.cli.verbs.levers import cancel_many
from tests.cli.conftest import Invoke, Run, detached
from tests.cli.robot import WAIT
from tests.cli.served import Altered, counter

ID = GoalID(b"\x01" * 16)


@pytest.fixture(autouse=True)
def quiet(request: pytest.FixtureRequest) -> None:
    """Cancel the goals that other tests have left."""
    if {"url", "tcp"} & set(request.fixturenames):
        anyio.run(cancel_all, request.getfixturevalue("robot").tcp)


async def cancel_all(url: str) -> None:
    async with connect(url, WAIT) as client:
        answer = await client.cancel_goals()
        for info in answer.goals_canceling:
            await (await client.attach(info.goal_id)).outcome()


def test_the_beginning_of_an_id_is_enough_to_cancel(here: Run, url: str) -> None:
    goal_id = detached(here, url, "wait")
    done = here("cancel", goal_id[:8], url=url)
    again = here("cancel", "wait", goal_id, url=url)

    assert done == (0, f"Canceling the goal {goal_id} of /wait\n", "")
    assert again.code == ExitCode.ABORTED
    assert again.err in (  # it takes a moment to end
        f"The goal {goal_id} of /wait is not canceled: it has ended already\n",
        "",
    )


def test_all_goals_are_canceled_and_rejections_are_reported(here: Run, url: str) -> None:
    first, second = (detached(here, url, "wait") for _ in range(2))
    third = detached(here, url, "stubborn", "{seconds: 3}")
    done = here("cancel", "--all", url=url)

    assert done.code == ExitCode.ABORTED
    assert sorted(done.lines) == sorted(
        f"Canceling the goal {one} of /wait" for one in (first, second)
    )
    assert f"The goal {third} of /stubborn is not canceled: it is never canceled" in done.err


def test_with_before_later_goals_go_on(here: Run, url: str) -> None:
    def stamp(goal_id: str) -> int:
        goals = here("goals", "wait", "--json", url=url).json
        return int(next(goal["stamp"] for goal in goals if goal["goal_id"] == goal_id))

    early, late = (detached(here, url, "wait") for _ in range(2))
    done = here("cancel", "wait", "--before", str(stamp(early)), "--json", url=url)

    assert done.code == 0
    assert done.json == [{"action": "wait", "goal_id": early, "canceling": True, "reason": ""}]
    when = datetime.datetime.fromtimestamp(stamp(late) / 1e9 + 1).isoformat()
    assert late in here("cancel", "--before", when, url=url).out


def test_no_goal_to_cancel_is_what_was_wanted(invoke: Invoke, tcp: str) -> None:
    result = invoke("cancel", "wait", "--all", url=tcp)

    assert result.exit_code == 0
    assert (result.stdout, result.stderr) == ("", "There is no goal to cancel.\n")


@pytest.mark.asyncio
async def test_a_server_that_is_lost_does_not_delay_the_others(
    capsys: pytest.CaptureFixture[str],
) -> None:
    async def lose(*_: object) -> None:
        raise ConnectionLost("the line is dead")

    lost, other = Altered(counter("a"), cancel_goals=lose), counter("b")
    url = "inproc://cancel"
    async with serve([lost, other], url), connect(url, other.action) as client:
        await client.send_goal(1, goal_id=ID)
        assert await cancel_many(url, None, None, as_json=True) == ExitCode.UNREACHABLE

    out, err = capsys.readouterr()
    assert json.loads(out)["canceling"] is True
    assert err == "The goals of /a are not canceled: the line is dead\n"


def test_a_stamp_is_nanoseconds_or_a_time() -> None:
    def stamp(text: str) -> int:
        return levers._Stamp().convert(text, None, None)

    assert stamp("1795250042441581238") == 1795250042441581238
    assert stamp("1970-01-01T00:00:02.5Z") == 2_500_000_000
    local = datetime.datetime(2026, 1, 31, 12)
    assert stamp("2026-01-31T12:00") == int(local.timestamp()) * 10**9
