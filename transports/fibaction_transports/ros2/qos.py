"""Quality of service of an action's parts: that of rcl_action (`rcl_action/default_qos.h`), unless
a setting changes it.

Services and feedback are reliable and volatile, the status topic is reliable and transient local,
with a lease of 2 s that its publisher renews.

Most depths are larger than those of rcl_action. They need not match at the two ends: a depth is
only the length of the queue of one reader or writer.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

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
_TOPIC_POLICIES = {**_POLICIES, "keep_last": "history", "keep_all": "history"}


class EndQos(Struct, frozen=True, kw_only=True):
    """The quality of service of an end of a topic or a service, in the words of ROS."""

    reliability: str = "reliable"
    """`reliable` or `best_effort`."""
    durability: str = "volatile"
    """`volatile` or `transient_local`."""
    history: str = "keep_last"
    """`keep_last`, or `keep_all` for back-pressure: a reliable publisher waits for its readers."""
    depth: int = 10
    """The newest messages that are kept; with `keep_all`, those that wait before others wait."""
    deadline: float = math.inf
    """Seconds between two messages at most, as a publisher promises; infinity for none. It is
    matched, and not watched."""
    liveliness: str = "automatic"
    """The signs of life: `automatic`, or `manual_by_topic`, by each message."""
    lease: float = math.inf
    """Seconds within which a publisher gives a sign of life; infinity for none."""
    lifespan: float = math.inf
    """Seconds after which a message is too old for a late subscription."""

    @property
    def room(self) -> float:
        """The messages of a publisher that may wait for readers; infinity if none waits."""
        waits = (self.history, self.reliability) == ("keep_all", "reliable")
        return self.depth if waits else math.inf


def policies(text: str, known: Mapping[str, str] = _POLICIES) -> dict[str, str]:
    """Return the policies in a setting: words of ROS with commas, for example
    `best_effort,volatile`. An empty text changes nothing.

    Raises:
        ValueError: A word is not a policy, or two of them contradict each other.
    """
    found: dict[str, str] = {}
    for word in filter(None, (part.strip() for part in text.split(","))):
        if word not in known:
            raise ValueError(f"{word!r} is not one of {', '.join(known)}")
        if found.setdefault(known[word], word) != word:
            raise ValueError(f"{text!r} has two words for {known[word]}")
    return found


_WORD_LEVELS = {
    "reliability": ("best_effort", "reliable"),
    "durability": ("volatile", "transient_local"),
}
_LEVELS = _WORD_LEVELS | {"liveliness": ("automatic", "manual_by_participant", "manual_by_topic")}
"""The levels of each policy. An end that offers a lower one does not match one that wants a higher.
"""
_DURATIONS = ("deadline", "lease", "lifespan")
_MATCHED_DURATIONS = ("deadline", "lease")
_ROUNDING = 1e-6
"""Seconds by which the same duration may differ on the wire."""
_PROFILES = {
    "": EndQos(),
    "default": EndQos(),
    "sensor_data": EndQos(reliability="best_effort", depth=5),
    "parameters": EndQos(depth=1000),
    "parameter_events": EndQos(depth=1000),
    "services": EndQos(),
    "clock": EndQos(reliability="best_effort", depth=1),
}
"""The profiles of ROS by their names."""


def unmet(offered: EndQos, wanted: EndQos) -> list[str]:
    """Return the policies of a publisher that are less than its subscription wants."""
    found = [
        policy
        for policy, levels in _LEVELS.items()
        if getattr(wanted, policy) in levels[1:]
        and getattr(offered, policy) in levels[: levels.index(getattr(wanted, policy))]
    ]
    return found + [
        policy
        for policy in _MATCHED_DURATIONS
        if getattr(offered, policy) > getattr(wanted, policy) + _ROUNDING
    ]


def has_words(policy: str) -> bool:
    """Return whether a policy can be given by a word, as in `qos="best_effort"`."""
    return policy in _WORD_LEVELS


def word(qos: EndQos, policy: str) -> str:
    """Return a policy as errors tell it."""
    value: Any = getattr(qos, policy)
    if policy in _DURATIONS:
        return f"a {policy} of {value:g} s" if value < math.inf else f"no {policy}"
    return str(value) if has_words(policy) else f"{policy} {value}"


def difference(offered: EndQos, wanted: EndQos) -> tuple[str, str] | None:
    """Return the words in which a publisher and a subscription do not match; None if they do."""
    policies = unmet(offered, wanted)
    if not policies:
        return None
    return (
        ", ".join(word(offered, policy) for policy in policies),
        ", ".join(word(wanted, policy) for policy in policies),
    )


def advice(offered: EndQos, wanted: EndQos) -> str:
    """Return the argument with which a subscription gets what a publisher offers."""
    policies = unmet(offered, wanted)
    if all(map(has_words, policies)):
        return f"qos={','.join(getattr(offered, policy) for policy in policies)!r}"
    return "an EndQos that wants no more"


def of_topic(given: object, depth: int | None = None) -> EndQos:
    """Return the quality of service of a topic: a profile of ROS by its name, words, or all of it.

    Raises:
        TypeError: It is neither a text nor an `EndQos`.
        ValueError: A word is not known, the depth is not positive, or two values contradict each
            other.
    """
    if isinstance(given, EndQos):
        found = given
    elif not isinstance(given, str):
        raise TypeError(f"qos is a text such as 'best_effort' or an EndQos, and not {given!r}")
    elif given in _PROFILES:
        found = _PROFILES[given]
    else:
        try:
            found = EndQos(**policies(given, _TOPIC_POLICIES))  # type: ignore[arg-type]  # texts only
        except ValueError as exc:
            known = ", ".join(filter(None, _PROFILES))
            raise ValueError(f"qos: {exc}, nor one of {known}") from None
    if depth is not None:
        found = replace(found, depth=depth)
    for policy in ("reliability", "durability", "history"):
        if getattr(found, policy) not in _words_of(policy):
            raise ValueError(f"qos: {getattr(found, policy)!r} is no {policy}")
    if found.liveliness not in ("automatic", "manual_by_topic"):
        raise ValueError(f"qos: {found.liveliness!r} is no liveliness")
    for policy in _DURATIONS:
        if not getattr(found, policy) > 0:
            raise ValueError(f"qos: {policy} must be positive, not {getattr(found, policy)!r}")
    if found.depth < 1:
        raise ValueError(f"depth must be at least 1, not {found.depth}")
    if (found.history, found.durability) == ("keep_all", "transient_local"):
        raise ValueError(
            "qos: keep_all with transient_local would keep every message: use a depth instead"
        )
    return found


def _words_of(policy: str) -> list[str]:
    return [one for one, of in _TOPIC_POLICIES.items() if of == policy]


def suiting(offers: Iterable[EndQos]) -> str:
    """Return the words with which a subscription matches all publishers, as `ros2 topic echo`
    chooses them: it asks for what all of them offer.
    """
    offers = [*offers]
    return ",".join(
        levels[bool(offers) and all(getattr(one, policy) == levels[1] for one in offers)]
        for policy, levels in _WORD_LEVELS.items()
    )


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
