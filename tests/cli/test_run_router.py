"""`router`: as a process, and in this one."""

from __future__ import annotations

import signal
import socket

import pytest

from fibaction.cli.verbs import run_router
from tests.cli.conftest import Run, Start
from tests.support.ports import free_port
from tests.support.processes import ended, lines_until

NOT_HERE = "192.0.2.1"
"""An address for documentation, which no machine has."""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_router_listens_here_until_a_signal_comes(started: Start, number: signal.Signals) -> None:
    port = free_port()
    process = started("router", "--port", str(port))
    assert lines_until("router", process) == [f"router at tcp/localhost:{port}, Ctrl-C stops it\n"]
    socket.create_connection(("localhost", port), timeout=5).close()
    process.send_signal(number)

    assert ended(process) == (0, "", "")


def test_a_port_in_use_and_an_address_elsewhere_are_one_sentence(here: Run) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        taken = here("router", "--host", "127.0.0.1", "--port", port)
    elsewhere = here("router", "--host", NOT_HERE, "--port", port)

    assert (taken.code, taken.out) == (2, "")
    assert taken.err == (
        f"Error: the router cannot listen at tcp/127.0.0.1:{port}, which is in use: another router"
        " may be running there, or give --port\n"
    )
    assert (elsewhere.code, elsewhere.out) == (2, "")
    assert elsewhere.err.startswith(f"Error: the router cannot listen at tcp/{NOT_HERE}:{port}: ")
    assert elsewhere.err.count("\n") == 1
    assert ".rs" not in elsewhere.err


def test_an_address_of_ipv6_has_brackets_in_its_locator(
    here: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []

    def say_and_stop(text: str) -> None:
        said.append(text)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(run_router, "say", say_and_stop)
    ports = free_port(), free_port()
    for host, port in zip(("::1", "[::1]"), ports, strict=True):
        assert here("router", "--host", host, "--port", str(port)) == (0, "", "")

    assert said == [f"router at tcp/[::1]:{port}, Ctrl-C stops it" for port in ports]
