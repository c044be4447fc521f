"""The quality of service of two ends: what does not match, and the words for it."""

from __future__ import annotations

import math
from typing import Any

import pytest

from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.client.diagnosis import explain_mismatch
from fibaction_transports.ros2.names import action_names
from fibaction_transports.ros2.node.parts import EndInfo
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.settings import RosSettings

MANUAL = EndQos(liveliness="manual_by_topic")


@pytest.mark.parametrize(
    ("offered", "wanted", "told", "advice"),
    [
        (EndQos(), EndQos(deadline=1), ("no deadline", "a deadline of 1 s"), ""),
        (EndQos(deadline=1), EndQos(deadline=1 - 1e-9), None, None),
        (EndQos(deadline=1), EndQos(), None, None),
        (EndQos(lease=2), EndQos(lease=0.5), ("a lease of 2 s", "a lease of 0.5 s"), ""),
        (EndQos(), MANUAL, ("liveliness automatic", "liveliness manual_by_topic"), ""),
        (MANUAL, EndQos(), None, None),
        (EndQos(liveliness="unknown"), MANUAL, None, None),
        (EndQos(lifespan=1), EndQos(lifespan=9), None, None),
        (
            EndQos(reliability="best_effort"),
            EndQos(durability="transient_local"),
            ("best_effort, volatile", "reliable, transient_local"),
            "qos='best_effort,volatile'",
        ),
        (
            EndQos(reliability="best_effort"),
            EndQos(deadline=2),
            ("best_effort, no deadline", "reliable, a deadline of 2 s"),
            "",
        ),
    ],
)
def test_a_difference_is_told_as_both_sides_have_it(
    offered: EndQos, wanted: EndQos, told: Any, advice: str | None
) -> None:
    assert qos.difference(offered, wanted) == told
    if advice is not None:
        assert qos.advice(offered, wanted) == (advice or "an EndQos that wants no more")


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ("fast", "qos: 'fast' is not one of reliable, .*, nor one of default, sensor_data"),
        ("keep_all,keep_last", "two words for history"),
        ("keep_all,transient_local", "keep_all with transient_local would keep every message"),
        (EndQos(reliability="keep_all"), "'keep_all' is no reliability"),
        (EndQos(durability=["volatile"]), r"\['volatile'\] is no durability"),  # type: ignore[arg-type]  # as a program without types
        (EndQos(liveliness="manual"), "'manual' is no liveliness"),
        (EndQos(depth=0), "depth must be at least 1"),
        (EndQos(deadline=0), "deadline must be positive, not 0"),
        (EndQos(lease=0.0), r"lease must be positive, not 0\.0"),
        (EndQos(lifespan=math.nan), "lifespan must be positive, not nan"),
    ],
)
def test_a_quality_of_service_that_there_is_not_is_refused(given: object, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        qos.of_topic(given)


def test_a_quality_of_service_is_a_text_or_all_of_it() -> None:
    with pytest.raises(TypeError, match="qos is a text such as 'best_effort' or an EndQos"):
        qos.of_topic(None)


class Graph:
    """A node that sees one server, whose services want a deadline."""

    matches_by_qos = True

    def publishers(self, topic: str) -> list[EndInfo]:
        return []

    answer_writers = publishers

    def request_readers(self, service: str) -> list[EndInfo]:
        return [EndInfo(b"gid", "/far", EndQos(deadline=1))]


def test_a_policy_for_which_no_setting_is_there_is_a_matter_of_the_server() -> None:
    graph: Any = Graph()
    told = explain_mismatch(graph, action_names(str, "/stir"), RosSettings())
    wrong = "service send_goal: it wants a deadline of 1 s, and this client offers no deadline;"
    assert wrong in told
    assert told.endswith("; change the server")
    graph.matches_by_qos = False  # as over Zenoh, where all of them hear each other
    assert explain_mismatch(graph, action_names(str, "/stir"), RosSettings()) == ""
