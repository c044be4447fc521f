"""Quality of service of an action's parts: that of rcl_action (`rcl_action/default_qos.h`), unless
a setting changes it.

The depths are larger than those of rcl_action. They need not match at the two ends: a depth is
only the length of the queue of one reader or writer.
"""

from __future__ import annotations

from typing import Any

from fibaction_transports.ros2.rcl import Duration, rclpy_qos

REQUEST_DEPTH = 1000
"""Requests, or answers, that may wait to be taken. rcl_action's 10 overflow when 11 arrive at once,
and a lost request is noticed only by its missing answer."""
STATUS_DEPTH = 100
"""Status lists that may wait to be taken. rcl_action's 1 hides all but the last."""

COUNT_DEPTH = 100
"""Numbers of feedback messages that are kept for a client that is connected later."""

_RELIABILITY, _DURABILITY = rclpy_qos.ReliabilityPolicy, rclpy_qos.DurabilityPolicy
_POLICIES: dict[str, tuple[str, Any]] = {
    "reliable": ("reliability", _RELIABILITY.RELIABLE),
    "best_effort": ("reliability", _RELIABILITY.BEST_EFFORT),
    "volatile": ("durability", _DURABILITY.VOLATILE),
    "transient_local": ("durability", _DURABILITY.TRANSIENT_LOCAL),
}


def policies(text: str) -> dict[str, Any]:
    """Return the policies in a setting: words of ROS with commas, for example
    `best_effort,volatile`. An empty text changes nothing.

    Raises:
        ValueError: A word is not a policy, or two of them contradict each other.
    """
    found: dict[str, Any] = {}
    for word in filter(None, (part.strip() for part in text.split(","))):
        if word not in _POLICIES:
            raise ValueError(f"{word!r} is not one of {', '.join(_POLICIES)}")
        name, value = _POLICIES[word]
        if found.setdefault(name, value) != value:
            raise ValueError(f"{text!r} has two words for {name}")
    return found


def are_reliable(words: str) -> bool:
    """Return whether the middleware sends lost messages again, which is the default."""
    best_effort: bool = policies(words).get("reliability") == _RELIABILITY.BEST_EFFORT
    return not best_effort


def services(words: str = "") -> Any:
    """Return the quality of service of the three services."""
    return _profile(words, depth=REQUEST_DEPTH)


def feedback(depth: int, words: str = "") -> Any:
    """Return the quality of service of the feedback topic."""
    return _profile(words, depth=depth)


def published_status(lease: float, words: str = "") -> Any:
    """Return that of the status topic's publisher. Its finite lease suits every subscriber."""
    return _profile(words, depth=1, durability=_DURABILITY.TRANSIENT_LOCAL, **_alive_for(lease))


def subscribed_status(words: str = "") -> Any:
    """Return that of the subscription to the status topic."""
    return _profile(words, depth=STATUS_DEPTH, durability=_DURABILITY.TRANSIENT_LOCAL)


def counts() -> Any:
    """Return the quality of service of the topic with the numbers of feedback messages."""
    return _profile("", depth=COUNT_DEPTH, durability=_DURABILITY.TRANSIENT_LOCAL)


def liveliness(lease: float) -> Any:
    """Return that of a second subscription to the status topic, which matches only servers whose
    lease is not longer than this one.
    """
    return _profile("best_effort", depth=1, **_alive_for(lease))


def _alive_for(lease: float) -> dict[str, Any]:
    return {
        "liveliness": rclpy_qos.LivelinessPolicy.AUTOMATIC,
        "liveliness_lease_duration": Duration(seconds=lease),
    }


def _profile(words: str, **defaults: Any) -> Any:
    return rclpy_qos.QoSProfile(**{**defaults, **policies(words)})
