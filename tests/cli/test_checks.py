"""`wait`, `ping` and `doctor`: the connection to a server."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import anyio
import pytest

from fibaction import AuthenticationFailed, ServerNotFound, serve
from fibaction._api import ClientConnection
from fibaction.border.abc import Diagnosis
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import checks
from fibaction.cli.verbs.checks import lines, ping, wait
from fibaction.words.goals import ActionPeers
from tests.cli.conftest import Invoke, Run
from tests.cli.served import Served, counter
from tests.support.ros_domain import own_domain


def test_an_action_that_is_served_is_not_waited_for(here: Run, url: str) -> None:
    assert here("wait", "/fibonacci", "wait", url=url) == (0, "", "")


def test_an_action_that_does_not_come_is_an_error(here: Run, tcp: str, nobody: str) -> None:
    # Long enough for a busy machine to hear of the one that is served.
    assert here("wait", "wait", "b", "a", "-t", "3", url=tcp) == (
        ExitCode.UNREACHABLE,
        "",
        "Error: /a, /b: not served within 3 s\n",
    )
    code, _, err = here("wait", "wait", "-t", "0.01", url=nobody)
    assert (code, err) == (ExitCode.UNREACHABLE, "Error: /wait: not served within 0.01 s\n")


@pytest.mark.asyncio
async def test_a_server_that_starts_later_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "LOOK_PAUSE", 0.001)
    server = counter("count")
    with anyio.fail_after(10):
        async with serve(counter("reserve"), "tcp://127.0.0.1:0") as (url,):
            pass  # its port is free again
        async with anyio.create_task_group() as tasks:

            async def start() -> None:
                await anyio.wait_all_tasks_blocked()
                async with serve(server, url):
                    await found.wait()

            found = anyio.Event()
            tasks.start_soon(start)
            assert await wait(url, ["count"], None) == 0
            found.set()


@pytest.mark.asyncio
async def test_a_server_that_rejects_the_client_is_not_waited_for() -> None:
    served = Served()
    served.error = AuthenticationFailed("wrong token")
    with pytest.raises(AuthenticationFailed):
        await checks._served(served.connection)


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

    monkeypatch.setattr(checks, "connect", lambda _: Connecting())
    await ping(url, as_json=False)

    assert re.search(r"fibaction [\d.]+ here\nActions: 0\n$", capsys.readouterr().out)


QUICK = ("--seconds", "0.01")


@pytest.fixture(scope="module", autouse=True)
def domain() -> Iterator[None]:
    """Take a domain that no other test run has."""
    with own_domain():
        yield


def test_nothing_is_found_where_nothing_is_and_the_advice_says_so(invoke: Invoke) -> None:
    done = invoke("doctor", *QUICK)

    assert done.exit_code == ExitCode.UNREACHABLE
    assert "Discovery: range LOCALHOST, from ROS_AUTOMATIC_DISCOVERY_RANGE\n" in done.output
    assert "Participants: none\n" in done.output
    assert "Advice: no datagram of another participant has arrived, and other" in done.output


def test_the_diagnosis_as_json_is_one_value(invoke: Invoke) -> None:
    told = json.loads(invoke("doctor", "dds://?lease=3", "--json", *QUICK).output)

    assert (told["url"], told["found"], told["participants"]) == ("dds://", False, [])
    assert len(told["advice"]) == 1


def test_another_url_is_connected_to(here: Run, tcp: str) -> None:
    code, out, _ = here("doctor", tcp, "-a", "/fibonacci")

    assert code == ExitCode.SUCCEEDED
    assert out.startswith("Actions: 6\n    name ")


def test_an_action_that_is_not_served_has_the_code_of_what_is_not_found(
    here: Run, tcp: str
) -> None:
    code, out, _ = here("doctor", "-a", "dance", url=tcp)

    assert code == ExitCode.UNREACHABLE
    assert out.endswith("Advice: the server answers, and does not serve 'dance'\n")


def test_the_url_before_the_verb_counts(here: Run, nobody: str) -> None:
    code, out, err = here("-u", nobody, "doctor")

    assert (code, out) == (ExitCode.UNREACHABLE, "")
    assert err.startswith(f"Error: no server listens at {nobody}")


def test_each_value_has_a_form_for_readers() -> None:
    facts = {
        "own_ports": {"first_one": 1, "names": ["a", "b"], "none": [], "is": True, "was": False},
        "peers": ["x", {"host": "y"}],
        "rest": [],
    }
    assert list(lines(Diagnosis(False, facts, ("look",)))) == [
        "Own ports: first one 1, names a b, none none, is yes, was no",
        "Peers: 2",
        "    x",
        "    host y",
        "Rest: none",
        "Advice: look",
    ]
