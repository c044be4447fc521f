"""Programs that others have written for OpenAPI, at a server of actions that are hard to describe.

`make openapi` installs them into `.venv-openapi`, as they bring plugins of pytest and many
libraries; the nightly check runs it. Elsewhere these tests are skipped if the folder is missing.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Generator
from pathlib import Path

import pytest

from fibaction_transports.web.rest.openapi import describe
from tests.support.nested_actions import COUNT, FETCH, book
from tests.support.ports import free_port
from tests.support.processes import Finished, ended, lines_until

ROOT = Path(__file__).resolve().parents[3]
PROGRAMS = ROOT / ".venv-openapi/bin"
IS_LEFT_OUT = not PROGRAMS.is_dir() and os.environ.get("FIBACTION_OPENAPI") != "required"
REDOCLY = "@redocly/cli@2.77.0"
TOKEN = "of-the-tests"
EXAMPLES = "5"
"""Requests of each kind to each operation; in all, some hundreds in 20 seconds."""

PROGRAM = """\
import sys

from client import Client
from client.api.actions import list_actions
from client.api.fetch import send_fetch
from client.api.leftcount import (
    cancel_left_count,
    events_left_count,
    send_left_count,
    status_left_count,
)
from client.models import (
    FetchGoal,
    FetchGoalPart,
    FetchGoalToShelf,
    FetchGoalToShelfType,
    LeftCountGoal,
)

with Client(sys.argv[1], raise_on_unexpected_status=True) as client:
    print(*(action.name for action in list_actions.sync(client=client)))
    shelf = FetchGoalToShelf(FetchGoalToShelfType.SHELF, number=3)
    parts = [FetchGoalPart("arm", [FetchGoalPart("hand")])]
    fetched = send_fetch.sync(client=client, body=FetchGoal(shelf, parts=parts), wait=20)
    print(fetched.status, fetched.result.total)
    short = send_left_count.sync(client=client, body=LeftCountGoal(3))
    followed = events_left_count.sync_detailed(short.goal_id, client=client)
    print(followed.content.count(b"event: feedback"))
    endless = send_left_count.sync(client=client, body=LeftCountGoal(50))
    print(cancel_left_count.sync(endless.goal_id, client=client).code)
    print(status_left_count.sync(endless.goal_id, client=client, wait=20).status)
"""

pytestmark = pytest.mark.skipif(IS_LEFT_OUT, reason="its programs are missing: run `make openapi`")


@pytest.fixture
def query() -> str:
    """The settings in the server's URL."""
    return ""


@pytest.fixture
def url(query: str) -> Generator[str, None, None]:
    url = f"http://127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "tests.support.nested_actions", url + query]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as robot:
        try:
            lines_until(url, robot)
            yield url
        finally:
            robot.kill()


def run(folder: Path, program: str, *arguments: str) -> Finished:
    path = f"{PROGRAMS}{os.pathsep}{os.environ['PATH']}"
    return ended(
        subprocess.Popen(
            [PROGRAMS / program, *arguments],
            cwd=folder,
            env={**os.environ, "PATH": path, "PYTHONPATH": str(folder)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ),
        patience=270,
    )


@pytest.mark.timeout(300)
def test_a_generated_client_sends_follows_and_cancels_goals(url: str, tmp_path: Path) -> None:
    described = describe([FETCH.info, COUNT.info], "", asks_for_tokens=False)
    (tmp_path / "openapi.json").write_text(json.dumps(described))
    made = run(
        *(tmp_path, "openapi-python-client", "generate", "--meta", "none"),
        *("--path", "openapi.json", "--output-path", "client", "--fail-on-warning"),
    )
    assert made.code == 0, made.out
    (tmp_path / "program.py").write_text(PROGRAM)
    done = run(tmp_path, "python", "program.py", url)
    assert done.lines == ["fetch left/count book", "SUCCEEDED 1", "3", "NONE", "CANCELED"], done.out


@pytest.mark.timeout(300)
@pytest.mark.parametrize("query", ["", f"?token={TOKEN}"], ids=["open", "with a token"])
def test_random_requests_find_no_difference_between_description_and_server(
    url: str, tmp_path: Path
) -> None:
    done = run(
        *(tmp_path, "schemathesis", "run", f"{url}/openapi.json"),
        *("--header", f"Authorization: Bearer {TOKEN}", "--max-examples", EXAMPLES),
        # The levers would have all other requests answered with 503.
        *("--exclude-operation-id-regex", r"^operate\."),
        *("--phases", "examples,coverage,fuzzing"),  # the other one may wait for a goal without end
    )
    assert done.code == 0, done.out


@pytest.mark.timeout(300)
@pytest.mark.skipif(shutil.which("npx") is None, reason="redocly needs Node")
@pytest.mark.skipif(
    os.environ.get("FIBACTION_OPENAPI") != "required", reason="`make openapi` fetches redocly"
)
@pytest.mark.parametrize("asks_for_tokens", [False, True])
def test_the_description_has_no_error_for_redocly(tmp_path: Path, asks_for_tokens: bool) -> None:
    infos = [FETCH.info, COUNT.info, book.info]
    described = describe(infos, "", asks_for_tokens=asks_for_tokens)
    (tmp_path / "openapi.json").write_text(json.dumps(described))
    npx = ["npx", "--yes", REDOCLY, "lint", "openapi.json", "--format", "json"]
    done = subprocess.run(npx, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(done.stdout)["totals"]["errors"] == 0
