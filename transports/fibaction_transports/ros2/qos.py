"""Quality of service of an action's parts: that of rcl_action (`rcl_action/default_qos.h`), unless
a setting changes it.

Services and feedback are reliable and volatile, the status topic is reliable and transient local,
with a lease of 2 s that its publisher renews.

Most depths are larger than those of rcl_action. They need not match at the two ends: a depth is
only the length of the queue of one reader or writer.
"""

from __future__ import annotations

import math

from msgspec import Struct

REQUEST_DEPTH = 1000
"""Requests, or answers, that may wait to be taken. rcl_action's 10 overflow when 11 arrive at once,
and a lost request is noticed only by its missing answer."""
STATUS_DEPTH = 100
"""Status lists that may wait to be taken. rcl_action's 1 hides all but the last."""
COUNT_DEPTH = 100
"""Numbers of feedback messages that are kept for a client that is connected later."""

_POLICIES = {
    "reliable": "reliability",
    "best_effort": "reliability",
    "volatile": "durability",
    "transient_local": "durability",
}


class EndQos(Struct, frozen=True, kw_only=True):
    """The quality of service of an end of a topic or a service, in the words of ROS."""

    reliability: str = "reliable"
    """`reliable` or `best_effort`."""
    durability: str = "volatile"
    """`volatile` or `transient_local`."""
    depth: int = 10
    """The newest messages that are kept."""
    lease: float = math.inf
    """Seconds within which a publisher gives a sign of life; infinity for none."""
    lifespan: float = math.inf
    """Seconds after which a message is too old for a late subscription."""


def policies(text: str) -> dict[str, str]:
    """Return the policies in a setting: words of ROS with commas, for example
    `best_effort,volatile`. An empty text changes nothing.

    Raises:
        ValueError: A word is not a policy, or two of them contradict each other.
    """
    found: dict[str, str] = {}
    for word in filter(None, (part.strip() for part in text.split(","))):
        if word not in _POLICIES:
            raise ValueError(f"{word!r} is not one of {', '.join(_POLICIES)}")
        if found.setdefault(_POLICIES[word], word) != word:
            raise ValueError(f"{text!r} has two words for {_POLICIES[word]}")
    return found


_LEVELS = {
    "reliability": ("best_effort", "reliable"),
    "durability": ("volatile", "transient_local"),
}
"""The levels of each policy. An end that offers the first does not match one that wants the second.
"""
_PROFILES = {"": "", "default": "", "sensor_data": "best_effort,volatile"}
"""The profiles of ROS by their names, as words."""


def unmet(offered: EndQos, wanted: EndQos) -> list[str]:
    """Return the policies of a publisher that are less than its subscription wants."""
    return [
        policy
        for policy, levels in _LEVELS.items()
        if (getattr(offered, policy), getattr(wanted, policy)) == levels
    ]


def of_topic(words: str, depth: int) -> EndQos:
    """Return the quality of service of a topic: a profile of ROS by its name, or words.

    Raises:
        ValueError: A word is not known, or the depth is not positive.
    """
    if depth < 1:
        raise ValueError(f"depth must be at least 1, not {depth}")
    try:
        return _qos(_PROFILES.get(words, words), EndQos(depth=depth))
    except ValueError as exc:
        known = ", ".join(name for name in _PROFILES if name)
        raise ValueError(f"qos: {exc}, nor one of {known}") from None


def are_reliable(words: str) -> bool:
    """Return whether the middleware sends lost messages again, which is the default."""
    return policies(words).get("reliability") != "best_effort"


def services(words: str = "") -> EndQos:
    """Return the quality of service of the three services."""
    return _qos(words, EndQos(depth=REQUEST_DEPTH))


def feedback(depth: int, words: str = "") -> EndQos:
    """Return the quality of service of the feedback topic."""
    return _qos(words, EndQos(depth=depth))


def published_status(lease: float, words: str = "") -> EndQos:
    """Return that of the status topic's publisher. Its finite lease suits every subscriber."""
    return _qos(words, EndQos(depth=1, durability="transient_local", lease=lease))


def subscribed_status(words: str = "") -> EndQos:
    """Return that of the subscription to the status topic."""
    return _qos(words, EndQos(depth=STATUS_DEPTH, durability="transient_local"))


def counts() -> EndQos:
    """Return the quality of service of the topic with the numbers of feedback messages."""
    return EndQos(depth=COUNT_DEPTH, durability="transient_local")


def liveliness(lease: float) -> EndQos:
    """Return that of a second subscription to the status topic, which matches only servers whose
    lease is not longer than this one.
    """
    return EndQos(reliability="best_effort", depth=1, lease=lease)


def _qos(words: str, usual: EndQos) -> EndQos:
    given = policies(words)
    return EndQos(
        reliability=given.get("reliability", usual.reliability),
        durability=given.get("durability", usual.durability),
        depth=usual.depth,
        lease=usual.lease,
    )
