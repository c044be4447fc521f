"""The command line over a fleet: the same commands, at workers on a broker of their own."""

from __future__ import annotations

import subprocess
from collections.abc import AsyncGenerator, Callable, Generator
from typing import Any, TypeAlias

import anyio
import msgspec
import pytest

from fibaction import Action, ActionServer, GoalHandle, connect, serve
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs.list_goals import Form, list_goals
from tests.cli.conftest import Run, Start, detached, running
from tests.support.nats_server import IS_LEFT_OUT, nats_server
from tests.support.processes import ended, lines_until

GOAL = ("wait", "{seconds: 60, steps: 600}")

StartWorker: TypeAlias = "Callable[[str], subprocess.Popen[str]]"
"""Starts a worker at the URL of its fleet."""


@pytest.fixture(scope="module")
def broker() -> Generator[str, None, None]:
    """The URL of a fleet without workers."""
    if IS_LEFT_OUT:
        pytest.skip("nats-server is not installed: see the extra `broker`")
    with nats_server() as server:
        yield server.url("robots")


@pytest.fixture(scope="module")
def start_worker() -> Generator[StartWorker, None, None]:
    with running() as run:
        yield lambda url: run("tests.cli.robot", url, until="nats://")[0]


@pytest.fixture(scope="module")
def workers(broker: str, start_worker: StartWorker) -> list[subprocess.Popen[str]]:
    """Two workers, which all tests share."""
    return [start_worker(f"{broker}?worker={name}") for name in ("arm1", "arm2")]


@pytest.fixture
def fleet(broker: str, workers: list[subprocess.Popen[str]]) -> str:
    """The URL of a fleet of two workers."""
    return broker


def test_info_names_the_workers_as_servers(here: Run, fleet: str) -> None:
    code, out, err = here("info", "wait", url=fleet)
    assert (code, err) == (0, "")
    servers = out.partition("Goal:")[0]
    _, _, named = servers.partition("Action servers: 2\n")
    assert named.split("\n")[:2] in (["    /arm1", "    /arm2"], ["    arm1", "    arm2"])


def test_workers_are_listed(here: Run, fleet: str) -> None:
    lines = here("workers", url=fleet).lines
    assert [line.split()[0] for line in lines] == ["WORKER", "arm1", "arm2"]
    assert "/wait" in lines[1]


class Old(msgspec.Struct):
    n: int


class New(msgspec.Struct):
    n: int
    unit: str


async def forever(goal: GoalHandle[Any]) -> AsyncGenerator[int, None]:
    await anyio.sleep_forever()
    yield 1


@pytest.mark.asyncio
async def test_goals_that_no_worker_can_read_are_told(
    broker: str, capsys: pytest.CaptureFixture[str]
) -> None:
    url = broker.replace("robots", "mixed") + "?lease=2"
    old, new = (Action("turn", goal=one, feedback=int, result=str) for one in (Old, New))
    async with connect(url) as connection:
        async with serve(ActionServer(old, forever, at_stop="keep"), url):
            goal = await connection.client(old).send_goal(Old(1))
        async with serve(ActionServer(new, forever), url):
            with anyio.fail_after(30):
                while True:
                    (worker,) = await connection.workers()
                    if worker.unreadable:
                        break
                    await anyio.sleep(0.1)
            assert await list_goals(url) == 0
            assert await list_goals(url, form=Form.JSON) == 0
    out, err = capsys.readouterr()
    assert f"{goal.goal_id}  /turn   no worker" in out
    assert '"has_worker":false' in out
    assert err == (
        "1 waiting goal of /turn that no worker here can read: start a worker of the version that"
        " accepted them, or end them with unreadable='abort'\n"
    )


@pytest.mark.promise("FLEET-13")
def test_goals_of_a_worker_that_was_killed_are_listed_with_the_past(
    here: Run, broker: str, start_worker: StartWorker
) -> None:
    url = broker.replace("robots", "past")
    settings = "lease=2&history_days=1&history_goals=100"
    killed = start_worker(f"{url}?worker=killed&{settings}")
    label = ("--label", "order=17")
    assert here("send_goal", "wait", "{seconds: 0, steps: 1}", *label, url=url).code == 0
    goal_id = detached(here, url, *GOAL)
    start_worker(f"{url}?worker=next&{settings}")
    killed.kill()
    process = here("attach", goal_id, url=url)
    assert process.code == ExitCode.ABORTED
    found = here("goals", "--past", "--sort", "accepted", "--json", url=url).json
    assert [(one["status"], one["labels"]) for one in found] == [
        ("SUCCEEDED", {"order": "17"}),
        ("ABORTED", {}),
    ]
    assert [one["worker"] for one in found] == ["killed", "next"]
    heading, row = here("goals", "--past", *label, "--csv", url=url).lines
    assert "goal_id" in heading
    assert found[0]["goal_id"] in row
    assert len(here("goals", "--past", "--limit", "1", url=url).lines) == 2


@pytest.mark.promise("KEEP-12")
def test_a_goal_whose_worker_is_killed_ends_for_those_that_follow_it(
    started: Start, here: Run, broker: str, start_worker: StartWorker
) -> None:
    few = broker.replace("robots", "few")
    lost = start_worker(f"{few}?worker=lost&lease=2")
    goal_id = detached(here, few, *GOAL)
    process = started("attach", goal_id, url=few)
    lines_until("step: step", process)
    start_worker(f"{few}?worker=next")
    lost.kill()
    code, out, err = ended(process)
    # The end of the lease is told unless the end of the goal comes first.
    assert (code, err) in [
        (ExitCode.ABORTED, text) for text in ("", "fibaction: worker 'lost' is gone\n")
    ]
    assert out.endswith("Goal finished with status: ABORTED (the worker 'lost' was lost)\n")
    assert [line.split()[0] for line in here("workers", url=few).lines] == ["WORKER", "next"]

    (given_up,) = here("store", "given_up", few, "--json").json
    assert (given_up["goal_id"], given_up["attempt"]) == (goal_id, 1)
    assert given_up["reason"] == "the worker 'lost' was lost"
    assert given_up["goal"]["seconds"] == 60
    again = here("store", "rerun", few, goal_id[:12])
    assert again.out.startswith(f"goal {goal_id} of /wait runs again as goal ")
    process = started("attach", again.out.split()[-1], url=few)
    lines_until("step: step", process)
    here("cancel", again.out.split()[-1], url=few)
    assert ended(process).code == ExitCode.CANCELED
    assert here("store", "given_up", few).err == f"No goals were given up at {few}.\n"
