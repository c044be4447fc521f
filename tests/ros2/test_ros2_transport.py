"""`ros2://`: URLs, invalid settings and their errors, and a node of the user's own."""

from __future__ import annotations

import importlib
import importlib.util
import subprocess
import sys
import uuid
from collections.abc import AsyncGenerator, Generator
from typing import Any

import anyio
import pytest

from fibaction import (
    Action,
    ActionServer,
    ConnectionLost,
    GoalHandle,
    InvalidURL,
    TransportError,
    connect,
    serve,
)
from fibaction.border.abc import ForwardingEndpoint
from fibaction.border.urls import transport_for
from fibaction_transports.ros2 import Ros2Transport, on_rclpy
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.ros2.spun import spun_node
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.processes import PATIENCE

pytestmark = pytest.mark.anyio


def namespace() -> str:
    """Return a namespace of its own."""
    return f"/t{uuid.uuid4().hex}"


def server(action: Action[Goal, Feedback, Result] = FIBONACCI) -> Any:
    return ActionServer(action, fibonacci)


def named(name: str, type_name: str = FIBONACCI.type_name) -> Any:
    return Action(name, goal=Goal, feedback=Feedback, result=Result, type_name=type_name)


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("ros2://robot/arm", "it has a path; a URL of ROS is, for example, ros2://node_name"),
        ("ros2://?feedback_depth=0", "feedback_depth must be between 1 and 100000, not 0"),
        ("ros2://?discovery_timeout=nan", "discovery_timeout must be between 0 and inf, not nan"),
        ("ros2://?reconnect_timeout=-1", "reconnect_timeout must be between 0 and inf, not -1.0"),
        ("ros2://?reconnect=yes", "ros2://: the setting 'reconnect' cannot be 'yes'"),
        (
            "ros2://?introspection=all",
            "introspection must be one of off, metadata, contents, not 'all'",
        ),
        (
            "ros2://?feedback_qos=best-effort",
            "invalid feedback_qos: 'best-effort' is not one of reliable, best_effort, volatile,",
        ),
        (
            "ros2://?status_qos=volatile,transient_local",
            "invalid status_qos: 'volatile,transient_local' has two words for durability",
        ),
    ],
)
def test_an_invalid_url_is_an_error_of_one_sentence(url: str, text: str) -> None:
    with pytest.raises(InvalidURL) as caught:
        transport_for(url)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "url",
    [
        "ros2://robot?token=secret",
        "ros2://[?token=secret",
        "ros2://robot?domain_id=233&namespace=/secret",
        "ros2://robot?domain_id=1&domain_id=2&token=secret",
    ],
)
def test_the_error_of_an_invalid_url_does_not_show_its_settings(url: str) -> None:
    with pytest.raises(InvalidURL) as caught:
        transport_for(url)
    assert "ros2://" in str(caught.value)
    assert "secret" not in str(caught.value)


