"""The ends of topics and services: ours over raw handles of rclpy, and others in the graph.

Ours may be used after ROS was shut down, which may happen at any moment.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

from fibaction.words.errors import ConnectionLost
from fibaction_transports.ros2.node.parts import (
    EndInfo,
    LifeSigns,
    LifeWatch,
    ServiceCaller,
    ServiceProvider,
    TopicPublisher,
    TopicSubscription,
)
from fibaction_transports.ros2.on_rclpy.rcl import Duration, has_answered, rclpy_qos
from fibaction_transports.ros2.qos import EndQos

_BILLION = 10**9
_INFINITE = 2**63 - 1
"""The nanoseconds of an infinite duration."""
_UNNAMED = "_NODE_NAME_UNKNOWN_"

_NO_TIME = Duration()._duration_handle
Attempt: TypeAlias = Callable[..., Any]
"""Calls rclpy: see `RclpyNode.attempt`."""


class RclpyEnd:
    """An end over a raw handle."""

    def __init__(self, handle: Any, attempt: Attempt) -> None:
        self.handle = handle
        self._attempt = attempt


class RclpyPublisher(RclpyEnd, TopicPublisher):
    """A publisher of a topic."""

    def __init__(self, handle: Any, attempt: Attempt, qos: EndQos) -> None:
        super().__init__(handle, attempt)
        self._room = qos.room
        self._unconfirmed = 0

    def has_room(self) -> bool:
        # ROS tells only whether all of them have arrived.
        if self._unconfirmed < self._room:
            return True
        arrived = self._attempt(self.handle.wait_for_all_acked, _NO_TIME, otherwise=True)
        self._unconfirmed = 0 if arrived else self._unconfirmed
        return bool(arrived)

    def publish(self, message: Any) -> None:
        self._unconfirmed += 1
        self._attempt(self.handle.publish, message)

    def publish_bytes(self, message: bytes) -> None:
        self._attempt(self.handle.publish_raw, message)

    def reader_count(self) -> int:
        count: int = self._attempt(self.handle.get_subscription_count, otherwise=0)
        return count


class RclpySubscription(RclpyEnd, TopicSubscription):
    """A subscription to a topic."""

    can_pause = True

    def __init__(self, handle: Any, attempt: Attempt, pause: Callable[[bool], None]) -> None:
        super().__init__(handle, attempt)
        self._pause = pause

    def pause(self, is_paused: bool, /) -> None:
        self._pause(is_paused)

    def publisher_count(self) -> int:
        count: int = self._attempt(self.handle.get_publisher_count, otherwise=0)
        return count


class RclpyCaller(RclpyEnd, ServiceCaller):
    """A client of a service."""

    def send(self, request: Any) -> int:
        try:
            number: int = self.handle.send_request(request)
        except Exception as exc:  # rclpy raises whatever rcl says
            raise ConnectionLost(f"ROS cannot send any more: {exc}") from exc
        return number

    def is_available(self) -> bool:
        there: bool = self._attempt(self.handle.service_server_is_available, otherwise=False)
        return there

    def forget(self, number: int) -> None:
        """See `ServiceCaller.forget`. A client of rclpy waits for nothing."""


class RclpyProvider(RclpyEnd, ServiceProvider):
    """A server of a service."""

    def answer(self, header: Any, response: Any) -> bool:
        answered: bool = self._attempt(has_answered, self.handle, response, header, otherwise=True)
        return answered


class RclpyLifeWatch(LifeWatch):
    """A look-out for signs of life."""

    def __init__(self, subscription: Any, event: Any, attempt: Attempt) -> None:
        """`event` is that of a sign of life; None if the middleware has none."""
        self.handle = subscription
        self._event = event
        self._attempt = attempt
        self._before = LifeSigns(0, 0)

    def news(self) -> LifeSigns | None:
        # The event is polled, because the middleware would also wake those that wait for it at
        # every message.
        event = None if self._event is None else self._attempt(self._event.take_event)
        if event is None:
            return None
        before, self._before = self._before, LifeSigns(event.alive_count, event.not_alive_count)
        return None if self._before == before else self._before


def profile_of(qos: EndQos) -> Any:
    """Return the profile for an end."""
    profile = rclpy_qos.QoSProfile(
        reliability=rclpy_qos.ReliabilityPolicy[qos.reliability.upper()],
        durability=rclpy_qos.DurabilityPolicy[qos.durability.upper()],
        history=rclpy_qos.HistoryPolicy[qos.history.upper()],
        depth=qos.depth,
    )
    if not math.isinf(qos.lease) or qos.liveliness != "automatic":
        profile.liveliness = rclpy_qos.LivelinessPolicy[qos.liveliness.upper()]
    for name, seconds in (
        ("deadline", qos.deadline),
        ("lifespan", qos.lifespan),
        ("liveliness_lease_duration", qos.lease),
    ):
        if not math.isinf(seconds):
            setattr(profile, name, Duration(seconds=seconds))
    return profile


def end_info(end: Any) -> EndInfo:
    """Return what the graph tells of an end."""
    profile = end.qos_profile
    return EndInfo(
        bytes(end.endpoint_gid),
        _full_name(end.node_namespace, end.node_name),
        EndQos(
            reliability=profile.reliability.name.lower(),
            durability=profile.durability.name.lower(),
            history="keep_all" if profile.history.name == "KEEP_ALL" else "keep_last",
            depth=profile.depth,
            deadline=_seconds(profile.deadline),
            liveliness=profile.liveliness.name.lower(),
            lease=_seconds(profile.liveliness_lease_duration),
            lifespan=_seconds(profile.lifespan),
        ),
        type_name=end.topic_type,
    )


def _seconds(duration: Any) -> float:
    nanoseconds: int = duration.nanoseconds
    return nanoseconds / _BILLION if 0 < nanoseconds < _INFINITE else math.inf


def _full_name(namespace: str, name: str) -> str:
    """Return the full name of a node; empty if it is not yet discovered."""
    return "" if name == _UNNAMED else f"{namespace.rstrip('/')}/{name}"
