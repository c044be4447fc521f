"""The hooks of examples/web in their frameworks, and the client in Deno and Bun.

`make frontends` installs them, and runs these tests, which are left out otherwise.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.browser.served import RobotProcess
from tests.javascript.test_client import CLIENT

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent / "frontends"
MODULES = ROOT / "build/frontends/node_modules"
RUNTIMES = {
    "deno": [MODULES / "@deno/linux-x64-glibc/deno", "run", "--allow-net"],
    "bun": [MODULES / "@oven/bun-linux-x64/bin/bun", "run"],
}
PATIENCE = 110.0

pytestmark = [
    pytest.mark.timeout(120),
    pytest.mark.skipif(
        os.environ.get("FIBACTION_FRONTENDS") != "required",
        reason="make frontends installs frameworks of JavaScript and runs these tests",
    ),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A project with the hooks, the client, the programs and their libraries."""
    for file in (CLIENT / "fibaction.js", *(ROOT / "examples/web").glob("*.js"), *HERE.iterdir()):
        shutil.copy(file, tmp_path)
    (tmp_path / "node_modules").symlink_to(MODULES)
    return tmp_path


def run(folder: Path, *command: object) -> str:
    """Run a program, which must succeed, and return what it prints."""
    done = subprocess.run(
        [*map(str, command)],
        cwd=folder,
        env=os.environ | {"HOME": str(folder), "NO_COLOR": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.mark.parametrize("name", ["react", "vue", "svelte"])
def test_a_hook_follows_goals_within_its_framework(folder: Path, name: str) -> None:
    with RobotProcess() as robot:
        run(folder, "node", "hooks.mjs", name, robot.url)


@pytest.mark.parametrize("name", RUNTIMES)
def test_the_client_runs_in_another_runtime(folder: Path, name: str) -> None:
    with RobotProcess() as robot:
        told, status = run(folder, *RUNTIMES[name], "runtime.mjs", robot.url).splitlines()
    done = json.loads(told)
    assert (done["status"], done["length"], done["hasFeedback"]) == ("SUCCEEDED", 11, True)
    assert "fibonacci" in done["names"]
    assert status == "CANCELED"
