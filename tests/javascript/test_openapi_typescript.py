"""The client that openapi-typescript and openapi-fetch make of the REST interface."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fibaction_transports.web.rest.openapi import describe
from tests.javascript.test_client import run
from tests.support.nested_actions import COUNT, FETCH
from tests.support.node import IS_LEFT_OUT, MISSING, MODULES
from tests.support.ports import free_port
from tests.support.processes import lines_until

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
DEFAULTS = ("--default-non-nullable", "false")

pytestmark = pytest.mark.skipif(IS_LEFT_OUT, reason=MISSING)


@pytest.mark.timeout(120)
def test_a_program_with_generated_types_sends_follows_and_cancels_goals(tmp_path: Path) -> None:
    (tmp_path / "node_modules").symlink_to(MODULES)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    shutil.copy(HERE / "openapi/program.ts", tmp_path)
    options = json.loads((HERE / "tsconfig.json").read_text())
    options["compilerOptions"]["skipLibCheck"] = True
    (tmp_path / "tsconfig.json").write_text(json.dumps(options))
    described = describe([FETCH.info, COUNT.info], "", asks_for_tokens=False)
    (tmp_path / "openapi.json").write_text(json.dumps(described))
    generator = "node_modules/openapi-typescript/bin/cli.js"
    run(tmp_path, generator, "openapi.json", "-o", "api.d.ts", *DEFAULTS)
    run(tmp_path, "node_modules/typescript/bin/tsc", "-p", ".")
    url = f"http://127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "tests.support.nested_actions", url]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as robot:
        try:
            lines_until(url, robot)
            out = run(tmp_path, "program.js", url)
        finally:
            robot.kill()
    assert out.split() == ["fetch,left/count,book", "SUCCEEDED", "1", "3", "NONE", "CANCELED"]