def test_the_other_way_of_a_url_is_another_transport_in_code() -> None:
    with pytest.raises(ValueError, match="via='dds' is for URLs: use the transport of dds://"):
        Ros2Transport(via="dds")


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("ros2://1st", "invalid node_name '1st': it has letters, digits and _"),
        ("ros2://a%20b", "invalid node_name 'a%20b': it has letters, digits and _"),
        (
            "ros2://?namespace=a%20b",
            "invalid namespace '/a b': it has names of letters, digits and _ after slashes",
        ),
    ],
)
async def test_a_name_that_ros_does_not_allow_is_an_error_of_one_sentence(
    url: str, text: str
) -> None:
    with pytest.raises(TransportError) as caught:
        async with serve(server(), url):
            raise AssertionError("it is served")
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("domain", ["233", "-1", "arm"])
async def test_an_invalid_domain_in_the_environment_is_an_error_of_one_sentence(
    domain: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    with pytest.raises(TransportError) as caught:
        async with connect("ros2://"):
            raise AssertionError("the block must not run")
    assert str(caught.value) == (
        f"invalid ROS_DOMAIN_ID in the environment: {domain!r} is not a number from 0 to 232"
    )


@pytest.mark.parametrize("domain", ["", "232"])
async def test_a_valid_domain_in_the_environment_is_used(
    domain: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    async with connect("ros2://"):
        pass


async def test_an_action_of_ros_is_served_again_in_another_namespace() -> None:
    far, near = namespace(), namespace()
    with anyio.fail_after(PATIENCE):
        async with (
            serve(server(), f"ros2://?namespace={far}"),
            connect(f"ros2://?namespace={far}", FIBONACCI) as robot,
        ):
            await robot.wait_for_server()
            again = ForwardingEndpoint(robot.endpoint)
            async with (
                serve(again, f"ros2://?namespace={near}"),
                connect(f"ros2://?namespace={near}", FIBONACCI) as client,
            ):
                await client.wait_for_server()
                assert await client.call(Goal(3)) == Result([0, 1, 1, 2])


async def test_doctor_says_which_nodes_and_actions_are_heard() -> None:
    space = namespace()
    transport = Ros2Transport("doctor", namespace=space)
    with anyio.fail_after(PATIENCE):
        async with serve(server(), f"ros2://cook?namespace={space}"):
            while not (found := await transport.diagnose(0.5, "fibonacci")).is_found:
                pass
    (action,) = [one for one in found.facts["actions"] if one["name"].startswith(space)]
    assert action["servers"] == [f"{space}/cook"]
    assert f"{space}/cook" in found.facts["nodes"]
    assert found.advice == ()

    alone = await Ros2Transport(domain_id=101).diagnose(0.1)
    assert (alone.is_found, alone.advice) == (False, ("no other node was heard",))


async def test_arguments_that_ros_does_not_understand_are_an_error() -> None:
    transport = Ros2Transport(arguments=["--ros-args", "-r", "no rule"])
    with pytest.raises(TransportError, match="cannot make the ROS node 'fibaction_"):
        async with connect(transport):
            raise AssertionError("it is connected")


async def test_the_url_has_the_settings_that_a_client_must_share() -> None:
    place = namespace()
    transport = Ros2Transport(
        namespace=place,
        lease=5,
        services_qos="reliable",
        feedback_qos="best_effort, volatile",
        status_qos="volatile",
        feedback_depth=7,
    )
    with anyio.fail_after(10):
        async with serve(server(), transport) as (url,):
            assert url == transport.url
            assert url.startswith(f"ros2://?namespace={place}&lease=5&services_qos=reliable&")
            async with connect(url, FIBONACCI) as client:
                assert await client.call(Goal(2)) == Result([0, 1, 1])


async def test_all_mismatches_are_reported_before_anything_is_served() -> None:
    swapped = Action(
        "swapped", goal=Result, feedback=Feedback, result=Goal, type_name=FIBONACCI.type_name
    )
    servers = [
        ActionServer(swapped, fibonacci),  # type: ignore[arg-type]  # it is never run
        server(named("missing", "no_such_msgs/action/Fibonacci")),
        server(named("untyped", "")),
    ]
    with pytest.raises(TransportError) as caught:
        async with serve(servers, "ros2://"):
            raise AssertionError("it is served")
    for part in (
        "'swapped'",
        "goal.order",
        "result.sequence",
        "no_such_msgs",
        "give the Action 'untyped' a type_name",
    ):
        assert part in str(caught.value)


async def test_two_servers_of_one_name_are_an_error() -> None:
    place = f"ros2://?namespace={namespace()}"
    with pytest.raises(TransportError, match="two of the endpoints"):
        async with serve([server(), server(named("~/../fibonacci"[5:]))], place):
            raise AssertionError("it is served")


@pytest.mark.parametrize(
    ("name", "full"),
    [("fib", "{ns}/fib"), ("arm/fib", "{ns}/arm/fib"), ("~/fib", "{ns}/robot/fib"), ("/{top}", "")],
)
async def test_names_are_resolved_as_ros_does(name: str, full: str) -> None:
    place, top = namespace(), namespace()[1:]
    name = name.format(top=top)
    full = full.format(ns=place) or f"/{top}"
    url = f"ros2://robot?namespace={place}"
    with anyio.fail_after(10):
        async with serve(server(named(name)), url), connect(url) as connection:
            (info,) = [one for one in await connection.actions() if one.name in full]
            async with connect(url, named(full)) as client:
                assert await client.call(Goal(2)) == Result([0, 1, 1])
            plain = connection.client(Action.untyped(info))
            assert await plain.call({"order": 2}) == {"sequence": [0, 1, 1]}


async def test_names_and_the_namespace_can_be_remapped() -> None:
    place = namespace()
    rules = ["--ros-args", "-r", f"__ns:={place}", "-r", "fibonacci:=sequence"]
    with anyio.fail_after(10):
        async with (
            serve(server(), Ros2Transport(arguments=rules)) as (url,),
            connect(url, named("sequence")) as client,
            connect(Ros2Transport(arguments=rules), FIBONACCI) as other,
        ):
            assert url == f"ros2://?namespace={place}"
            assert await client.call(Goal(2)) == Result([0, 1, 1])
            assert await other.call(Goal(2)) == Result([0, 1, 1])


@pytest.fixture
def node() -> Generator[Any, None, None]:
    """A node that the user spins."""
    with spun_node(namespace()) as mine:
        yield mine


async def test_a_node_of_the_user_is_used_and_left_as_it_was(node: Any) -> None:
    before = list(node.waitables)
    transport = Ros2Transport(node=node)
    with anyio.fail_after(10):
        async with serve(server(), transport) as (url,), connect(transport, FIBONACCI) as client:
            assert url == transport.url == f"ros2://?namespace={node.get_namespace()}"
            assert await client.call(Goal(2)) == Result([0, 1, 1])
            async with connect(url, FIBONACCI) as other:
                assert await other.call(Goal(2)) == Result([0, 1, 1])
            assert transport.url == url
    assert list(node.waitables) == before


@pytest.mark.promise("GOAL-4")
@pytest.mark.parametrize("end", ["destroyed", "shut down"])
async def test_a_node_of_the_user_that_ends_too_early_ends_every_wait(node: Any, end: str) -> None:
    async def wait(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        await anyio.sleep_forever()
        yield Result([])

    mine, url = Ros2Transport(node=node), f"ros2://?namespace={node.get_namespace()}"
    with anyio.fail_after(20):
        async with (
            serve(ActionServer(named("here"), wait), mine),
            serve(ActionServer(named("there"), wait), url),
            connect(url, named("here")) as there,
            connect(mine, named("there")) as here,
        ):
            goals = [await client.send_goal(Goal(1)) for client in (there, here)]
            if end == "destroyed":
                node.executor.remove_node(node)
                node.destroy_node()
            else:
                node.context.try_shutdown()
            for goal, why in zip(goals, ("has gone away", f"was {end}"), strict=True):
                with pytest.raises(ConnectionLost, match=why):
                    await goal.result()


def test_a_node_and_its_description_cannot_be_given_both() -> None:
    with pytest.raises(ValueError, match="a node has its name"):
        Ros2Transport("robot", node=object())


def test_the_adapter_of_rclpy_cannot_be_imported_without_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as without:
        without.setattr(importlib.util, "find_spec", lambda name: None)
        with pytest.raises(TransportError, match=r"ros2:// needs rclpy.*setup\.bash"):
            importlib.reload(on_rclpy)
    importlib.reload(on_rclpy)


def test_without_rclpy_it_goes_over_dds_and_an_error_says_how_to_get_rclpy() -> None:
    code = (
        "import importlib.util as util; find = util.find_spec\n"
        "util.find_spec = lambda name, *rest: None if name == 'rclpy' else find(name, *rest)\n"
        "from fibaction.border.urls import transport_for\n"
        "print(type(transport_for('ros2://')).__name__)\n"
        "transport_for('ros2://?via=rclpy')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=False
    )
    assert done.stdout == "DdsTransport\n"
    assert "TransportError: ros2:// needs rclpy" in done.stderr
    assert "setup.bash" in done.stderr


def test_rclpy_is_imported_only_when_a_transport_is_made() -> None:
    code = (
        "import sys, fibaction, fibaction_transports.ros2\n"
        "from fibaction_transports.ros2.client import endpoint\n"
        "from fibaction_transports.ros2.server import action_server\n"
        "assert 'rclpy' not in sys.modules\n"
        "fibaction_transports.ros2.Ros2Transport()\n"
        "assert 'rclpy' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], timeout=30, check=True)
