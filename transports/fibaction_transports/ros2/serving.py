"""The server's half: an endpoint becomes an action server of ROS.

Three services and two topics, as `rcl_action` has them. It knows an endpoint by its methods only,
so it serves a server of this process as well as whatever a gateway reaches.
"""

from __future__ import annotations

import logging
import math
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Any

import anyio
from anyio import current_time
from anyio.abc import TaskGroup

from fibaction._notify import Notifier
from fibaction._tasks import Background
from fibaction.abc import Endpoint
from fibaction.exceptions import ActionError, GoalRejected, ProtocolError
from fibaction.goals import UNKNOWN_OUTCOME, CancelAnswer, CancelCode, GoalID, GoalInfo, Outcome
from fibaction.states import GoalStatus
from fibaction_transports.ros2 import names
from fibaction_transports.ros2.board import StatusBoard
from fibaction_transports.ros2.cdr import pack_statuses
from fibaction_transports.ros2.feedback import FeedbackTopic
from fibaction_transports.ros2.intake import Requests
from fibaction_transports.ros2.messages import RosAction, RosCodecs
from fibaction_transports.ros2.node import RosNode
from fibaction_transports.ros2.pump import Pump
from fibaction_transports.ros2.rcl import GoalInfoMessage, has_answered, raw, uuid_of

NO_GOAL = bytes(16)
DRAIN_TIMEOUT = 5.0
"""Seconds that leaving waits for the last answers to be sent."""
ASKING_TIME = 0.5
"""Seconds of these in which clients may still ask for results: one who has just been told that its
goal was accepted is about to."""
LINGER = 0.2
"""Seconds that the node stays after the last thing that was told. Fast DDS drops what has arrived,
and that it has yet to handle, if it hears first that the sender has left."""
RIVALS_PAUSE = 1.0
"""Seconds between two looks for a second server of the same name."""
RETRY_PAUSE = 1.0
"""Seconds between attempts to follow the statuses of an endpoint that cannot be reached."""
ANSWER_PAUSES = (0.1, 0.3, 0.6)
"""Seconds between attempts to send an answer that cannot reach its client yet."""
UNDERWAY = 10_000
"""How many requests may be under way: most of them ask for the results of goals that run."""

logger = logging.getLogger("fibaction.ros2")


class Plan:
    """What will be served, found out before anything is."""

    def __init__(self, endpoint: Endpoint) -> None:
        """Find the action's type in ROS.

        Raises:
            TransportError: There is no such type, or its fields do not match the action's.
        """
        self.endpoint = endpoint
        info = endpoint.info
        found = RosAction.find(info.type_name, info.name)
        self.impl: Any = found.ros_type.Impl
        self.codecs: RosCodecs = found.codecs(info)


