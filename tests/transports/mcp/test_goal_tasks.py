"""Goals as tasks of MCP, with the client of the SDK."""

from __future__ import annotations

import re
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from mcp import Client
from mcp.shared.exceptions import MCPError
from mcp_types import ElicitResult
from mcp_types.jsonrpc import (
    INTERNAL_ERROR,
    INVALID_PARAMS,
    METHOD_NOT_FOUND,
    MISSING_REQUIRED_CLIENT_CAPABILITY,
)

from fibaction import ActionError, ConnectionLost, GoalID, GoalStatus, Outcome, UnknownGoal, serve
from fibaction.words.goals import UNKNOWN_OUTCOME
from fibaction_transports._agents.agent_goals import AgentGoal, AgentGoals
from fibaction_transports.mcp import AgentPolicy, McpBridge
from fibaction_transports.mcp.goal_tasks import EXTENSION, detailed
from tests.support.ports import free_port
from tests.support.processes import PATIENCE
from tests.transports.driving_robot import Drive
from tests.transports.mcp.robot import UNASKED, Robot, sent_by_others, text_of
from tests.transports.mcp.task_client import Tasks, answer, ask, members_of, start, until

pytestmark = pytest.mark.asyncio
TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z")


@asynccontextmanager
async def tasking(
    policy: AgentPolicy = UNASKED, **options: Any
) -> AsyncGenerator[tuple[Robot, Client], None]:
    """A robot that is served, and a client of a bridge to it that takes tasks."""
    robot = Robot()
    with anyio.fail_after(PATIENCE):
        async with (
            serve((robot.drive, robot.count), robot.here),
            McpBridge(robot.here, policy) as bridge,
            client_of(bridge, **options) as client,
        ):
            yield robot, client


def client_of(bridge: McpBridge, **options: Any) -> Client:
    options = {"mode": "auto", "extensions": [Tasks()]} | options
    return Client(bridge.server, **options)


async def error_of(client: Client, method: str, task_id: str) -> tuple[int, str]:
    """Send a request about a task that is an error, and return the error."""
    with pytest.raises(MCPError) as caught:
        await ask(client, method, task_id)
    return caught.value.error.code, caught.value.error.message


async def test_a_call_becomes_a_task_whose_result_is_the_answer_of_the_tool() -> None:
    async with tasking() as (robot, client):
        assert client.server_capabilities.extensions == {EXTENSION: {}}
        task = members_of(await start(client, "arm-drive", meters=100))
        await robot.waits.wait()
        assert (task["resultType"], task["status"]) == ("task", "working")
        assert task["pollIntervalMs"] == 1000
        assert GoalID.parse(task["taskId"])
        seen = await ask(client, "tasks/get", task["taskId"])
        assert (seen["resultType"], seen["status"]) == ("complete", "working")
        assert seen["statusMessage"] == '{"meters":1}'
        assert TIME.fullmatch(seen["createdAt"])
        assert seen["createdAt"] == task["createdAt"] <= seen["lastUpdatedAt"]

        task = members_of(await start(client, "arm-drive", meters=3))
        ended = await until(client, task["taskId"], "completed")
        result = ended["result"]
        assert result["isError"] is False
        assert result["structuredContent"]["result"] == {"at": 3}
        assert result["content"][0]["text"].endswith('"result":{"at":3}}')
        assert "statusMessage" not in ended


async def test_a_client_that_knows_calls_only_waits_for_the_end() -> None:
    async with tasking() as (_, client):
        result = await client.call_tool("arm-drive", {"meters": 4})
        assert result.structured_content is not None
        assert result.structured_content["result"] == {"at": 4}


async def test_a_goal_that_is_aborted_is_an_answer_with_an_error() -> None:
    async with tasking() as (_, client):
        task = await start(client, "arm-drive", meters=13)
        ended = await until(client, task.task_id, "completed")
        assert ended["result"]["isError"] is True
        assert ended["result"]["structuredContent"]["result"] == {"at": 12}
        assert ended["statusMessage"] == "there is a wall"


async def test_a_goal_that_is_rejected_is_no_task() -> None:
    async with tasking() as (_, client):
        result = await client.call_tool("arm-drive", {"meters": -1})
        assert result.is_error
        assert "it cannot drive backwards" in text_of(result)


async def test_a_task_is_canceled_and_has_its_partial_result() -> None:
    async with tasking(AgentPolicy(), elicitation_callback=yes) as (robot, client):
        task = (await start(client, "arm-drive", meters=100)).task_id
        await robot.waits.wait()
        assert await ask(client, "tasks/cancel", task) == {"resultType": "complete"}
        ended = await until(client, task, "cancelled")
        assert ended["statusMessage"] == "it has braked"
        assert ended["result"]["structuredContent"]["result"] == {"at": 1}
        assert ended["result"]["isError"] is False
        assert await ask(client, "tasks/cancel", task) == {"resultType": "complete"}
        answer = await ask(client, "tasks/update", task, input_responses={"a": {}})
        assert answer == {"resultType": "complete"}


