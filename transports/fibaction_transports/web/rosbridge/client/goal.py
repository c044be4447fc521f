"""`OutgoingGoal`: one goal that was sent to a rosbridge server, with its feedback and its end.

rosbridge has no message for an acceptance. A goal counts as accepted at its first feedback, at its
end, or when its server has said nothing against it for some time (`accept`). A rejection that comes
still later ends the goal as ABORTED.

rosbridge has no goal IDs, no numbers of feedback and no memory either: what the server has said is
kept here, in the log that streams read from, as long as the goal or a stream of it is in use.
"""

from __future__ import annotations

import re
import time

import anyio

from fibaction.border.peer_text import REASON, excerpt
from fibaction.feeds.feedback_log import FeedbackCursor, FeedbackLog
from fibaction.feeds.followed_goal import GoalFacts
from fibaction.schema.payload import PayloadError
from fibaction.words.errors import (
    ActionError,
    GoalRejected,
    ProtocolError,
    RejectionCode,
    ServerNotFound,
    copy_of,
)
from fibaction.words.goals import GoalID, Outcome, digest_of
from fibaction.words.statuses import GoalStatus
from fibaction_transports.web.rosbridge.action_values import ActionValues
from fibaction_transports.web.rosbridge.operations import ActionFeedback, ActionResult

NO_SERVER = "No action server available"
"""The text of a rosbridge server about an action that is not served."""
_NOT_SERVED = re.compile("the action .* is not served here")  # a server of fibaction
NO_REASON = "rosbridge gives no reason"
_ENDS = frozenset(status for status in GoalStatus if status.is_terminal)


class OutgoingGoal(FeedbackLog[GoalFacts]):
    """One goal at a rosbridge server."""

    def __init__(
        self, goal_id: GoalID, payload: bytes, action: str, values: ActionValues, window: int
    ) -> None:
        """Keep the last `window` messages of feedback; `action` is the name in ROS."""
        super().__init__(GoalFacts(goal_id, time.time_ns()), window, payload=payload)
        self.digest = digest_of(payload)
        """The digest of the goal, which tells a retry from another goal with the same ID."""
        self.action = action
        self.request = f"send_action_goal:{action}:{goal_id}"
        """The ID of the request, which must be unique among all clients of a server."""
        self.error: ActionError | None = None
        """The error that the goal has ended with, if it has no outcome."""
        self._values = values
        self._is_decided = anyio.Event()
        self._is_accepted = False

    @property
    def is_over(self) -> bool:
        """True if nothing more is expected of the server."""
        return self.outcome is not None or self.error is not None

    async def decided(self) -> None:
        """Wait until the goal is accepted.

        Raises:
            GoalRejected, ServerNotFound: It was not accepted.
            ActionError: The connection ended before.
        """
        await self._is_decided.wait()
        if not self._is_accepted:
            assert self.error is not None
            raise copy_of(self.error)

    def accept(self) -> None:
        """Take the goal for accepted, unless it is decided."""
        if not self._is_decided.is_set():
            self._is_accepted = True
            self._is_decided.set()

    def stream(self, *, feedback: bool, after: int | None = 0, own: bool = True) -> FeedbackCursor:
        """Return a stream of the goal.

        Raises:
            ActionError: The goal has ended with an error.
        """
        return self.follow(feedback=feedback, own=own, after=after)

    # What the server says

    def take_feedback(self, message: ActionFeedback) -> None:
        """Add feedback, which also says that the goal runs."""
        try:
            payload = self._values.feedback.encode(message.values)
        except PayloadError as exc:
            self.lose(self._misread(exc))
            return
        self.accept()
        if self.goal.told_status is GoalStatus.ACCEPTED:
            self.goal.told_status = GoalStatus.EXECUTING
            self.tell_status()
        self.append(payload)

    def take_result(self, message: ActionResult) -> None:
        """End the goal."""
        if not message.result and message.status not in _ENDS:
            self._take_failure(message.values, message.code)
            return
        try:
            outcome = self._outcome(message)
        except PayloadError as exc:
            self.lose(self._misread(exc))
            return
        except ProtocolError as exc:
            self.lose(exc)
            return
        self._end(outcome)

    def reject(self, text: str) -> None:
        """End the goal by the text of an error, if it is not decided."""
        if not self._is_decided.is_set():
            self._take_failure(text)

    def _take_failure(self, values: object, code: int | None = None) -> None:
        text = excerpt(values, REASON) if isinstance(values, str) else ""
        if self._is_accepted:
            self._end(Outcome(GoalStatus.ABORTED, reason=text or NO_REASON))
        elif code is None and (text == NO_SERVER or _NOT_SERVED.match(text)):
            self.lose(ServerNotFound(f"the action {self.action!r} is not served: {text}"))
        else:
            goal_id, kind = self.goal.goal_id, RejectionCode(code or 0)
            self.lose(GoalRejected(text or NO_REASON, goal_id=goal_id, code=kind))

    def _outcome(self, message: ActionResult) -> Outcome[bytes]:
        """Return the outcome in a result.

        Raises:
            PayloadError: The result is not of its type.
            ProtocolError: The status is not that of a goal that has ended.
        """
        # Servers before rosbridge 2.0 do not tell the status of a result.
        status = GoalStatus.SUCCEEDED if message.status is None else message.status
        if status not in _ENDS:
            raise ProtocolError(f"a goal of {self.action!r} has ended with the status {status}")
        status = GoalStatus(status)
        if not message.result:
            text = message.values if isinstance(message.values, str) else ""
            return Outcome(status, reason=excerpt(text, REASON))
        if status is GoalStatus.SUCCEEDED:
            return Outcome(status, self._values.result(message.values))
        result = self._values.partial_result(message.values)
        return Outcome(status, result, excerpt(message.reason, REASON))

    def _misread(self, error: PayloadError) -> ProtocolError:
        text = excerpt(str(error), REASON)
        return ProtocolError(f"a message of {self.action!r} is not of its type: {text}")

    # Ends

    def _end(self, outcome: Outcome[bytes]) -> None:
        self.accept()
        self.goal.outcome, self.goal.told_status = outcome, outcome.status
        self.finish()

    def lose(self, error: ActionError) -> None:
        """End the goal, which has not ended, with an error."""
        self.error = error
        self.fail(error)
        self._is_decided.set()
