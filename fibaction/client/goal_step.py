"""Goals that an executor sends as steps of its own goal: their endpoint, and their blocks."""

from __future__ import annotations

import math
from collections.abc import Coroutine, Generator
from functools import partial
from types import TracebackType
from typing import Any, NoReturn

from anyio import CancelScope, current_effective_deadline
from msgspec.structs import replace

from fibaction._runtime.log import clean_logger
from fibaction.border.abc import Endpoint, ForwardingEndpoint, GoalRequest, GoalStream
from fibaction.client.attempts import Attempts, cancel_left
from fibaction.client.goal import Blocks, ClientGoal, SendingGoal
from fibaction.types.action import FeedbackT, ResultT
from fibaction.words.errors import ActionError, ConnectionLost, TransportError, UnknownGoal
from fibaction.words.goal_steps import GoalStep
from fibaction.words.goals import CancelAnswer, CancelCode, GoalID
from fibaction.words.meta import NO_META, meta_of_child

logger = clean_logger("fibaction.client")


class StepEndpoint(ForwardingEndpoint):
    """The endpoint of one child, around that of its client."""

    def __init__(self, inner: Endpoint, step: GoalStep, child: GoalID) -> None:
        super().__init__(inner)
        self.step = step
        self._child = child
        self.was_canceled = False
        """True if a cancel of the child was sent."""

    async def offer_goal(self, request: GoalRequest) -> GoalStream:
        """Follow the child if an earlier attempt has sent it, and send it otherwise."""
        if not self.step.is_first:
            try:
                # Not by sending it again: a server of ROS rejects an ID that it knows.
                stream = await self.inner.feedback(self._child, after=0, own=True)
            except ConnectionLost:
                raise
            except (UnknownGoal, TransportError):
                pass  # it was never sent, or this transport cannot follow: then sending it tells
            else:
                if not request.feedback:
                    stream.close()
                return stream
        meta = meta_of_child(self.step.parent, request.meta or NO_META)
        return await super().offer_goal(replace(request, meta=meta))

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        """Cancel the child that its block leaves, unless it is left to the next attempt."""
        if self.step.is_kept:
            self.step.leave(partial(cancel_left, self.inner, self._child))
            return CancelAnswer(CancelCode.NONE)
        self.was_canceled = True
        return await super().cancel_goals(goal_id, stamp)


class SendingStep(SendingGoal[FeedbackT, ResultT]):
    """A child to be sent, by `async with`: see `GoalHandle.step`."""

    def __init__(
        self,
        endpoint: StepEndpoint,
        goal_id: GoalID,
        sending: Coroutine[Any, Any, ClientGoal[FeedbackT, ResultT]],
        blocks: Blocks,
        attempts: Attempts | None,
    ) -> None:
        super().__init__(endpoint, goal_id, sending, blocks, attempts)
        self._step_endpoint = endpoint

    def __await__(self) -> Generator[Any, Any, NoReturn]:
        self._sending.close()
        raise TypeError(
            "a step is not awaited, because a cancel of its goal is to reach it: write"
            " `async with client.send_goal(..., step=...) as child`"
        )

    async def __aenter__(self) -> ClientGoal[FeedbackT, ResultT]:
        try:
            self._step_endpoint.step.take(self._goal_id)
        except BaseException:
            self._sending.close()
            raise
        try:
            return await super().__aenter__()
        except BaseException:
            self._step_endpoint.step.give_back(self._goal_id)
            await self._end()
            raise

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if isinstance(exc, ConnectionLost):
            self._step_endpoint.step.give_back(self._goal_id)
        try:
            await super().__aexit__(exc_type, exc, traceback)
        finally:
            await self._end()

    async def _end(self) -> None:
        """Wait for the end of a child that was canceled, if that was asked for."""
        endpoint = self._step_endpoint
        if not (endpoint.was_canceled and endpoint.step.wait_for_end):
            return
        # Shielded from a canceled scope of the executor's own only: a kill is to arrive.
        with CancelScope(shield=current_effective_deadline() == -math.inf):
            try:
                if self._goal is None:
                    await endpoint.inner.get_result(self._goal_id)
                else:
                    await self._goal.feedback.stream.outcome()
            except ActionError as error:
                logger.warning(
                    "goal %s was canceled, and its end is not known: %s", self._goal_id, error
                )
