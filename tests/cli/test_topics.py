"""`topic`, `service` and `param`, beside a node in a thread of the tests."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from copy import copy
from functools import partial
from typing import Any

import anyio
import pytest
from anyio.from_thread import BlockingPortal, start_blocking_portal

from fibaction.cli.verbs.topics import say_names
from fibaction_transports.ros2 import EndQos, Node, open_node
from fibaction_transports.ros2.without_ros.messages.message_type import ServiceType
from tests.cli.conftest import Run, Start
from tests.support.processes import ended, lines_until
from tests.support.ros_domain import own_domain
from tests.support.zenoh_router import own_router

STRING, BOOL = "std_msgs/msg/String", "std_srvs/srv/SetBool"
QUICK = ("--timeout", "0.1")


class Robot:
    """A node in another thread, for what the tests need of it."""

    def __init__(self, portal: BlockingPortal, node: Node, url: str) -> None:
        self.node = node
        self.at = "-u", url
        """The option with which a command finds it."""
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


@pytest.fixture(scope="module", params=["dds://", "zenoh:///"])
def robot(request: pytest.FixtureRequest) -> Iterator[Robot]:
    url: str = request.param
    with own_domain(), own_router(), start_blocking_portal() as portal:
        opening = open_node(f"{url}robot", arguments=[])
        with portal.wrap_async_context_manager(opening) as node:
            robot = Robot(portal, node, url)
            talk = robot.keep_publishing("/chatter", {"data": "hello"})
            yield robot
            talk.cancel()


def test_topics_are_listed_and_a_message_is_printed(robot: Robot, here: Run) -> None:
    began = time.monotonic()
    listed = here("topic", "list", *robot.at)
    assert time.monotonic() - began < 4  # it ends when discovery is complete
    assert "/chatter\n" in listed.out
    assert f"/chatter [{STRING}]\n" in here("topic", "list", "-t", *robot.at).out
    as_json = here("topic", "list", *robot.at, "--json").out.splitlines()
    assert {"topic": "/chatter", "type": STRING} in map(json.loads, as_json)
    once = "topic", "echo", "/chatter", "--once", *robot.at
    assert here(*once) == (0, "data: hello\n---\n", "")
    assert json.loads(here(*once, "--json").out) == {"data": "hello"}


def test_a_topic_is_described_with_its_ends_and_read_with_their_quality_of_service(
    robot: Robot, here: Run
) -> None:
    latched = robot.do(
        partial(robot.node.publisher, "/map", STRING, qos="best_effort,transient_local")
    )
    lasting = robot.do(partial(robot.node.publisher, "/kept", STRING, qos="keep_all"))
    robot.do(latched.publish, {"data": "kept"})
    assert here("topic", "echo", "/map", "--once", *robot.at).out == "data: kept\n---\n"
    told = here("topic", "info", "/map", *robot.at)
    assert told.out == f"Type: {STRING}\nPublisher count: 1\nSubscription count: 0\n"
    verbose = here("topic", "info", "/map", "-v", *robot.at).out
    for line in (
        "\nNode name: robot\nNode namespace: /\nTopic type: std_msgs/msg/String\n",
        "\nEndpoint type: PUBLISHER\nGID: ",
        (
            "\nQoS profile:\n  Reliability: BEST_EFFORT\n  History (Depth): KEEP_LAST (10)\n"
            "  Durability: TRANSIENT_LOCAL\n  Lifespan: Infinite\n  Deadline: Infinite\n"
            "  Liveliness: AUTOMATIC\n  Liveliness lease duration: Infinite\n"
        ),
        "\nTopic type hash: RIHS01_",
        "\nSubscription count: 0\n",
    ):
        assert line in verbose
    assert "(Depth): KEEP_ALL\n" in here("topic", "info", "/kept", "-v", *robot.at).out
    rosout = here("topic", "info", "/rosout", "-v", *robot.at).out
    assert "  Lifespan: 10 s\n" in rosout
    for end in (latched, lasting):
        robot.do(end.close)


@pytest.mark.processes
@pytest.mark.parametrize(
    ("verb", "line"),
    [("echo", "data: hello\n"), ("hz", "average rate: ")],
)
def test_messages_are_printed_and_counted_until_a_signal_comes(
    robot: Robot, started: Start, verb: str, line: str
) -> None:
    process = started("topic", verb, "/chatter", *robot.at)
    assert any(one.startswith(line) for one in lines_until(line, process))
    process.send_signal(signal.SIGINT)
    assert ended(process)[0] == 0


def test_the_rate_is_told_as_json_too(
    robot: Robot, here: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fibaction.cli.verbs import topics

    async def a_while(act: Callable[[], Any]) -> None:
        with anyio.move_on_after(1.5):
            await act()

    monkeypatch.setattr(topics, "until_interrupted", a_while)
    told = here("topic", "hz", "/chatter", *robot.at, "--json").out.splitlines()
    assert set(json.loads(told[0])) == {"rate", "min", "max", "std_dev", "window"}
    assert "s std dev: 0.0" in here("topic", "hz", "/chatter", *robot.at).out
    assert here("topic", "echo", "/chatter", *robot.at).out.startswith("data: hello\n---\n")
    assert here("topic", "pub", "/x", STRING, "data: a", "-r", "100", *robot.at).code == 0


def test_a_message_is_published_once_when_someone_reads(robot: Robot, here: Run) -> None:
    heard = robot.do(robot.node.subscribe, "/heard", STRING)
    published = here("topic", "pub", "/heard", STRING, "data: now", "--once", *robot.at)
    assert published == (0, "publishing #1: std_msgs.msg.String(data='now')\n\n", "")
    assert robot.do(heard.next, 5).data == "now"
    words = ("-t", "2", "-r", "100", "-w", "1", *robot.at)
    twice = here("topic", "pub", "/heard", STRING, "data: again", *words)
    assert "publishing #2: " in twice.out
    assert [robot.do(heard.next, 5).data for _ in range(2)] == ["again", "again"]
    many = ("-w", "2", "--timeout", "0.5", *robot.at)
    few = here("topic", "pub", "/heard", STRING, "data: x", *many)
    assert few.err == "Error: fewer than 2 have subscribed to /heard in 0.5 s\n"


def test_a_service_is_called_and_its_answer_printed(robot: Robot, here: Run) -> None:
    def answer(request: Any) -> dict[str, Any]:
        return {"success": request.data, "message": "done"}

    with robot.do(partial(robot.node.serve_service, "/reset", BOOL, answer)):
        listed = here("service", "list", *robot.at).out
        assert "/reset\n" in listed
        assert "/fibaction_" not in listed  # the node that lists them
        assert f"/reset [{BOOL}]\n" in here("service", "list", "-t", *robot.at).out
        call = ("service", "call", "/reset", BOOL, "data: true", *robot.at)
        assert here(*call) == (0, "success: true\nmessage: done\n", "")
        assert json.loads(here(*call, "--json").out) == {"success": True, "message": "done"}


def test_parameters_are_listed_read_dumped_and_refused(robot: Robot, here: Run) -> None:
    at = robot.at
    for name, value, told in (
        ("aim", 0.5, "Double value is: 0.5"),
        ("label", "a", "String value is: a"),
        ("names", ["a"], "String values are: ['a']"),
        ("raw", b"a", "Byte values are: b'a'"),
        ("wheels", 4, "Integer value is: 4"),
    ):
        robot.do(robot.node.parameters().declare, name, value)
        assert here("param", "get", "/robot", name, *at).out == f"{told}\n"
    names = "  aim\n  label\n  names\n  raw\n  use_sim_time\n  wheels\n"
    assert here("param", "list", "/robot", *at) == (0, names, "")
    assert here("param", "list", *at) == (0, f"/robot:\n{names}", "")
    assert here("param", "get", "/robot", "use_sim_time", *at).out == "Boolean value is: False\n"
    assert here("param", "get", "/robot", "aim", "--hide-type", *at) == (0, "0.5\n", "")
    assert here("param", "get", "/robot", "use_sim_time", "--json", *at).out == "false\n"
    done = (0, "Set parameter successful\n", "")
    assert here("param", "set", "/robot", "use_sim_time", "false", *at) == done
    assert here("param", "set", "/robot", "names", "[]", *at) == done
    assert here("param", "get", "/robot", "names", *at).out == "Empty values are: []\n"
    assert here("param", "set", "/robot", "aim", "1.5", *at) == done
    assert here("param", "set", "/robot", "label", "", *at) == done
    dumped = here("param", "dump", "/robot", *at).out
    assert dumped.startswith(
        "/robot:\n  ros__parameters:\n    aim: 1.5\n    label: ''\n    names: []\n"
    )
    for verb, text in (
        (("get", "/robot", "speed"), "/robot has no parameter 'speed'"),
        (("set", "/robot", "speed", "1"), "there is no parameter 'speed', only 'use_sim_time'"),
        (("set", "/robot", "speed", "[1, a]"), "[1, 'a'] cannot be a parameter"),
    ):
        refused = here("param", *verb, *at)
        assert (refused.code, refused.out) == (2, "")
        assert text in refused.err


def test_a_node_that_does_not_answer_keeps_no_other_from_being_listed(
    robot: Robot, here: Run
) -> None:
    async def never(request: Any) -> None:
        await anyio.sleep_forever()

    frozen = "/a/list_parameters", "rcl_interfaces/srv/ListParameters"
    with robot.do(partial(robot.node.serve_service, *frozen, never)):
        told = here("param", "list", "--timeout", "1", *robot.at)
    assert told.out.startswith("/robot:\n")
    assert "  use_sim_time\n" in told.out
    assert told.err == "Error: no answer in 1 s from /a\n"
    assert told.code == 6


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("/b/list_parameters", "/b/list_parameters: rcl_interfaces/srv/ListParameters_Response"),
        ("/b-c/list_parameters", "'/b-c' is not a valid name in ROS"),
    ],
)
def test_a_node_whose_answer_or_name_is_malformed_keeps_no_other_from_being_listed(
    robot: Robot, here: Run, name: str, problem: str
) -> None:
    ros = robot.node._ros
    service = ros.types.called_type("rcl_interfaces/srv/ListParameters").service
    response = copy(service.Response)
    response.codec = copy(response.codec)
    response.codec.encode = lambda value: b"\0\1\0\0\xff\xff\xff\xff"
    wrong = ServiceType(service.Request, response)

    async def serve() -> Any:
        def take(header: Any, request: Any) -> None:
            part.answer(header, None)

        part = ros.provider(name, wrong, EndQos(), take)
        return part

    part = robot.do(serve)
    told = here("param", "list", *robot.at)
    robot.do(ros.remove, part)
    assert (told.code, told.out.partition("\n")[0]) == (6, "/robot:")
    assert told.err.startswith(f"Error: {problem}")
    assert told.err.count("\n") == 1


def test_what_is_not_there_is_one_sentence(robot: Robot, here: Run) -> None:
    for given, text in (
        (("topic", "echo", "/nothing", *QUICK), "no node has had the topic /nothing in 0.1 s"),
        (("topic", "pub", "/x", STRING, "data: a", "--once", *QUICK), "nobody has subscribed"),
        (("topic", "pub", "/x", STRING, "dta: a"), "contains unknown field `dta`"),
        (("topic", "pub", "/x", STRING, "data: ["), "the message is not valid YAML"),
        (("service", "call", "/x", BOOL, "data: ["), "the request is not valid YAML"),
        (("param", "set", "/robot", "x", "["), "the value is not valid YAML"),
        (("topic", "info", "/nothing", *QUICK), "no node has had the topic /nothing in 0.1 s"),
        (("service", "call", "/nothing", BOOL, *QUICK), "there is no server in 0.1 s"),
    ):
        told = here(*given, *robot.at)
        assert told.out == ""
        assert text in told.err
        assert told.err.count("\n") == 1


def test_hidden_names_are_listed_if_all_are_wanted(capsys: pytest.CaptureFixture[str]) -> None:
    found = {"/a/_hidden": "T", "/seen": "T"}
    for is_all in (False, True):
        say_names(found, "topic", is_all=is_all, show_types=False, as_json=False)
    assert capsys.readouterr().out.split() == ["/seen", "/a/_hidden", "/seen"]
