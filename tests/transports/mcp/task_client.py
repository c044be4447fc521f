"""A client of the SDK that takes tasks, as an agent framework has one.

    python -m tests.transports.mcp.task_client URL TOKEN start METERS
    python -m tests.transports.mcp.task_client URL TOKEN wait TASK

The first form sends a goal, prints the ID of the task and its first message, and waits for it; the
second one waits for a task of another client. Both print the task when it has ended.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any, Literal

import anyio
import httpx2
from mcp import Client
from mcp.client import ClientExtension, ResultClaim
from mcp.client.extension import ClaimContext
from mcp.client.streamable_http import streamable_http_client
from mcp.shared.exceptions import MCPError
from mcp_types import (
    CallToolResult,
    Request,
    RequestParams,
    Result,
)
from mcp_types.jsonrpc import INTERNAL_ERROR
from pydantic import ConfigDict

EXTENSION = "io.modelcontextprotocol/tasks"


class CreatedTask(Result):
    """The answer to a call that has become a task."""

    result_type: Literal["task"] = "task"
    task_id: str
    status: str
    created_at: str
    last_updated_at: str
    ttl_ms: int | None
    poll_interval_ms: int
    status_message: str | None = None


class SeenTask(Result):
    """A task, with whatever it has beside what each of them has."""

    model_config = ConfigDict(extra="allow")
    task_id: str
    status: str


class Acknowledged(Result):
    """The answer to a request that has none."""

    result_type: str


class TaskParams(RequestParams):
    task_id: str
    input_responses: dict[str, Any] | None = None


class TaskRequest(Request[TaskParams, str]):
    name_param = "taskId"


class Tasks(ClientExtension):
    """The extension: a call that becomes a task raises, with the task, what the test asks for."""

    identifier = EXTENSION

    def claims(self) -> Sequence[ResultClaim[Any]]:
        return [ResultClaim(result_type="task", model=CreatedTask, resolve=self._resolve)]

    async def _resolve(self, task: CreatedTask, context: ClaimContext) -> CallToolResult:
        """Wait for the end of a task, as an application wants it that knows calls only."""
        while True:
            request = TaskRequest(method="tasks/get", params=TaskParams(task_id=task.task_id))
            seen = await context.session.send_request(request, SeenTask)
            if seen.status == "completed":
                return CallToolResult.model_validate(members_of(seen)["result"])
            await anyio.sleep(0.01)


def members_of(task: Result) -> dict[str, Any]:
    """Return the members of a task as they are on the wire, but for the name of the server."""
    members = task.model_dump(by_alias=True, mode="json", exclude_none=True)
    members.pop("_meta", None)
    return members


async def ask(client: Client, method: str, task_id: str, **more: Any) -> dict[str, Any]:
    """Send a request about a task, and return the members of the answer."""
    params = TaskParams(task_id=task_id, **more)
    kind = SeenTask if method == "tasks/get" else Acknowledged
    answer = await client.session.send_request(TaskRequest(method=method, params=params), kind)
    return members_of(answer)


async def start(client: Client, tool: str, **arguments: Any) -> CreatedTask:
    """Call a tool whose answer is a task; agree to it for the user, if they are asked."""
    task: Any = await client.session.call_tool(tool, arguments, allow_claimed=True)
    assert isinstance(task, CreatedTask), task
    if task.status == "input_required":
        await answer(client, task.task_id, "accept")
    return task


async def answer(client: Client, task_id: str, action: Literal["accept", "decline"]) -> None:
    """Answer the questions of a task."""
    seen = await ask(client, "tasks/get", task_id)
    responses: dict[str, Any] = {
        key: {"action": action, "content": {}} for key in seen["inputRequests"]
    }
    await ask(client, "tasks/update", task_id, input_responses=responses)


async def until(client: Client, task_id: str, *statuses: str) -> dict[str, Any]:
    """Ask for a task until it has one of these statuses."""
    while True:
        try:
            task = await ask(client, "tasks/get", task_id)
        except MCPError as exc:
            if exc.error.code != INTERNAL_ERROR:  # which says to ask again
                raise
        else:
            if task["status"] in statuses:
                return task
        await anyio.sleep(0.05)


async def first_message(client: Client, task_id: str) -> str:
    """Ask for a task until it has a message, and return that."""
    while True:
        task = await ask(client, "tasks/get", task_id)
        if "statusMessage" in task:
            return str(task["statusMessage"])
        await anyio.sleep(0.05)


async def main(*arguments: str) -> None:
    url, token, how, what = arguments
    headers = {"Authorization": f"Bearer {token}"}
    async with (
        httpx2.AsyncClient(headers=headers, trust_env=False) as http,
        Client(
            streamable_http_client(url, http_client=http), mode="auto", extensions=[Tasks()]
        ) as client,
    ):
        if how == "start":
            what = (await start(client, "drive", meters=int(what))).task_id
            print(what, flush=True)
            print(await first_message(client, what), flush=True)
        task = await until(client, what, "completed", "failed", "cancelled")
        print(json.dumps(task), flush=True)


if __name__ == "__main__":
    anyio.run(main, *sys.argv[1:])
