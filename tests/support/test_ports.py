from __future__ import annotations

import socket
import subprocess
import sys

from tests.support.ports import BLOCK, free_port

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


def test_a_port_is_free_again_when_its_server_has_closed_its_connections() -> None:
    for _ in range(2 * BLOCK):
        with socket.create_server(("127.0.0.1", free_port())) as server:
            with socket.create_connection(server.getsockname()) as client:
                accepted, _ = server.accept()
                accepted.close()  # first, so that this end keeps the port for a minute
                assert client.recv(1) == b""
