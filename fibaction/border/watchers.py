"""The interfaces of metrics, traces and recordings: `Watcher`, which an action server calls, and
`GoalTracer`, which a client calls.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, Protocol

from fibaction.border.abc import FeedbackItem, GoalStream
from fibaction.types.action import ActionInfo
from fibaction.words.goals import CancelAnswer, GoalID, GoalInfo, Outcome, Parent, Sender
from fibaction.words.meta import Meta


class Watcher:
    """A base class for programs that see everything that happens to the goals of a server.

    Override the methods that you need; the others do nothing. The server calls them in its event
    loop, at the moment at which it happens, so they must be fast and must not wait: hand slow work
    to a thread. An exception of a method is logged once for each watcher, and changes nothing for
    the goal. The bytes of goals, feedback and results are those that clients get, in msgpack.

    One watcher may belong to several servers; `action` is the name of the server's action.

    For example:

        class Counter(Watcher):
            def __init__(self) -> None:
                self.ends = 0

            def ended(self, action: str, info: GoalInfo, outcome: Outcome[bytes]) -> None:
                self.ends += 1

        ActionServer(DRIVE, drive, watchers=[Counter()])
    """

    def opened(self, info: ActionInfo) -> None:
        """Take note that a server of this action starts. Goals of its store follow."""

    def offered(
        self, action: str, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> None:
        """Take note of a new goal, which is not decided yet; `rejected` or `accepted` follows.

        A retry of the same goal is not reported. Context variables that are set here are seen by
        the executor of the goal, and by an `on_goal` that is not async, but by nothing else. `meta`
        is the small text map that came with the goal, for traces.
        """

    def taken_over(
        self, action: str, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> None:
        """Take note of an active goal that comes from the store, instead of `offered`; `accepted`
        follows.

        Context variables that are set here are seen by the executor of the goal.
        """

    def rejected(self, action: str, goal_id: GoalID, reason: str) -> None:
        """Take note that a goal was rejected, or that its client has withdrawn it before."""

    def accepted(self, action: str, info: GoalInfo, goal: bytes) -> None:
        """Take note of an accepted goal, or of one that the server takes over from its store: then
        its attempt may be more than 1, and it was taken over before, not offered.
        """

    def changed(self, action: str, info: GoalInfo) -> None:
        """Take note that an accepted goal is EXECUTING or CANCELING."""

    def feedback(self, action: str, goal_id: GoalID, item: FeedbackItem) -> None:
        """Take note of a feedback message."""

    def missed(self, action: str, goal_id: GoalID, count: int) -> None:
        """Take note that a follower of a goal has missed so many feedback messages, because it read
        too slowly, or left them unread.
        """

    def canceled(self, action: str, goal_id: GoalID | None, answer: CancelAnswer) -> None:
        """Take note of the answer to a client's cancel; `goal_id` is None if it means several."""

    def ended(self, action: str, info: GoalInfo, outcome: Outcome[bytes]) -> None:
        """Take note of the end of a goal."""

    def left(self, action: str, info: GoalInfo, reason: str) -> None:
        """Take note that an accepted goal no longer belongs to this server: its store keeps it for
        the next start, or another server has it.
        """

    def closed(self, info: ActionInfo) -> None:
        """Take note that a server has stopped, after its last goal, or that its start failed."""


class GoalSpan:
    """The notes about one goal. Those of this class do nothing; one object serves all goals.

    The first of `failed`, `ended` and `left` counts. None of the methods raises an error.
    """

    meta: Meta | None = None
    """The text that goes with the goal."""

    def accepted(self, stream: GoalStream) -> None:
        """Note that the server has accepted the goal."""

    def failed(self, error: BaseException) -> None:
        """Note the error of a wait for the goal."""

    def ended(self, outcome: Outcome[Any]) -> None:
        """Note the outcome."""

    def left(self, stream: GoalStream, error: BaseException | None = None) -> None:
        """Note that the client leaves an accepted goal, because of that error if there is one."""


NO_SPAN = GoalSpan()


class GoalTracer(Protocol):
    """A maker of spans for goals that are sent, such as `fibaction.observe.Tracing`."""

    @abstractmethod
    def sending(self, action: str, goal_id: GoalID, parent: Parent | None = None) -> GoalSpan:
        """Return the span of a goal that is about to be sent, perhaps by the executor of a parent.
        It raises no error.
        """
