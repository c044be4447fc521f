"""Keys, tokens and attachments as `rmw_zenoh_cpp` 0.6.7 (ROS 2 Kilted) has them."""

from __future__ import annotations

import math
from itertools import count

import pytest

from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.node.parts import NO_HASH
from fibaction_transports.ros2.node.rivals import PARTICIPANT
from fibaction_transports.ros2.on_zenoh.graph import ZenohGraph
from fibaction_transports.ros2.on_zenoh.keys import (
    ANY_HASH,
    CLIENT,
    MOST_CHARACTERS,
    PUBLISHER,
    SERVER,
    SUBSCRIPTION,
    Attachment,
    NodeTokens,
    attachment,
    key_of,
    read_attachment,
    read_token,
    wire_gid,
)
from fibaction_transports.ros2.qos import EndQos

# Recorded from the action server of rclpy.
SESSION = "bf549544a8595191a185d94958f38048"
NODE = f"@ros2_lv/91/{SESSION}/0/0/NN/%/%/stock_server"
GOALS = (
    f"@ros2_lv/91/{SESSION}/0/10/SS/%/%/stock_server/%fibonacci%_action%send_goal/"
    "test_msgs::action::dds_::Fibonacci_SendGoal_/"
    "RIHS01_d807633803e38e164276573cd97e9fbd71e109c290bbf4cc312a0a1c9da7bbd9/::,10:,:,:,,"
)
STATUSES = (
    f"@ros2_lv/91/{SESSION}/0/14/MP/%/%/stock_server/%fibonacci%_action%status/"
    "action_msgs::msg::dds_::GoalStatusArray_/"
    "RIHS01_6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e/:1:,1:,:,:,,"
)
ROSOUT = (
    f"@ros2_lv/91/{SESSION}/0/1/MP/%/%/stock_server/%rosout/rcl_interfaces::msg::dds_::Log_/"
    "RIHS01_e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac/:1:,1000:,:10,0:,,"
)
STATUS_KEY = (
    "91/fibonacci/_action/status/action_msgs::msg::dds_::GoalStatusArray_/"
    "RIHS01_6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e"
)
STATUS_WORDS = bytes.fromhex("0f0000000000000098f556c8a359ec18100282a067dbdc513b9a0268529ebc3e7b")


def test_the_tokens_of_a_server_of_rclpy_are_read() -> None:
    node, goals, statuses = map(read_token, (NODE, GOALS, STATUSES))
    assert node is not None
    assert goals is not None
    assert statuses is not None
    assert (node.node, node.topic) == ("/stock_server", "")
    assert (goals.kind, goals.node) == (SERVER, "/stock_server")
    assert goals.topic == "/fibonacci/_action/send_goal"
    assert goals.type_name == "test_msgs/action/Fibonacci_SendGoal"
    assert goals.type_hash.startswith("RIHS01_d8076338")
    assert goals.qos == EndQos(depth=10)
    assert statuses.qos == EndQos(durability="transient_local", depth=1)
    log = read_token(ROSOUT)
    assert log is not None
    assert log.qos == EndQos(durability="transient_local", depth=1000, lifespan=10)
    assert statuses.key == STATUS_KEY
    assert statuses.gid[PARTICIPANT] == goals.gid[PARTICIPANT]
    assert statuses.gid != goals.gid


def test_the_words_of_a_message_name_its_publisher() -> None:
    assert read_attachment(STATUS_WORDS) == Attachment(15, wire_gid(STATUSES))
    graph = ZenohGraph()
    graph.add(STATUSES)
    (server,) = graph.publishers("/fibonacci/_action/status")
    assert graph.publisher(wire_gid(STATUSES)) == server.gid
    assert graph.publisher(bytes(16)) == b""


def test_our_tokens_and_words_are_those_of_rclpy() -> None:
    made = NodeTokens(91, SESSION, count(), "/", "stock_server")
    assert made.node() == NODE
    words = STATUSES.split("/")
    status = made.end(
        PUBLISHER,
        "/fibonacci/_action/status",
        "action_msgs/msg/GoalStatusArray",
        words[-2],
        qos.published_status(math.inf),
    )
    assert status.replace("/0/1/MP/", "/0/14/MP/") == STATUSES
    assert key_of(
        91, "/fibonacci/_action/status", "action_msgs/msg/GoalStatusArray", words[-2]
    ) == (STATUS_KEY)
    assert len(attachment(7, bytes(16))) == len(STATUS_WORDS)
    assert read_attachment(attachment(7, bytes(range(16)))) == Attachment(7, bytes(range(16)))