async def test_a_cancel_that_is_rejected_is_an_error_and_the_task_goes_on() -> None:
    async with tasking() as (robot, client):
        robot.is_stubborn = True
        task = (await start(client, "arm-drive", meters=100)).task_id
        await robot.waits.wait()
        code, text = await error_of(client, "tasks/cancel", task)
        assert code == INTERNAL_ERROR
        assert text == "the server rejects the cancel: it is on a slope"
        assert (await ask(client, "tasks/get", task))["status"] == "working"


async def test_the_goal_of_another_program_is_not_canceled_without_its_user() -> None:
    async with tasking(AgentPolicy()) as (robot, client):
        task = str((await sent_by_others(robot, 100)).goal_id)
        assert (await ask(client, "tasks/get", task))["status"] == "working"
        code, text = await error_of(client, "tasks/cancel", task)
        assert code == INVALID_PARAMS
        assert "the tool cancel_goal asks the user" in text
        assert not robot.stopped.is_set()


async def yes(context: Any, params: Any) -> ElicitResult:
    """Stand for a client that can ask its user; a task has its question itself."""
    raise AssertionError("the question is in the task")


async def asked(client: Client, **arguments: Any) -> str:
    """Call a tool whose answer is a task that asks the user, and return its ID."""
    task: Any = await client.session.call_tool("arm-drive", arguments, allow_claimed=True)
    assert (task.status, task.result_type) == ("input_required", "task")
    return str(task.task_id)


async def test_a_task_waits_for_the_consent_of_the_user_before_its_goal_is_sent() -> None:
    async with tasking(AgentPolicy(), elicitation_callback=yes) as (robot, client):
        task_id = await asked(client, meters=3)
        seen = await ask(client, "tasks/get", task_id)
        (question,) = seen["inputRequests"].values()
        assert question["method"] == "elicitation/create"
        assert '"meters": 3' in question["params"]["message"]
        for useless in (None, {}, {"consent": {"action": "perhaps"}}):
            await ask(client, "tasks/update", task_id, input_responses=useless)
        assert (await ask(client, "tasks/get", task_id))["status"] == "input_required"
        assert robot.sent == []

        await answer(client, task_id, "accept")

        done = await until(client, task_id, "completed")
        assert done["result"]["structuredContent"]["result"] == {"at": 3}
        assert robot.sent == [Drive(3)]


async def test_a_task_without_consent_or_whose_goal_is_rejected_says_so() -> None:
    async with tasking(AgentPolicy(), elicitation_callback=yes) as (robot, client):
        declined, rejected = await asked(client, meters=3), await asked(client, meters=-1)
        await answer(client, declined, "decline")
        await answer(client, rejected, "accept")
        for task_id, text in ((declined, "the user has declined"), (rejected, "was rejected")):
            done = await ask(client, "tasks/get", task_id)
            assert (done["status"], done["result"]["isError"]) == ("completed", True)
            assert text in done["result"]["content"][0]["text"]
        for _ in range(2):
            canceled = await asked(client, meters=3)
            for _ in range(2):
                await ask(client, "tasks/cancel", canceled)
            assert (await ask(client, "tasks/get", canceled))["status"] == "cancelled"
        assert robot.sent == []


@pytest.fixture
def sending(monkeypatch: pytest.MonkeyPatch) -> tuple[anyio.Event, anyio.Event]:
    """Hold each goal that the bridge sends: one event is set then, and the other lets it go on."""
    began, go_on, send = anyio.Event(), anyio.Event(), AgentGoals.send

    async def held(*arguments: Any, **settings: Any) -> AgentGoal[Any]:
        began.set()
        await go_on.wait()
        return await send(*arguments, **settings)

    monkeypatch.setattr(AgentGoals, "send", held)
    return began, go_on


async def test_a_task_is_canceled_while_its_goal_is_sent(
    sending: tuple[anyio.Event, anyio.Event],
) -> None:
    began, go_on = sending
    async with tasking(AgentPolicy(), elicitation_callback=yes) as (robot, client):
        task_id = await asked(client, meters=100)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(answer, client, task_id, "accept")
            await began.wait()
            await ask(client, "tasks/cancel", task_id)
            go_on.set()
        await until(client, task_id, "cancelled")
        assert robot.sent == [Drive(100)]


async def test_a_task_whose_answer_is_cut_while_its_goal_is_sent_is_canceled(
    sending: tuple[anyio.Event, anyio.Event],
) -> None:
    began, _ = sending
    async with tasking(AgentPolicy(), elicitation_callback=yes) as (robot, client):
        task_id = await asked(client, meters=100)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(answer, client, task_id, "accept")
            await began.wait()
            tasks.cancel_scope.cancel()
        await until(client, task_id, "cancelled")
        assert robot.sent == []


