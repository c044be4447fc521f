"""Agents that others have written, at a bridge by A2A 0.3: google-adk's and those of strands.

`make agents` installs them into `.venv-a2a-agents`; the nightly check runs it. Elsewhere this test
is skipped if the folder is missing.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.ports import free_port
from tests.support.processes import ended, lines_until

ROOT = Path(__file__).resolve().parents[3]
PYTHON = ROOT / ".venv-a2a-agents/bin/python"
IS_LEFT_OUT = not PYTHON.is_file() and os.environ.get("FIBACTION_AGENTS") != "required"
TOKEN = "tW4x9c-tW4x9c"


# Each agent sends a text, and what comes back is printed: one line of JSON for each text.
PROGRAM = """\
import asyncio
import json
import sys
import warnings

import httpx
from a2a.client import ClientConfig
from google.adk.agents.remote_a2a_agent import RemoteA2aAgent
from google.adk.runners import InMemoryRunner
from google.genai import types
from strands.agent.a2a_agent import A2AAgent

warnings.simplefilter("ignore")
TEXTS = (
    '{"skill": "drive", "goal": {"meters": 2}}',
    '{"meters": 2}',
    '{"meters": -2}',
)


async def by_adk(http, url, text):
    card = f"{url}/.well-known/agent-card.json"
    agent = RemoteA2aAgent(name="robot", agent_card=card, httpx_client=http)
    runner = InMemoryRunner(agent=agent, app_name="test")
    session = await runner.session_service.create_session(app_name="test", user_id="user")
    content = types.Content(role="user", parts=[types.Part(text=text)])
    told = []
    async for event in runner.run_async(user_id="user", session_id=session.id, new_message=content):
        told += [part.text for part in event.content.parts if part.text] if event.content else []
        told += [event.error_message] if event.error_message else []
    return told


async def by_strands(http, url, text):
    agent = A2AAgent(url, client_config=ClientConfig(httpx_client=http))
    result = await agent.invoke_async(text)
    return [part["text"] for part in result.message["content"]]


async def main(url, token):
    headers = {"Authorization": f"Bearer {token}"}
    async with httpx.AsyncClient(headers=headers, trust_env=False, timeout=30) as http:
        for text in TEXTS:
            print(json.dumps([await by_adk(http, url, text), await by_strands(http, url, text)]))


asyncio.run(main(*sys.argv[1:]))
"""


@pytest.mark.skipif(IS_LEFT_OUT, reason="its programs are missing: run `make agents`")
@pytest.mark.timeout(300)
def test_agents_send_goals_as_the_text_that_a_model_has_written() -> None:
    url = f"http://127.0.0.1:{free_port()}"
    served = f"a2a+{url}?token={TOKEN}&unasked=*"
    command = [sys.executable, "-m", "tests.transports.agent_robot", served, "drive"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=ROOT, stdout=pipe, text=True) as robot:
        try:
            lines_until(url, robot)
            clients = subprocess.Popen(
                [PYTHON, "-c", PROGRAM, url, TOKEN], stdout=pipe, stderr=pipe, text=True
            )
            code, out, err = ended(clients, patience=240)
        finally:
            robot.kill()

    assert code == 0, err
    arrived, rejected = ['{"at":2}'], ["it cannot drive backwards"]
    answers = [json.loads(line) for line in out.splitlines()]
    assert answers == [[arrived] * 2, [arrived] * 2, [rejected] * 2]
