"""`serve --metrics`: as a process, and with what is missing or wrong."""

from __future__ import annotations

import re
import sys
import urllib.request
from pathlib import Path
from signal import SIGINT

import pytest

from fibaction.cli.process.exit_codes import ExitCode
from tests.cli.conftest import Invoke, Run, Start
from tests.support.processes import ended, lines_until


def test_metrics_of_goals_are_served_until_the_servers_stop(
    folder: Path, started: Start, here: Run
) -> None:
    unix = f"unix://{folder}/socket"
    server = started("serve", "robot:several", unix, "--metrics", ":0")
    lines = lines_until("serving", server)
    found = re.fullmatch(r"metrics at (http://127.0.0.1:\d+/metrics)\n", lines[0])
    assert found
    assert here("send_goal", "count", "3", url=unix).code == ExitCode.SUCCEEDED
    with urllib.request.urlopen(found[1], timeout=10) as response:
        text = response.read().decode()
    server.send_signal(SIGINT)

    assert 'fibaction_goals_total{action="count",status="SUCCEEDED"} 1.0' in text
    assert ended(server)[0] == 0


def test_without_prometheus_client_one_sentence_says_what_to_install(
    folder: Path, invoke: Invoke, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    result = invoke("serve", "robot:make", f"unix://{folder}/socket", "--metrics", ":0")

    assert result.exit_code == ExitCode.USAGE
    needs = "Error: --metrics needs prometheus-client: pip install 'fibaction[metrics]'\n"
    assert result.stderr == needs
