"""Programs that others have written for MCP, at a bridge: fastmcp-tasks and the conformance suite.

`make agents` installs fastmcp-tasks into `.venv-mcp-agents`, and npx gets the suite; the nightly
check runs it. Elsewhere these tests are skipped if the folder is missing.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import AsyncGenerator, Generator
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path

import anyio
import pytest
from anyio.abc import SocketAttribute, SocketStream

from fibaction.border.event_loop import Background
from tests.support.ports import free_port
from tests.support.processes import ended, lines_until
from tests.transports.proxy import BROKEN

ROOT = Path(__file__).resolve().parents[3]
PYTHON = ROOT / ".venv-mcp-agents/bin/python"
IS_LEFT_OUT = not PYTHON.is_file() and os.environ.get("FIBACTION_AGENTS") != "required"
SUITE = "@modelcontextprotocol/conformance@0.2.0-alpha.12"
"""The first version that knows the protocol 2026-07-28."""
TOKEN = "tW4x9c-tW4x9c"
UNASKED = (
    "failing_job,greet,say,slow_compute,test_error_handling,test_image_content,test_simple_text,"
    "test_tool_with_progress"
)

ALL_TASKS = "for a client with tasks each goal is one; no tool of the suite's robot only answers"
CONTENT = "results are data and images: a goal has neither audio nor files"
LOGS = "no log lines are sent: those of a server are not its clients'"
NO_HEADERS = "a goal has no fields that are sent as headers"
NO_PROMPTS = "a bridge of actions has no prompts"
NO_SAMPLING = "a bridge does not use the client's model, nor its folders"
ONE_QUESTION = "the only question is whether the goal may be sent; it has no fields"
OTHER_RESOURCES = "the resources are goals, `goal://ID`, and not those of the suite"
REASONS = {
    "completion-complete": "inputs have schemas, and no completion",
    "elicitation-sep1034-general": ONE_QUESTION,
    "elicitation-sep1330-general": ONE_QUESTION,
    "incoming-sse-event": "no connection is closed in mid-call: the suite's tool is missing",
    "json-schema-2020-12-tool-found": "the schema is that of a type, and not the suite's",
    "logging-set-level": LOGS,
    "prompts-get-embedded-resource": NO_PROMPTS,
    "prompts-get-simple": NO_PROMPTS,
    "prompts-get-with-args": NO_PROMPTS,
    "prompts-get-with-image": NO_PROMPTS,
    "prompts-list": NO_PROMPTS,
    "resources-read-binary": OTHER_RESOURCES,
    "resources-read-text": OTHER_RESOURCES,
    "resources-subscribe": "a client subscribes by `subscriptions/listen`, from 2026-07-28 on",
    "resources-templates-read": OTHER_RESOURCES,
    "resources-unsubscribe": "a client subscribes by `subscriptions/listen`, from 2026-07-28 on",
    "sep-2243-server-decode-base64": NO_HEADERS,
    "sep-2243-server-no-xmcp-tool": NO_HEADERS,
    "sep-2243-server-reject-invalid-param-chars": NO_HEADERS,
    "sep-2243-server-reject-param-mismatch": NO_HEADERS,
    "sep-2243-server-validate-param-match": NO_HEADERS,
    "sep-2322-elicitation-incomplete": ONE_QUESTION,
    "sep-2322-list-roots-incomplete": NO_SAMPLING,
    "sep-2322-multi-round-r1": ONE_QUESTION,
    "sep-2322-multiple-inputs-incomplete": ONE_QUESTION,
    "sep-2322-non-tool-incomplete": NO_PROMPTS,
    "sep-2322-reject-tampered-state": "nothing is sent: the user is asked again",
    "sep-2322-respect-client-capabilities": NO_SAMPLING,
    "sep-2322-sampling-incomplete": NO_SAMPLING,
    "sep-2549-prompts-list-caching-hints": NO_PROMPTS,
    "sep-2575-missing-capability-http-400": NO_SAMPLING,
    "sep-2575-server-rejects-undeclared-capability": NO_SAMPLING,
    "sep-2663-legacy-task-param-ignored": ALL_TASKS,
    "sep-2663-mrtr-synchronous-before-task-creation": "the task itself asks the user",
    "sep-2663-server-returns-missing-capability-when-required": "no tool needs tasks",
    "sep-2663-tasks-get-status-failed": "the suite's tool fails by an error of the protocol",
    "tasks-headers-tolerate-mcp-method-on-tools-call": ALL_TASKS,
    "tasks-mrtr-partial-fulfillment": ONE_QUESTION,
    "tasks-result-type-complete-on-non-task-responses": ALL_TASKS,
    "tasks-sync-tool-call": ALL_TASKS,
    "tools-call-audio": CONTENT,
    "tools-call-embedded-resource": CONTENT,
    "tools-call-mixed-content": CONTENT,
    "tools-call-sampling": NO_SAMPLING,
    "tools-call-with-logging": LOGS,
}
"""The checks of the suite that a bridge of actions does not pass, and why."""

FASTMCP = """\
import asyncio
import json
import sys

from fastmcp import Client
from fastmcp.client.elicitation import ElicitResult
from fastmcp.client.transports import StreamableHttpTransport
from fastmcp.exceptions import ToolError
from fastmcp_tasks import call_tool_task


