"""The service servers of an action: they take requests, and send the answers."""

from __future__ import annotations

import logging
import math
from collections.abc import Awaitable, Callable
from typing import Any

import anyio
from anyio.abc import TaskGroup

from fibaction.border.abc import Notifier
from fibaction.border.event_loop import loop_clock
from fibaction.border.peer_text import clean_logger
from fibaction_transports.ros2.node.parts import ServiceProvider
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.qos import EndQos

ANSWER_PAUSES = (0.1, 0.3, 0.6)
"""Seconds between attempts to send an answer that cannot reach its client yet."""
UNDERWAY = 10_000
"""Requests that may be under way. Most of them wait for the results of goals that run."""

logger = clean_logger("fibaction.ros2")


class ServiceServers:
    """The services of one action. Each request is answered in a task of its own."""

    def __init__(
        self, ros: RosNode, action: str, qos: EndQos, tasks: TaskGroup, progress: Notifier
    ) -> None:
        """`progress` is notified whenever a request is done."""
        self.sent_at = -math.inf
        """The time at which the last answer was sent."""
        self._ros = ros
        self._action = action
        self._qos = qos
        self._tasks = tasks
        self._progress = progress
        self._time = loop_clock()
        self._is_closed = False
        self._underway = 0
        self._awaited = 0
        self._sending = 0

    def serve(
        self,
        service: str,
        service_type: Any,
        answer: Callable[[Any], Awaitable[Any]],
        *,
        failure: Any = None,
        is_awaited: bool = True,
        done: Callable[[Any], None] = lambda request: None,
        follow: Callable[[Any], Awaitable[None] | None] = lambda request: None,
    ) -> ServiceProvider:
        """Serve one of the services.

        Args:
            service: Its full name.
            service_type: The type of the service.
            answer: Called with a request; returns the response.
            failure: The response if `answer` raises; None is a response with its defaults.
            is_awaited: `is_busy` waits for these requests. Requests for results last as long as
                their goals, and are not waited for.
            done: Called with the request after the response was sent, or could not be sent.
            follow: Called with the request after that. What it returns is awaited in the task of
                the request, which does not count as under way any more.

        Raises:
            TransportError: ROS does not allow it.
        """

        def begin(header: Any, request: Any) -> None:
            if self.is_closed or self._underway >= UNDERWAY:
                # Lost requests are noticed by their clients.
                level = logging.INFO if self.is_closed else logging.ERROR
                logger.log(
                    level, "%s: more requests than can be answered: one is lost", self._action
                )
                return
            self._underway += 1
            self._awaited += is_awaited
            self._tasks.start_soon(handle_one, header, request, name=f"request to {self._action}")

        async def handle_one(header: Any, request: Any) -> None:
            try:
                try:
                    response = await answer(request)
                except Exception as exc:
                    # A bug of the endpoint. It must not affect other requests.
                    logger.error("%s: a request failed: %s", self._action, exc, exc_info=exc)
                    response = service_type.Response() if failure is None else failure
                await self._send(provider, response, header)
            except Exception as exc:  # the middleware raises whatever it says
                # Most likely, the client has left.
                logger.info("%s: an answer could not be sent: %s", self._action, exc)
            finally:
                header = None  # the frames of a cancellation would keep a query of Zenoh open
                done(request)
                self._underway -= 1
                self._awaited -= is_awaited
                self._progress.notify()
            following = follow(request)
            request = response = None  # what follows may last long
            if following is not None:
                await following

        provider = self._ros.provider(service, service_type, self._qos, begin)
        return provider

    async def _send(self, provider: ServiceProvider, response: Any, header: Any) -> None:
        pauses = iter(ANSWER_PAUSES)
        self._sending += 1
        try:
            while not provider.answer(header, response):
                pause = next(pauses, None)
                if pause is None:
                    logger.warning(
                        "%s: an answer cannot reach its client, and is lost", self._action
                    )
                    return
                await anyio.sleep(pause)
            self.sent_at = self._time()
        finally:
            self._sending -= 1

    @property
    def is_busy(self) -> bool:
        """True if an answer is being sent, or a request is awaited that is not yet answered."""
        return bool(self._awaited or self._sending)

    @property
    def is_closed(self) -> bool:
        """True if no more requests can be answered. On trio, a Ctrl-C is raised in whatever task
        runs: if it is one of these, all of them have ended.
        """
        return self._is_closed or self._tasks.cancel_scope.cancel_called

    def close(self) -> None:
        """Drop all further requests."""
        self._is_closed = True
