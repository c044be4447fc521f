"""`topic`, `service` and `param`, beside a node in a thread of the tests."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import anyio
import pytest
from anyio.from_thread import BlockingPortal, start_blocking_portal

from fibaction_transports.ros2 import Node, open_node
from tests.cli.conftest import Run, Start
from tests.support.processes import ended, lines_until
from tests.support.ros_domain import own_domain

STRING, BOOL = "std_msgs/msg/String", "std_srvs/srv/SetBool"
QUICK = ("--timeout", "0.1")


class Robot:
    """A node in another thread, for what the tests need of it."""

    def __init__(self, portal: BlockingPortal, node: Node) -> None:
        self.node = node
        self._portal = portal

    def do(self, call: Callable[..., Any], *given: Any) -> Any:
        return self._portal.call(call, *given)

    def keep_publishing(self, topic: str, message: dict[str, Any]) -> Any:
        publisher = self.do(self.node.publisher, topic, STRING)

        async def publish() -> None:
            while True:
                await publisher.publish(message)
                await anyio.sleep(0.01)

        return self._portal.start_task_soon(publish)


@pytest.fixture(scope="module")
def robot() -> Iterator[Robot]:
    with own_domain(), start_blocking_portal() as portal:
        with portal.wrap_async_context_manager(open_node("dds://robot", arguments=[])) as node:
            robot = Robot(portal, node)
            talk = robot.keep_publishing("/chatter", {"data": "hello"})
            yield robot
            talk.cancel()


@pytest.mark.usefixtures("robot")
def test_topics_are_listed_and_a_message_is_printed(here: Run) -> None:
    listed = here("topic", "list", "-u", "dds://")
    assert f"/chatter  {STRING}\n" in listed.out
    as_json = here("topic", "list", "-u", "dds://", "--json").out.splitlines()
    assert {"topic": "/chatter", "type": STRING} in map(json.loads, as_json)
    once = ("topic", "echo", "/chatter", "--once", "-u", "dds://")
    assert here(*once) == (0, "data: hello\n---\n", "")
    assert json.loads(here(*once, "--json").out) == {"data": "hello"}


@pytest.mark.processes
@pytest.mark.usefixtures("robot")
@pytest.mark.parametrize(
    ("verb", "line"),
    [("echo", "data: hello\n"), ("hz", "average rate: ")],
)
def test_messages_are_printed_and_counted_until_a_signal_comes(
    started: Start, verb: str, line: str
) -> None:
    process = started("topic", verb, "/chatter", "-u", "dds://")
    assert any(one.startswith(line) for one in lines_until(line, process))
    process.send_signal(signal.SIGINT)
    assert ended(process)[0] == 0


@pytest.mark.usefixtures("robot")
def test_the_rate_is_told_as_json_too(here: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    from fibaction.cli.verbs import topics

    async def a_while(act: Callable[[], Any]) -> None:
        with anyio.move_on_after(1.5):
            await act()

    monkeypatch.setattr(topics, "until_interrupted", a_while)
    told = here("topic", "hz", "/chatter", "-u", "dds://", "--json").out.splitlines()
    assert set(json.loads(told[0])) == {"rate", "min", "max", "window"}
    assert "average rate: " in here("topic", "hz", "/chatter", "-u", "dds://").out
    assert here("topic", "echo", "/chatter", "-u", "dds://").out.startswith("data: hello\n---\n")
    assert here("topic", "pub", "/x", STRING, "data: a", "--rate", "100", "-u", "dds://").code == 0


def test_a_message_is_published_once_when_someone_reads(robot: Robot, here: Run) -> None:
    heard = robot.do(robot.node.subscribe, "/heard", STRING)
    published = here("topic", "pub", "/heard", STRING, "data: now", "--once", "-u", "dds://")
    assert published == (0, "", "")
    assert robot.do(heard.next, 5).data == "now"


def test_a_service_is_called_and_its_answer_printed(robot: Robot, here: Run) -> None:
    def answer(request: Any) -> dict[str, Any]:
        return {"success": request.data, "message": "done"}

    with robot.do(partial(robot.node.serve_service, "/reset", BOOL, answer)):
        call = ("service", "call", "/reset", BOOL, "data: true", "-u", "dds://")
        assert here(*call) == (0, "success: true\nmessage: done\n", "")
        assert json.loads(here(*call, "--json").out) == {"success": True, "message": "done"}


@pytest.mark.usefixtures("robot")
def test_parameters_are_listed_read_and_refused(here: Run) -> None:
    at = ("-u", "dds://")
    assert here("param", "list", "/robot", *at) == (0, "use_sim_time: false\n", "")
    assert here("param", "get", "/robot", "use_sim_time", *at) == (0, "false\n", "")
    assert here("param", "get", "/robot", "use_sim_time", "--json", *at).out == "false\n"
    assert here("param", "set", "/robot", "use_sim_time", "false", *at) == (0, "", "")
    for verb, text in (
        (("get", "/robot", "speed"), "/robot has no parameter 'speed'"),
        (("set", "/robot", "speed", "1"), "there is no parameter 'speed', only 'use_sim_time'"),
        (("set", "/robot", "speed", "[1, a]"), "[1, 'a'] cannot be a parameter"),
    ):
        refused = here("param", *verb, *at)
        assert (refused.code, refused.out) == (2, "")
        assert text in refused.err


@pytest.mark.usefixtures("robot")
def test_what_is_not_there_is_one_sentence(here: Run) -> None:
    for given, text in (
        (("topic", "echo", "/nothing", *QUICK), "no node has had the topic /nothing in 0.1 s"),
        (("topic", "pub", "/x", STRING, "data: a", "--once", *QUICK), "nobody has subscribed"),
        (("topic", "pub", "/x", STRING, "dta: a"), "contains unknown field `dta`"),
        (("service", "call", "/nothing", BOOL, *QUICK), "there is no server in 0.1 s"),
    ):
        told = here(*given, "-u", "dds://")
        assert told.out == ""
        assert text in told.err
        assert told.err.count("\n") == 1
    elsewhere = here("topic", "list", "-u", "tcp://127.0.0.1:1")
    assert elsewhere.err == (
        "Error: tcp://127.0.0.1:1 has actions only: topics, services and parameters are at"
        " ros2://, dds:// and zenoh://\n"
    )
