"""`ping`: the round trip to a server, and what it offers."""

from __future__ import annotations

import json
import re

import pytest

from fibaction import ServerNotFound, serve
from fibaction._api import ClientConnection
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import round_trip
from fibaction.cli.verbs.round_trip import ping
from fibaction.words.goals import ActionPeers
from tests.cli.conftest import Run
from tests.cli.served import Served, counter

LINES = re.compile(
    r"(?P<url>\S+) answers: \d+\.\d ms, the first time \d+\.\d ms\n"
    r"fibaction \d+\.\d+\.\d+ here, version 1 of the protocol at both ends\n"
    r"Actions: 6\n"
    r"    /arm/pick \[arm/action/Pick\]: 1 server, \d+ clients?\n"
    r"    /fibonacci "
)


def test_ping_measures_and_tells_what_is_offered(here: Run, tcp: str, nobody: str) -> None:
    code, out, err = here("ping", tcp, url=nobody)
    found = LINES.match(out)

    assert (code, err) == (0, "")
    assert found
    assert found["url"] == tcp


def test_ping_as_json_has_the_names_of_all(here: Run, url: str) -> None:
    found = json.loads(here("ping", "--json", url=url).out)

    assert found["protocol"] == 1
    assert min(found["round_trip"], found["first_answer"]) > 0
    (fibonacci,) = (one for one in found["actions"] if one["name"] == "fibonacci")
    assert fibonacci["type"] == "arduinobot_msgs/action/Fibonacci"
    assert len(fibonacci["servers"]) == 1


def test_a_server_that_does_not_run_is_told(here: Run, tcp: str, nobody: str) -> None:
    code, out, err = here("ping", nobody, url=tcp)

    assert (code, out) == (ExitCode.UNREACHABLE, "")
    assert err.startswith("Error: no server listens at ")


@pytest.mark.asyncio
async def test_an_action_that_stops_meanwhile_has_no_peers(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def gone(_: ClientConnection, action: str) -> ActionPeers:
        raise ServerNotFound(action)

    monkeypatch.setattr(ClientConnection, "peers", gone)
    async with serve(counter("count"), "inproc://pinged"):
        await ping("inproc://pinged", as_json=False)

    assert "    /count: 0 servers, 0 clients\n" in capsys.readouterr().out


@pytest.mark.asyncio
@pytest.mark.parametrize("url", ["ros2://", "rosbridge://robot:9090"])
async def test_over_another_protocol_no_version_of_it_is_told(
    url: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Connecting:
        async def __aenter__(self) -> ClientConnection:
            return Served().connection

        async def __aexit__(self, *_: object) -> None: ...

    monkeypatch.setattr(round_trip, "connect", lambda _: Connecting())
    await ping(url, as_json=False)

    assert re.search(r"fibaction [\d.]+ here\nActions: 0\n$", capsys.readouterr().out)