async def main(url, token):
    asked, answer, pieces = [], "accept", []

    async def ask(message, *_):
        asked.append(message)
        return ElicitResult(action=answer, content={} if answer == "accept" else None)

    async def note(_progress, _total, message):
        pieces.append(message)

    def client(mode):
        transport = StreamableHttpTransport(url, auth=token)
        return Client(transport, mode=mode, elicitation_handler=ask, progress_handler=note)

    async def ended(task):
        try:
            return (await task).structured_content["result"]
        except ToolError as exc:
            return str(exc)

    async with client("auto") as agent:
        task = await call_tool_task(agent, "drive", {"meters": 3})
        seen = task.create_result.status, (await task.status()).status
        print(json.dumps({"before": seen, "end": await ended(task), "asked": asked}))
        task = await call_tool_task(agent, "drive", {"meters": -3})
        print(json.dumps({"rejected": await ended(task)}))
        answer = "decline"
        task = await call_tool_task(agent, "drive", {"meters": 3})
        print(json.dumps({"declined": await ended(task)}))
        answer = "accept"
        task = await call_tool_task(agent, "drive", {"meters": 100_000})
        waiting = asyncio.create_task(ended(task))
        await task.wait(state="working")
        await task.cancel()
        print(json.dumps({"canceled": (await task.wait()).status, "end": await waiting}))
    async with client("legacy") as agent:
        said = await agent.call_tool("say", {"text": "hello world of three"})
        print(json.dumps({"said": said.data.result, "pieces": "".join(pieces)}))


asyncio.run(main(*sys.argv[1:]))
"""

pytestmark = [
    pytest.mark.skipif(IS_LEFT_OUT, reason="its programs are missing: run `make agents`"),
    pytest.mark.timeout(300),
]


@contextmanager
def served(unasked: str, *names: str) -> Generator[int, None, None]:
    port = free_port()
    url = f"mcp+http://127.0.0.1:{port}?token={TOKEN}&unasked={unasked}"
    command = [sys.executable, "-m", "tests.transports.agent_robot", url, *names]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as robot:
        try:
            lines_until("/mcp", robot)
            yield port
        finally:
            robot.kill()


def test_fastmcp_tasks_asks_the_user_before_a_task_runs_and_tells_why_it_does_not() -> None:
    pipe = subprocess.PIPE
    with served("say", "drive", "say") as port:
        command = [str(PYTHON), "-c", FASTMCP, f"http://127.0.0.1:{port}/mcp", TOKEN]
        code, out, err = ended(
            subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True), patience=240
        )

    assert code == 0, err
    done, rejected, declined, canceled, said = map(json.loads, out.splitlines())
    assert done == {
        "before": ["input_required", "input_required"],
        "end": {"at": 3},
        "asked": ['Send this goal to the action drive?\n\n{\n  "meters": 3\n}'],
    }
    assert rejected["rejected"].endswith("nothing was done: it cannot drive backwards")
    assert declined["declined"].startswith("Nothing was sent: the user has declined.")
    assert canceled["canceled"] == "cancelled"
    assert said == {"said": "hello world of three", "pieces": "hello world of three "}


@asynccontextmanager
async def with_token(port: int) -> AsyncGenerator[str, None]:
    """A server that adds the token to each request, since the suite cannot."""

    added = rf"\r\nAuthorization: Bearer {TOKEN}".encode()

    async def hand_on(client: SocketStream) -> None:
        async def pump(source: SocketStream, target: SocketStream, added: bytes) -> None:
            with suppress(*BROKEN):
                async for data in source:  # the suite sends the head of a request in one piece
                    await target.send(re.sub(rb"(?i)(?=\r\nhost: )", added, data, count=1))
            tasks.cancel_scope.cancel()

        async with client, await anyio.connect_tcp("127.0.0.1", port) as server:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(pump, client, server, added)
                tasks.start_soon(pump, server, client, b"")

    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener:
        async with Background() as tasks:
            tasks.start_soon(listener.serve, hand_on)
            yield f"http://127.0.0.1:{listener.extra(SocketAttribute.local_port)}/mcp"


def texts_in(folder: Path) -> list[str]:
    return [path.read_text() for path in folder.glob("*/*/checks.json")]


@pytest.mark.asyncio
async def test_the_conformance_suite_finds_what_a_bridge_of_actions_can_have(
    tmp_path: Path,
) -> None:
    suite = ["npx", "--yes", "-p", "node@22", "-p", SUITE, "conformance"]
    listed = await anyio.run_process([*suite, "list", "--server"])
    tasks = re.findall(r"- (tasks-\S+)", listed.stdout.decode())
    versions = ("2025-11-25", "2026-07-28")
    choices = [["--suite", "all", "--spec-version", version] for version in versions]
    choices += [["--scenario", each] for each in tasks]
    with served(UNASKED) as port:
        async with with_token(port) as url:
            for number, choice in enumerate(choices):
                out = tmp_path / str(number)
                command = [*suite, "server", *choice, "--url", url, "-o", str(out)]
                await anyio.run_process(command, check=False)

    found = [json.loads(text) for text in texts_in(tmp_path)]
    failed = {check["id"] for checks in found for check in checks if check["status"] == "FAILURE"}
    passed = [check for checks in found for check in checks if check["status"] == "SUCCESS"]
    assert failed == set(REASONS)
    assert len(passed) > 150
