"""The topics of a client by themselves: which message goes when, and which is dropped."""

from __future__ import annotations

import json
import math

import pytest

from fibaction_transports.web.rosbridge.operations import Subscribe, SubscriptionQos
from fibaction_transports.web.rosbridge.server import watched_action
from fibaction_transports.web.rosbridge.server.watched_action import (
    STATUS_PERIOD,
    FeedbackOutlet,
    StatusOutlet,
)


def feedback(rate: float = 0, length: int = 0) -> FeedbackOutlet:
    outlet = FeedbackOutlet("/a")
    outlet.subscribe(Subscribe("/a", throttle_rate=rate, queue_length=length))
    return outlet


def test_a_queue_holds_the_newest_messages_until_their_time() -> None:
    outlet = feedback(rate=1000, length=2)
    assert outlet.offer("a", 10) == ["a"]
    for text in "bcd":
        assert outlet.offer(text, 10.5) == []
    assert outlet.due == 11
    assert outlet.take(10.9) == []
    assert outlet.take(11) == ["c"]
    assert outlet.offer("e", 11.5) == []
    assert (outlet.take(12), outlet.take(13), outlet.due) == (["d"], ["e"], math.inf)


def test_the_bytes_of_a_queue_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watched_action, "QUEUE_BYTES", 10)
    outlet = feedback(rate=1000, length=100)
    outlet.offer("first", 0)
    for text in ("a" * 6, "b" * 6, "c" * 4, "d" * 11):
        outlet.offer(text, 0)
    assert outlet.due == math.inf  # the last one alone has more, and drops all
    outlet.offer("e" * 6, 0)
    outlet.offer("f" * 4, 0)
    outlet.offer("g" * 4, 0)
    assert [outlet.take(number) for number in (1, 2, 3)] == [["ffff"], ["gggg"], []]


def test_of_several_subscriptions_the_most_demanding_one_counts() -> None:
    outlet = FeedbackOutlet("/a")
    outlet.subscribe(Subscribe("/a", "x", throttle_rate=1000, queue_length=5, fragment_size=3000))
    outlet.subscribe(
        Subscribe("/a", "y", throttle_rate=100, qos=SubscriptionQos(depth=1), fragment_size=2000)
    )
    outlet.offer("a", 0)
    outlet.offer("b", 0)
    outlet.offer("c" * 2001, 0)
    assert outlet.due == pytest.approx(0.1)
    first, second = map(json.loads, outlet.take(0.1))
    assert first["op"] == second["op"] == "fragment"
    assert (first["id"], len(first["data"]), second["data"]) == ("publish:/a", 2000, "c")
    outlet.unsubscribe("y")
    outlet.offer("d", 0.1)
    assert outlet.take(0.2) == ["d"]
    outlet.offer("e", 0.2)
    assert outlet.due == pytest.approx(1.2)
    outlet.unsubscribe(None)
    assert outlet.subscriptions == {}


def test_statuses_go_when_there_are_new_ones_and_only_the_newest() -> None:
    outlet = StatusOutlet("/a")
    outlet.subscribe(Subscribe("/a", throttle_rate=1000))
    assert outlet.take(5, 0, lambda topic: topic) == []
    outlet.note()
    assert outlet.due == -math.inf
    assert outlet.take(5, 0, lambda topic: f"{topic} 1") == ["/a 1"]
    assert outlet.due == math.inf
    outlet.note()
    outlet.note()
    assert outlet.due == 6
    assert outlet.take(5.5, 0, lambda topic: f"{topic} 2") == []
    assert outlet.take(6, 0, lambda topic: f"{topic} 3") == ["/a 3"]
    assert outlet.due == math.inf


def test_long_lists_of_statuses_go_less_often() -> None:
    outlet = StatusOutlet("/a")
    outlet.subscribe(Subscribe("/a"))
    outlet.note()
    outlet.take(1, 10_000, lambda topic: topic)
    outlet.note()
    assert outlet.due == 1 + 10_000 * STATUS_PERIOD
