"""The names of topics and types in DDS, and those that a node makes of its arguments."""

from __future__ import annotations

import pytest

from fibaction import TransportError
from fibaction_transports.ros2.on_dds.topics import (
    reply_topic,
    request_topic,
    ros_topic,
    topic_name,
)
from fibaction_transports.ros2.without_ros.messages.message_type import dds_type, ros_type
from fibaction_transports.ros2.without_ros.ros_arguments import (
    NameResolver,
    Override,
    RosArguments,
    node_name,
    read_arguments,
)


def test_topics_and_types_have_the_names_of_ros() -> None:
    assert topic_name("/robot/pick/_action/status") == "rt/robot/pick/_action/status"
    assert request_topic("/pick/_action/send_goal") == "rq/pick/_action/send_goalRequest"
    assert reply_topic("/pick/_action/send_goal") == "rr/pick/_action/send_goalReply"
    assert dds_type("std_msgs/msg/String") == "std_msgs::msg::dds_::String_"


def test_what_ros_has_not_named_has_no_name_in_ros() -> None:
    assert ros_topic("rt/chatter") == "/chatter"
    assert ros_topic("rtchatter") == ros_topic("rq/addRequest") == ""
    assert ros_type("std_msgs::msg::dds_::String_") == "std_msgs/msg/String"
    for name in ("Shape", "a::b::c::D_", "a::b::dds_::D"):
        assert ros_type(name) == name


def resolver(*words: str, name: str = "arm", namespace: str = "/robot") -> NameResolver:
    arguments = read_arguments(["program", "--ros-args", *words])
    return NameResolver(node_name(name, namespace, arguments), arguments)


@pytest.mark.parametrize(
    ("name", "full"),
    [
        ("pick", "/robot/pick"),
        ("/pick", "/pick"),
        ("a/b", "/robot/a/b"),
        ("~/pick", "/robot/arm/pick"),
        ("~", "/robot/arm"),
        ("{node}_pick", "/robot/arm_pick"),
        ("{ns}/pick", "/robot/pick"),
        ("{namespace}/pick", "/robot/pick"),
    ],
)
def test_a_name_is_expanded_in_the_namespace_of_the_node(name: str, full: str) -> None:
    assert resolver().resolve(name) == full


@pytest.mark.parametrize("name", ["", "/", "a//b", "a/", "1st", "a-b", "{robot}/a", "a b"])
def test_a_name_that_ros_does_not_allow_is_an_error(name: str) -> None:
    with pytest.raises(TransportError, match="is not a valid name in ROS"):
        resolver().resolve(name)


def test_names_are_remapped_as_full_names() -> None:
    names = resolver(
        "-r", "pick:=/grasp", "--remap", "rostopic://~/a:=b", "-r", "arm:c:=d", "-r", "leg:pick:=no"
    )
    assert names.resolve("pick") == names.resolve("/robot/pick") == "/grasp"
    assert names.resolve("/robot/arm/a") == "/robot/b"
    assert names.resolve("c") == "/robot/d"
    assert names.resolve("/pick") == "/pick"


def test_the_name_and_the_namespace_of_a_node_are_remapped() -> None:
    arguments = read_arguments(["--ros-args", "-r", "__node:=leg", "-r", "__ns:=/two/three"])
    assert str(node_name("arm", "", arguments)) == "/two/three/leg"
    assert str(node_name("arm", "robot", RosArguments())) == "/robot/arm"
    assert str(node_name("arm", "", RosArguments())) == "/arm"


@pytest.mark.parametrize(
    ("name", "namespace", "problem"),
    [
        ("1st", "", "invalid node_name '1st'"),
        ("", "", "invalid node_name ''"),
        ("arm", "a//b", "invalid namespace '/a//b'"),
        ("arm", "/a/", "invalid namespace '/a/'"),
    ],
)
def test_a_node_that_ros_does_not_allow_is_an_error(
    name: str, namespace: str, problem: str
) -> None:
    with pytest.raises(TransportError, match=problem):
        node_name(name, namespace, RosArguments())


def test_parameters_are_read_and_what_does_not_concern_a_node_is_left_alone() -> None:
    arguments = read_arguments(
        [
            "--verbose",
            "--ros-args",
            "-p",
            "use_sim_time:=true",
            "--param",
            "arm:speed:=2.5",
            "--log-level",
            "debug",
            "--disable-rosout-logs",
            "--",
            "-r",
            "not of ROS",
        ]
    )
    parameters = (
        Override("/**", "use_sim_time", "true", "-p use_sim_time:=true"),
        Override("/arm", "speed", "2.5", "--param arm:speed:=2.5"),
    )
    assert arguments == RosArguments((), parameters, has_rosout=False)
    more = ["--ros-args", "--disable-rosout-logs", "--disable-stdout-logs", "--enable-rosout-logs"]
    assert read_arguments(more) == RosArguments()


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["-r", "a"], "-r 'a': expected a rule such as old:=new"),
        (["-r"], "-r '': expected a rule"),
        (["-p", ":=1"], "-p ':=1': expected a rule"),
        (["--params"], "'--params' is not an argument of ROS that dds:// knows"),
    ],
)
def test_an_argument_that_is_not_understood_is_an_error(words: list[str], problem: str) -> None:
    with pytest.raises(TransportError) as caught:
        read_arguments(["--ros-args", *words])
    assert problem in str(caught.value)