async def test_a_bridge_that_is_read_only_shows_tasks_and_cancels_none() -> None:
    async with tasking(AgentPolicy(read_only=True, unasked=("*",))) as (robot, client):
        task = str((await sent_by_others(robot, 100)).goal_id)
        assert (await ask(client, "tasks/get", task))["status"] == "working"
        assert "read-only" in (await error_of(client, "tasks/cancel", task))[1]


@pytest.mark.parametrize("method", ["tasks/get", "tasks/update", "tasks/cancel"])
@pytest.mark.parametrize("task", ["7", "f" * 32])
async def test_a_task_that_no_server_knows_is_an_error(method: str, task: str) -> None:
    async with tasking() as (_, client):
        code, text = await error_of(client, method, task)
        assert code == INVALID_PARAMS
        assert text.startswith("there is no task of this ID: ")


async def test_in_an_earlier_protocol_there_are_no_tasks() -> None:
    async with tasking(mode="legacy", extensions=[]) as (_, client):
        result = await client.call_tool("arm-drive", {"meters": 3})
        assert result.structured_content is not None
        assert result.structured_content["result"] == {"at": 3}
        code, _ = await error_of(client, "tasks/get", "f" * 32)
        assert code == METHOD_NOT_FOUND


@pytest.mark.parametrize("method", ["tasks/get", "tasks/update", "tasks/cancel"])
async def test_a_client_that_takes_no_tasks_is_told_what_it_must_declare(method: str) -> None:
    async with tasking(extensions=[]) as (_, client):
        code, text = await error_of(client, method, "f" * 32)
        assert code == MISSING_REQUIRED_CLIENT_CAPABILITY
        assert EXTENSION in text


async def test_a_task_outlives_its_bridge() -> None:
    async with tasking() as (robot, client):
        one = (await start(client, "arm-drive", meters=3)).task_id
        two = (await start(client, "arm-drive", meters=100)).task_id
        await robot.waits.wait()
        async with (
            McpBridge(robot.here, UNASKED) as bridge,
            client_of(bridge) as second,
        ):
            ended = await until(second, one, "completed")
            assert ended["result"]["structuredContent"]["result"] == {"at": 3}
            await ask(second, "tasks/cancel", two)
            assert (await until(second, two, "cancelled"))["statusMessage"] == "it has braked"


async def test_while_a_server_is_away_a_task_that_is_not_known_may_exist() -> None:
    url = f"tcp://127.0.0.1:{free_port()}"
    async with McpBridge(url, UNASKED) as bridge, client_of(bridge) as client:
        code, text = await error_of(client, "tasks/get", "f" * 32)
        assert code == INTERNAL_ERROR
        assert "ask again" in text


class Lost:
    """The goal of a client that cannot follow it any more."""

    goal_id = GoalID.random()
    stamp = 1_790_000_000_123_456_789
    status = GoalStatus.EXECUTING


def lost(error: ActionError) -> AgentGoal[Any]:
    goal: Any = Lost()
    action: Any = None
    made = AgentGoal(action, goal, owner="")
    made.error = error
    return made


async def test_a_goal_that_cannot_be_followed_now_is_still_working() -> None:
    task = detailed(lost(ConnectionLost("it is away")))
    assert (task["status"], task["createdAt"]) == ("working", "2026-09-21T14:13:20.123Z")
    assert task["statusMessage"] == "The goal cannot be followed now: it is away"


async def test_a_goal_that_its_server_has_forgotten_has_failed() -> None:
    task = detailed(lost(UnknownGoal(GoalID(b"7" * 16))))
    assert task["status"] == "failed"
    assert task["error"]["code"] == INTERNAL_ERROR
    assert task["error"]["message"].startswith(f"the result is lost: goal {'37' * 16} is unknown: ")
    made = lost(ConnectionLost(""))
    made.error, made.outcome = None, UNKNOWN_OUTCOME
    task = detailed(made)
    assert (task["status"], task["error"]["code"]) == ("failed", INTERNAL_ERROR)


async def test_a_cancel_that_cannot_be_asked_for_is_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def cancel(_: AgentGoal[Any]) -> None:
        raise ConnectionLost("it is away")

    async with tasking() as (robot, client):
        task = (await start(client, "arm-drive", meters=100)).task_id
        await robot.waits.wait()
        monkeypatch.setattr(AgentGoal, "cancel", cancel)
        code, text = await error_of(client, "tasks/cancel", task)
        assert (code, text) == (INTERNAL_ERROR, "the goal may continue: it is away")


async def test_a_canceled_goal_without_a_result_is_a_task_without_one() -> None:
    made = lost(ConnectionLost(""))
    made.error, made.outcome = None, Outcome(GoalStatus.CANCELED)
    assert detailed(made)["status"] == "cancelled"
    assert "result" not in detailed(made)
