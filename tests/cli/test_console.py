"""`console`: as a process, and piece by piece in this one."""

from __future__ import annotations

import json
import re
import signal
import urllib.error
import urllib.request
import webbrowser
from pathlib import Path
from signal import SIGTERM

import pytest

from fibaction.cli.bridge.sources import named_urls
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import bridge
from tests.cli.conftest import Invoke, Run, Start
from tests.support.processes import ended, lines_until

ADDRESS = re.compile(r"console of (\S+) at (http://127\.0\.0\.1:\d+)/#token=(\S+) , Ctrl-C")


def fetched(url: str, token: str = "") -> tuple[int, bytes]:
    """Return the status and the body of an answer."""
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as exc:
        with exc:
            return exc.code, b""


@pytest.mark.parametrize("number", [signal.SIGINT, SIGTERM])
def test_the_page_and_the_actions_are_served_until_a_signal_comes(
    started: Start, here: Run, tcp: str, number: signal.Signals
) -> None:
    process = started("console", tcp, "--no-open")
    found = ADDRESS.search(lines_until("console of", process)[-1])
    assert found is not None
    there, url, token = found.groups()
    assert there == tcp
    status, page = fetched(f"{url}/")
    assert (status, b"fibaction console" in page) == (200, True)
    assert fetched(f"{url}/actions")[0] == 401
    names = [info["name"] for info in json.loads(fetched(f"{url}/actions", token)[1])]
    assert "fibonacci" in names
    done = here("send_goal", "fibonacci", "order: 4", url=f"{url}?token={token}")
    assert (done.code, done.lines[-1]) == (0, "Goal finished with status: SUCCEEDED")
    process.send_signal(number)
    assert ended(process).code == 0


def test_several_servers_are_each_in_a_namespace_and_come_and_go_without_the_others(
    started: Start, here: Run, tcp: str, nobody: str
) -> None:
    process = started("console", f"arm={tcp}", tcp, nobody, "--no-open")
    found = ADDRESS.search(lines_until("console of", process)[-1].replace(", ", "+", 2))
    assert found is not None
    there, url, token = found.groups()
    assert there == f"{tcp}+{tcp}+{nobody}"
    while fetched(f"{url}/readyz/arm")[0] != 200 or fetched(f"{url}/readyz/tcp")[0] != 200:
        pass
    arm, named, away = json.loads(fetched(f"{url}/servers", token)[1])
    assert (arm["name"], named["name"], away["name"]) == ("arm", "tcp", "tcp_2")
    assert (arm["url"], away["url"]) == (tcp, nobody)
    assert ("arm/fibonacci" in arm["actions"], "tcp/fibonacci" in named["actions"]) == (True, True)
    assert (away["actions"], "away" in arm) == ([], False)
    assert "no server listens" in away["away"]["reason"]
    assert (fetched(f"{url}/servers")[0], fetched(f"{url}/topics")[0]) == (401, 401)
    assert fetched(f"{url}/topics", token) == (200, b"{}")
    assert fetched(f"{url}/topics/arm/odom", token)[0] == 404
    assert fetched(f"{url}/readyz") == (503, b"")
    assert fetched(f"{url}/healthz") == (200, b"1 of 3 servers are away\n")
    assert (fetched(f"{url}/readyz/tcp_2")[0], fetched(f"{url}/readyz/nothing")[0]) == (503, 401)
    done = here("send_goal", "arm/fibonacci", "order: 4", url=f"{url}?token={token}")
    assert (done.code, done.lines[-1]) == (0, "Goal finished with status: SUCCEEDED")
    process.send_signal(SIGTERM)
    assert ended(process).code == 0


def test_a_server_without_a_name_has_that_of_its_host_or_its_scheme() -> None:
    urls = ["tcp://arm:7400", "nats://arm-2/fleet", "dds://", "tcp://10.0.0.7", "tcp://[::1]:1"]
    assert list(named_urls(urls)) == ["arm", "arm_2", "dds", "tcp", "tcp_2"]
    assert named_urls(["tcp://arm?token=a=b"]) == {"": "tcp://arm?token=a=b"}


@pytest.mark.parametrize(
    ("environment", "platform", "can"),
    [
        ({"DISPLAY": ":0"}, "linux", True),
        ({"WAYLAND_DISPLAY": "w"}, "linux", True),
        ({"BROWSER": "x"}, "linux", True),
        ({}, "linux", False),
        ({}, "darwin", True),
    ],
)
def test_a_browser_is_opened_where_there_are_windows(
    environment: dict[str, str], platform: str, can: bool
) -> None:
    assert bridge.can_open(environment, platform) is can


@pytest.mark.parametrize("shown", ["a server", "servers", "a recording"])
def test_no_browser_is_opened_where_none_is_wanted(
    shown: str, tmp_path: Path, invoke: Invoke, tcp: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "today.jsonl"
    file.write_text('{"time":1,"event":"server","action":"count"}\n')
    monkeypatch.setattr(bridge, "say", lambda _: signal.raise_signal(SIGTERM))
    monkeypatch.setattr(webbrowser, "open", pytest.fail)
    given = {"a server": [tcp], "servers": [tcp, tcp], "a recording": [str(file)]}[shown]
    result = invoke("console", *given, "--no-open")
    assert result.exit_code == ExitCode.SUCCEEDED


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The addresses that the browser is told to open; the command is stopped then."""
    found: list[str] = []

    def open_and_stop(address: str) -> None:
        found.append(address)
        signal.raise_signal(SIGTERM)

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", open_and_stop)
    return found


def test_the_browser_gets_the_address_with_the_token(
    invoke: Invoke, tcp: str, opened: list[str]
) -> None:
    result = invoke("console", tcp)
    assert result.exit_code == 0
    found = ADDRESS.search(result.stdout)
    assert found is not None
    assert opened == [f"{found[2]}/#token={found[3]}"]


def test_a_recording_is_served_with_the_page_until_a_signal_comes(
    tmp_path: Path, invoke: Invoke, started: Start, opened: list[str]
) -> None:
    file = tmp_path / "to day.jsonl"
    file.write_text('{"time":1,"event":"server","action":"count"}\n')
    process = started("console", str(file), "--no-open")
    line = lines_until("console of", process)[-1]
    found = re.search(
        r"at (http://127\.0\.0\.1:\d+)/\?recording=to%20day\.jsonl#token=(\S+) ,", line
    )
    assert found is not None
    url, token = found.groups()
    assert fetched(f"{url}/recording")[0] == 401
    assert fetched(f"{url}/recording", token) == (200, file.read_bytes())
    assert fetched(f"{url}/actions", token) == (200, b"[]")
    process.send_signal(SIGTERM)
    assert ended(process).code == 0

    assert invoke("console", str(file)).exit_code == 0
    assert ["/?recording=to%20day.jsonl#token=" in address for address in opened] == [True]
