"""The URL of a verb, and URLs that a verb cannot use."""

from __future__ import annotations

import inspect

import pytest

from fibaction.cli.arguments.options import URL
from fibaction.cli.process.exit_codes import ExitCode
from fibaction_transports.tcp import TcpTransport
from tests.cli.conftest import Invoke, Run

REACHING = [
    *(["list"], ["info", "x"], ["type", "x"], ["find", "x"], ["send_goal", "x"], ["goals"]),
    *(["goals", "-w"], ["cancel", "--all"], ["attach", "5f"], ["echo", "x"]),
]
"""Verbs that connect to a server, but for `top`, which needs a terminal."""


def test_the_url_is_that_of_the_verb_or_of_the_group_or_of_the_environment(
    invoke: Invoke, tcp: str, nobody: str
) -> None:
    assert invoke("list", "-c", url=tcp).output == "6\n"
    assert invoke("-u", tcp, "list", "-c", url=nobody).output == "6\n"
    assert invoke("-u", nobody, "list", "-c", "--url", tcp).output == "6\n"


def test_without_a_url_it_is_the_default_of_the_tcp_transport(invoke: Invoke) -> None:
    settings = inspect.signature(TcpTransport).parameters

    assert f"tcp://{settings['host'].default}:{settings['port'].default}" == URL
    assert f"default: {URL}" in " ".join(invoke("--help").output.split())


@pytest.mark.parametrize("verb", REACHING, ids=lambda verb: " ".join(verb))
def test_a_server_that_does_not_run_is_one_sentence(
    here: Run, nobody: str, verb: list[str]
) -> None:
    code, out, err = here(*verb, url=nobody)

    assert (code, out) == (ExitCode.UNREACHABLE, "")
    assert err.startswith(f"Error: no server listens at {nobody}")
    assert err.endswith(": start the server, or name another with --url or FIBACTION_URL\n")
    assert err.count("\n") == 1


@pytest.mark.parametrize("verb", [*REACHING, ["top"]], ids=lambda verb: " ".join(verb))
def test_a_url_of_one_process_is_rejected_by_all_that_would_reach_another(
    invoke: Invoke, verb: list[str]
) -> None:
    for result in (
        invoke("-u", "inproc://robot", *verb),
        invoke(*verb, "--url", "inproc://robot"),
        invoke(*verb, url="inproc://robot"),
    ):
        assert result.exit_code == ExitCode.USAGE
        assert result.output == (
            "Error: inproc://robot is for clients in the process of the server:"
            " between processes, use tcp:// or unix://\n"
        )
