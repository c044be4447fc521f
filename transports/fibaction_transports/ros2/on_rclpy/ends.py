"""The ends of topics and services, over raw handles of rclpy.

They may be used after ROS was shut down, which may happen at any moment.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

from fibaction.words.errors import ConnectionLost
from fibaction_transports.ros2.node.parts import (
    LifeSigns,
    LifeWatch,
    ServiceCaller,
    ServiceProvider,
    TopicPublisher,
    TopicSubscription,
)
from fibaction_transports.ros2.on_rclpy.rcl import has_answered

Attempt: TypeAlias = Callable[..., Any]
"""Calls rclpy: see `RclpyNode.attempt`."""


class RclpyPublisher(TopicPublisher):
    """A publisher of a topic."""

    def __init__(self, handle: Any, attempt: Attempt) -> None:
        self.handle = handle
        self._attempt = attempt

    def publish(self, message: Any) -> None:
        self._attempt(self.handle.publish, message)

    def publish_bytes(self, message: bytes) -> None:
        self._attempt(self.handle.publish_raw, message)

    def reader_count(self) -> int:
        count: int = self._attempt(self.handle.get_subscription_count, otherwise=0)
        return count


class RclpySubscription(TopicSubscription):
    """A subscription to a topic."""

    def __init__(self, handle: Any, attempt: Attempt) -> None:
        self.handle = handle
        self._attempt = attempt

    def publisher_count(self) -> int:
        count: int = self._attempt(self.handle.get_publisher_count, otherwise=0)
        return count


class RclpyCaller(ServiceCaller):
    """A client of a service."""

    def __init__(self, handle: Any, attempt: Attempt) -> None:
        self.handle = handle
        self._attempt = attempt

    def send(self, request: Any) -> int:
        try:
            number: int = self.handle.send_request(request)
        except Exception as exc:  # rclpy raises whatever rcl says
            raise ConnectionLost(f"ROS cannot send any more: {exc}") from exc
        return number

    def is_available(self) -> bool:
        there: bool = self._attempt(self.handle.service_server_is_available, otherwise=False)
        return there


class RclpyProvider(ServiceProvider):
    """A server of a service."""

    def __init__(self, handle: Any, attempt: Attempt) -> None:
        self.handle = handle
        self._attempt = attempt

    def answer(self, header: Any, response: Any) -> bool:
        answered: bool = self._attempt(has_answered, self.handle, response, header, otherwise=True)
        return answered


class RclpyLifeWatch(LifeWatch):
    """A look-out for signs of life."""

    def __init__(self, event: Any, attempt: Attempt) -> None:
        """`event` is that of a sign of life; None if the middleware has none."""
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
