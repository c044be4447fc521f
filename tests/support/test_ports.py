from __future__ import annotations

import subprocess
import sys

from tests.support.ports import free_port

SOME = 400


def test_no_two_processes_get_the_same_port() -> None:
    program = f"from tests.support.ports import *; print(*(free_port() for _ in range({SOME})))"
    own = {free_port() for _ in range(SOME)}
    others = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    )
    found = {int(port) for port in others.stdout.split()}
    assert len(own) == len(found) == SOME
    assert not own & found