class Served:
    """One action, served in ROS."""

    def __init__(self, ros: RosNode, plan: Plan, feedback_depth: int, tasks: TaskGroup) -> None:
        self._ros = ros
        self._endpoint = plan.endpoint
        self._impl = plan.impl
        self._codecs = plan.codecs
        self._tasks = tasks
        self._names = names.action_names(ros.node, plan.endpoint.info.name)
        self._name = plan.endpoint.info.name
        self._deciding: set[GoalID] = set()
        self._pumps: dict[GoalID, Pump] = {}
        self._quick = 0
        self._sending = 0
        self.told_at = -math.inf
        """When the last answer or status was sent."""
        self._is_drained = False
        self._underway = 0
        self._progress = Notifier()
        self._open(feedback_depth)

    def _open(self, depth: int) -> None:
        make, impl, full = self._ros.make, self._impl, self._names
        profile = names.services()
        goals = make(raw.Service, impl.SendGoalService, full.send_goal, profile)
        cancels = make(raw.Service, impl.CancelGoalService, full.cancel_goal, profile)
        results = make(raw.Service, impl.GetResultService, full.get_result, profile)
        self._feedback = FeedbackTopic(
            self._ros, self._name, full, impl.FeedbackMessage, self._codecs.feedback, depth
        )
        self._status = make(
            raw.Publisher, impl.GoalStatusMessage, full.status, names.published_status()
        )
        self._board = StatusBoard(self._publish_status)
        refused = impl.CancelGoalService.Response(return_code=int(CancelCode.REJECTED))
        for handle, service, answer, failure in (
            (goals, impl.SendGoalService, self._answer_goal, impl.SendGoalService.Response()),
            (cancels, impl.CancelGoalService, self._answer_cancel, refused),
            (results, impl.GetResultService, self._answer_result, impl.GetResultService.Response()),
        ):
            self._ros.listen(Requests(handle, service, self._begin(handle, answer, failure)))

    def start(self) -> None:
        """Serve."""
        # So that clients know at once that there are no goals, and not only after a while.
        self._publish_status(pack_statuses(()))
        self._tasks.start_soon(self._board.run, name=f"statuses of {self._name}")
        self._tasks.start_soon(self._follow_statuses, name=f"goals of {self._name}")
        self._tasks.start_soon(self._watch_rivals, name=f"rivals of {self._name}")

    async def drain(self) -> None:
        """Wait until all has been answered that can be answered."""
        if self._has_ended:
            return
        with anyio.move_on_after(DRAIN_TIMEOUT, shield=True):
            with anyio.move_on_after(ASKING_TIME):
                await self._all_told()
            for pump in self._pumps.values():
                pump.hurry()
            await self._all_told()
            self._board.flush()
        self._is_drained = True

    @property
    def _has_ended(self) -> bool:
        """Whether nothing can be done any more. On trio, a Ctrl-C is raised in whatever task runs:
        if that is one of these, all of them have ended.
        """
        return self._is_drained or self._tasks.cancel_scope.cancel_called

    async def _all_told(self) -> None:
        while self._quick or self._sending or any(pump.is_owed for pump in self._pumps.values()):
            await self._progress.wait()

    # Requests

    def _begin(
        self, service: Any, answer: Callable[[Any], Awaitable[Any]], failure: Any
    ) -> Callable[[Any], None]:
        """What to do with a request; `failure` is the answer if nothing else can be said."""
        deciding = answer == self._answer_goal
        quick = answer != self._answer_result

        def begin(item: Any) -> None:
            header, request = item
            if self._has_ended or self._underway >= UNDERWAY:
                # Nobody can answer any more, which the client will notice; or nobody can keep up.
                level = logging.INFO if self._has_ended else logging.ERROR
                logger.log(level, "%s: more requests than can be answered: one is lost", self._name)
                return
            self._underway += 1
            self._quick += quick
            self._tasks.start_soon(handle, header, request, name=f"request to {self._name}")

        async def handle(header: Any, request: Any) -> None:
            try:
                try:
                    response = await answer(request)
                except Exception as exc:
                    # An endpoint of somebody else's: that is its fault, and one request's.
                    logger.error("%s: a request failed: %s", self._name, exc, exc_info=exc)
                    response = failure
                await self._send(service, response, header)
            except Exception as exc:  # rclpy raises whatever rcl says
                # Most likely, the client has left.
                logger.info("%s: an answer could not be sent: %s", self._name, exc)
            finally:
                if deciding:
                    self._deciding.discard(_goal_id(request.goal_id))
                self._underway -= 1
                self._quick -= quick
                self._progress.notify()

        return begin

    async def _send(self, service: Any, response: Any, header: Any) -> None:
        pauses = iter(ANSWER_PAUSES)
        self._sending += 1
        try:
            while not has_answered(service, response, header):
                pause = next(pauses, None)
                if pause is None:
                    logger.warning("%s: an answer cannot reach its client, and is lost", self._name)
                    return
                await anyio.sleep(pause)
            self.told_at = current_time()
        finally:
            self._sending -= 1

    async def _answer_goal(self, request: Any) -> Any:
        response = self._impl.SendGoalService.Response()
        goal_id = _goal_id(request.goal_id)
        try:
            stamp = await self._accept(goal_id, request.goal)
        except ActionError as exc:
            reason = exc.reason if isinstance(exc, GoalRejected) else str(exc)
            # The answer has no field for it.
            self._ros.warn(f"{self._name}: goal {goal_id} rejected: {reason}")
        else:
            response.accepted = True
            response.stamp.sec, response.stamp.nanosec = divmod(stamp, 10**9)
        return response

    async def _accept(self, goal_id: GoalID, goal: Any) -> int:
        while goal_id in self._deciding:
            # A client that sends it again, or two that clash: the first answer counts.
            await self._progress.wait()
        if goal_id in self._pumps or goal_id in self._board:
            raise GoalRejected("its ID is in use")
        self._deciding.add(goal_id)  # until the client has been told
        stream = await self._endpoint.send_goal(goal_id, self._codecs.goal.from_ros(goal))
        # The stream of all statuses may be read later than the goal's own.
        self._board.tell(GoalInfo(goal_id, stream.stamp, GoalStatus.ACCEPTED))
        self._pump(goal_id, Pump(stream, self._feedback.of(goal_id), self._board.tell))
        return stream.stamp

    async def _answer_cancel(self, request: Any) -> Any:
        info = request.goal_info
        goal_id = _goal_id(info.goal_id)
        stamp = info.stamp.sec * 10**9 + info.stamp.nanosec
        try:
            answer = await self._endpoint.cancel_goals(
                None if goal_id == NO_GOAL else goal_id, stamp or None
            )
        except ActionError as exc:
            answer = CancelAnswer(CancelCode.REJECTED, reason=str(exc))
        if answer.reason:
            self._ros.warn(f"{self._name}: cancel refused: {answer.reason}")
        await anyio.lowlevel.checkpoint()  # what came before the cancel is told before
        for one in answer.goals_canceling:
            self._board.tell(one)
        self._board.flush()
        response = self._impl.CancelGoalService.Response()
        response.return_code = int(answer.return_code)
        response.goals_canceling = [_message_of(info) for info in answer.goals_canceling]
        return response

    async def _answer_result(self, request: Any) -> Any:
        goal_id = _goal_id(request.goal_id)
        pump = self._pumps.get(goal_id)
        if pump is not None:
            return await pump.answer()
        try:
            outcome = await self._endpoint.get_result(goal_id)
        except ActionError as exc:  # a gateway has lost the server behind it
            logger.info("%s: no result of goal %s: %s", self._name, goal_id, exc)
            outcome = UNKNOWN_OUTCOME
        return self._result(goal_id, outcome)

    def _result(self, goal_id: GoalID, outcome: Outcome[bytes]) -> Any:
        response = self._impl.GetResultService.Response()
        status = outcome.status
        try:
            response.result = self._codecs.result.to_ros(outcome.result)
        except ProtocolError as exc:
            self._ros.complain(
                f"{self._name}: goal {goal_id} aborted: its result is no ROS message: {exc}"
            )
            status = GoalStatus.ABORTED
        response.status = int(status)
        return response

    # Goals

    def _pump(self, goal_id: GoalID, pump: Pump) -> None:
        self._pumps[goal_id] = pump
        self._tasks.start_soon(self._run_pump, goal_id, pump, name=f"goal of {self._name}")

    async def _run_pump(self, goal_id: GoalID, pump: Pump) -> None:
        try:
            # Who cannot be told of the goal cannot be told of its feedback either.
            while goal_id in self._deciding:
                await self._progress.wait()
            try:
                outcome = await pump.outcome()
            except Exception as exc:
                self._log_failure(f"goal {goal_id} is lost", exc)
                outcome = Outcome[bytes](GoalStatus.UNKNOWN)  # the reason has just been logged
            if outcome.reason:
                self._ros.warn(
                    f"{self._name}: goal {goal_id} {outcome.status.name}: {outcome.reason}"
                )
            response = self._result(goal_id, outcome)
            status = GoalStatus(response.status)
            if status.is_terminal:
                self._board.tell(GoalInfo(goal_id, pump.stream.stamp, status))
            self._board.flush()
            await pump.hand_over(response)
        finally:
            del self._pumps[goal_id]
            for info in pump.late:
                if info.status is GoalStatus.UNKNOWN or goal_id not in self._board:
                    self._board.tell(info)
            self._progress.notify()

    def _publish_status(self, message: bytes) -> None:
        self.told_at = current_time()
        self._ros.attempt(self._status.publish_raw, message)

    # Statuses

    async def _follow_statuses(self) -> None:
        while True:
            try:
                with await self._endpoint.status() as statuses:
                    while (info := await statuses.receive()) is not None:
                        self._take_status(info)
            except Exception as exc:
                self._log_failure("no statuses", exc)
                self._board.clear()
            await anyio.sleep(RETRY_PAUSE)

    def _take_status(self, info: GoalInfo) -> None:
        pump = self._pumps.get(info.goal_id)
        if pump is not None and not info.status.is_active:
            pump.late.append(info)
            return
        is_new = info.goal_id not in self._board and info.goal_id not in self._deciding
        if pump is None and is_new and info.status.is_active:
            self._tasks.start_soon(self._observe, info.goal_id, name=f"goal of {self._name}")
        self._board.tell(info)

    async def _observe(self, goal_id: GoalID) -> None:
        """Publish the feedback of a goal that did not come through ROS."""
        try:
            stream = await self._endpoint.feedback(goal_id)
        except Exception as exc:
            self._log_failure(f"no feedback of goal {goal_id}", exc)
        else:
            self._pump(goal_id, Pump(stream, self._feedback.of(goal_id), self._board.tell))

    def _log_failure(self, what: str, exc: Exception) -> None:
        """Log what a task of an endpoint could not do; if that is no `ActionError`, it is a bug in
        the endpoint, which is not to end the others.
        """
        if isinstance(exc, ActionError):
            logger.info("%s: %s: %s", self._name, what, exc)
        else:
            logger.error("%s: %s: %s", self._name, what, exc, exc_info=exc)

    async def _watch_rivals(self) -> None:
        warned = False
        while self._ros.is_up:  # which is how it is noticed that it is not
            await anyio.sleep(RIVALS_PAUSE)
            count = self._ros.attempt(
                self._ros.node.count_publishers, self._names.status, otherwise=0
            )
            rivals = count > 1
            if rivals and not warned:
                text = f"{self._name}: somebody else serves it too, and ROS runs every goal twice"
                logger.warning("%s", text)
                self._ros.warn(text)
            warned = rivals


@asynccontextmanager
async def served(
    ros: RosNode, plans: Sequence[Plan], feedback_depth: int
) -> AsyncGenerator[None, None]:
    """Serve for as long as the block lasts."""
    async with Background() as tasks:
        actions = [Served(ros, plan, feedback_depth, tasks) for plan in plans]
        for action in actions:
            action.start()
        try:
            yield
        finally:
            for action in actions:
                await action.drain()
            last = max(action.told_at for action in actions)
            with anyio.CancelScope(shield=True):
                await anyio.sleep_until(last + LINGER)


def _goal_id(message: Any) -> GoalID:
    return GoalID(bytes(message.uuid))


def _message_of(info: GoalInfo) -> Any:
    message = GoalInfoMessage()
    message.goal_id.uuid = uuid_of(info.goal_id)
    message.stamp.sec, message.stamp.nanosec = divmod(info.stamp, 10**9)
    return message