def test_a_name_in_a_namespace_keeps_its_slashes_and_a_weak_qos_is_told() -> None:
    made = NodeTokens(0, SESSION, count(), "/robot/left", "arm")
    weak = EndQos(
        reliability="best_effort",
        depth=5,
        deadline=0.25,
        lifespan=3,
        liveliness="manual_by_topic",
        lease=1.5,
    )
    found = read_token(made.end(SUBSCRIPTION, "/robot/left/a", "a_msgs/msg/A", ANY_HASH, weak))
    assert found is not None
    assert (found.node, found.topic, found.qos) == ("/robot/left/arm", "/robot/left/a", weak)
    assert found.type_hash == NO_HASH


@pytest.mark.parametrize(
    "token",
    [
        "",
        "@ros2_lv",
        NODE.replace("@ros2_lv", "@other"),
        NODE.replace("/91/", "/x/"),
        NODE.replace("/91/", "/" + "9" * 12 + "/"),
        NODE.replace("/NN/", "/XX/"),
        GOALS.rpartition("/")[0],
        GOALS.replace("/SS/", "/XX/"),
        GOALS.replace("::,10:,:,:,,", "nothing"),
        GOALS.replace("::,10:,:,:,,", "::,x:,:,:,,"),
        GOALS.replace("::,10:", "::," + "1" * 30 + ":"),
        GOALS.replace("stock_server", "s" * MOST_CHARACTERS),
    ],
)
def test_a_token_that_is_not_of_ros_is_ignored(token: str) -> None:
    graph = ZenohGraph()
    graph.add(token)
    assert graph.discovery().known == 0
    assert graph.nodes() == set()
    graph.remove(token)


def test_a_duration_that_is_none_counts_as_without_an_end() -> None:
    found = read_token(GOALS.replace("::,10:,:,:,,", "::,10:x,5:,:,,"))
    assert found is not None
    assert found.qos is not None
    assert found.qos.deadline == math.inf


def test_a_token_of_a_later_release_may_have_more_fields() -> None:
    found = read_token(f"{GOALS}/backends:cpu:1")
    assert found is not None
    assert found.topic == "/fibonacci/_action/send_goal"


@pytest.mark.parametrize("words", [b"", STATUS_WORDS[:-1], STATUS_WORDS.replace(b"\x10", b"\x11")])
def test_words_that_are_not_of_ros_are_none(words: bytes) -> None:
    assert read_attachment(words) is None


def test_the_graph_has_what_the_tokens_tell(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    graph = ZenohGraph()
    for token in (NODE, GOALS, GOALS, STATUSES, ROSOUT):
        graph.add(token)
    assert (graph.discovery().known, graph.discovery().pending) == (4, 1)
    graph.note_complete()
    assert graph.discovery().pending == 0
    assert graph.nodes() == {"/stock_server"}
    assert dict(graph.topics())["/rosout"] == "rcl_interfaces/msg/Log"
    service = "/fibonacci/_action/send_goal"
    assert graph.request_readers(service) == graph.answer_writers(service)
    assert [one.node for one in graph.request_readers(service)] == ["/stock_server"]
    assert graph.count_publishers("/rosout") == 1
    assert graph.count_subscriptions("/rosout") == graph.count_callers(service) == 0
    assert graph.subscriptions("/rosout") == []
    right, wrong = GOALS.split("/")[-2], f"RIHS01_{0:064}"
    counts = [graph.count_connected(SERVER, service, one) for one in (right, wrong, ANY_HASH)]
    assert counts == [1, 0, 1]
    assert graph.count_connected(CLIENT, service, right) == 0
    graph.remove(GOALS)
    graph.remove(GOALS)
    assert graph.request_readers(service) == []
    monkeypatch.setattr("fibaction_transports.ros2.on_zenoh.graph.MOST_TOKENS", 3)
    for number in range(3):
        graph.add(NODE.replace("/0/0/", f"/0/{number + 50}/"))
    assert graph.discovery().known == 5
    assert len(caplog.records) == 1
    assert "more than 3 tokens of ROS" in caplog.text
