"""`GoalHandle`: one goal, as its executor and the callbacks of the server see it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, NoReturn

from fibaction._runtime.notify import Notifier
from fibaction.types.action import GoalT
from fibaction.words.goal_steps import GoalStep, GoalSteps
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.server.durability.keeper import Keeper
    from fibaction.server.functions.report import RunningGoal
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.words.goals import GoalID, Sender


class Succession(Generic[GoalT]):
    """The goals of a server that can be taken over by the executors of others: none, as it has no
    schedule.
    """

    def successor(self, goal_id: GoalID) -> GoalHandle[GoalT] | None:
        """Return the goal that this one may take over; None if there is none."""
        return None

    def news_of(self, goal_id: GoalID) -> Notifier:
        """Return the notifier of a new successor, and of the end of the goal."""
        return Notifier()

    def take_over(self, goal_id: GoalID) -> GoalHandle[GoalT]:
        """Let the executor of a goal continue as its successor, and return that.

        Raises:
            RuntimeError: There is none.
        """
        raise RuntimeError(f"goal {goal_id} has no successor: the server has no schedule")


class GoalHandle(Generic[GoalT]):
    """One goal, as its executor sees it.

    For example:

        async def drive(goal: GoalHandle[int]) -> AsyncIterator[int | str]:
            for meters in range(goal.request):
                yield meters
            yield "arrived"
    """

    __slots__ = ("_goal", "_keeper", "_succession", "request", "restored", "running", "steps")

    def __init__(
        self,
        goal: GoalRecord,
        request: GoalT,
        keeper: Keeper,
        succession: Succession[GoalT],
        restored: Any = None,
    ) -> None:
        self.request = request
        """The goal that the client sent."""
        self.restored = restored
        """The last checkpoint of the attempt before this one; None if there is none."""
        self._goal = goal
        self._keeper = keeper
        self._succession = succession
        self.steps: GoalSteps | None = None
        """The steps of this attempt; None before the first."""
        self.running: RunningGoal | None = None
        """The run of the executor; None before it begins, and after its end."""

    @property
    def goal_id(self) -> GoalID:
        """The goal's ID, made by the client."""
        return self._goal.goal_id

    @property
    def stamp(self) -> int:
        """Time of the acceptance: nanoseconds since 1970."""
        return self._goal.stamp

    @property
    def sender(self) -> Sender:
        """The client that sent the goal first, as far as the transport identifies it.

        A server behind a gateway sees the gateway as the sender, unless both are in one process.
        """
        return self._goal.sender

    @property
    def deadline(self) -> float:
        """Time at which the client gives up the goal, by the clock of `anyio.current_time()`;
        `math.inf` if it does not. The server does not enforce it.
        """
        return self._goal.deadline

    @property
    def status(self) -> GoalStatus:
        """The goal's status now."""
        return self._goal.status

    @property
    def cancel_requested(self) -> bool:
        """True if the goal is to stop: its cancel was accepted, or the server ends it."""
        return self._goal.status is GoalStatus.CANCELING or bool(self._goal.stop_reason)

    def check(self) -> None:
        """Raise `GoalCanceled`, once, if a cancel has interrupted the executor, or the server ends
        the goal.

        This is for code that awaits nothing: a plain function, a thread, a callback. The `await`s
        that follow are clean-up, and are not canceled.

        Raises:
            GoalCanceled: The goal is to stop.
            RuntimeError: The executor does not run.
        """
        running = self.running
        if running is None:
            raise RuntimeError(
                f"goal {self.goal_id} does not run here now: use its handle while it runs"
            )
        running.check()

    @property
    def is_kept(self) -> bool:
        """True if the goal is to stop here and continues in another attempt.

        The server stops and keeps its goals (`at_stop="keep"`), or another worker of the fleet has
        the goal by now. So this tells a planned stop from a cancel:

            except anyio.get_cancelled_exc_class():
                if not goal.is_kept:
                    open_gripper()
                raise
        """
        return self._goal.is_kept

    # Children

    def step(self, name: str, *, wait_for_end: bool = False) -> GoalStep:
        """Return a step of this goal, with which its executor sends another goal, its child.

            await pick.call(Pick("cup"), step=goal.step("pick"))

            async with drive.send_goal(Drive(3), step=goal.step("drive")) as driving:
                async for feedback in driving.feedback:
                    yield Feedback(feedback.meters)

        The ID of the child follows from this goal, the child's action and the `name`, and is the
        same in each attempt. An attempt after the first follows a child that the server of the
        child knows, even one that has ended, and sends it otherwise.

        A child that has not ended when its block or call ends is canceled, so a cancel of this goal
        reaches it. It is left alone if this goal `is_kept`. With `wait_for_end`, a block or call
        whose child is canceled ends after the child has.
        """
        if self.steps is None:
            self.steps = GoalSteps(self._goal)
        return GoalStep(self.steps, name, wait_for_end=wait_for_end)

    # Beyond the life of the process

    @property
    def attempt(self) -> int:
        """Number of this attempt at the goal, from 1.

        There is more than one only with a store: after a crash of the server, or a planned restart.
        """
        return self._goal.attempt

    async def checkpoint(self, state: Any) -> None:
        """Keep a state in the server's store, and return when it is kept.

        The next attempt at the goal gets it as `restored`: this one, or a later one. It replaces
        the previous checkpoint, and is encoded at once. Without a store nothing is kept, nothing is
        waited for, and the first call of a server is a warning in the log.

            async def paint(goal):
                done = goal.restored or 0
                while done < goal.request.strokes:
                    await paint_one(done)
                    done += 1
                    await goal.checkpoint(done)
                    yield Feedback(done)
                yield Result()

        Raises:
            TypeError: The state is not of the type that the `Action` has for checkpoints.
            RuntimeError: The goal has ended.
            StoreError: It cannot be kept, and the server stops; or another server has taken the
                goal over, and this executor is interrupted.
        """
        await self._keeper.keep_checkpoint(self._goal, state)

    # The goal that comes next

    @property
    def successor(self) -> GoalHandle[GoalT] | None:
        """The goal that preempts this one and can be taken over; None if there is none.

        It needs a schedule with `when_full="preempt"` and `handover`. It may change at any `await`:
        a newer goal takes the place of this successor, or a cancel ends it. After an interruption
        it is None.
        """
        return self._succession.successor(self.goal_id)

    async def wait_for_successor(self) -> GoalHandle[GoalT]:
        """Wait until there is a `successor`, and return it.

        Raises:
            RuntimeError: The goal has ended.
        """
        while (successor := self.successor) is None:
            if not self._goal.phase.is_open:
                raise RuntimeError(f"goal {self.goal_id} has ended, and gets no successor")
            await self._succession.news_of(self.goal_id).wait()
        return successor

    def take_over(self) -> GoalHandle[GoalT]:
        """Continue as the successor, and return it: this goal ends as ABORTED, "preempted by <id>".

        All that the executor yields from now on belongs to the successor:

            async def drive(goal):
                while not arrived(goal.request):
                    if goal.successor is not None:
                        goal = goal.take_over()
                    yield Feedback(move_a_little(goal.request))
                yield Result()

        Raises:
            RuntimeError: There is no `successor`, or the result was yielded already.
        """
        return self._succession.take_over(self.goal_id)

    # For type checkers, each name would be an attribute.
    if not TYPE_CHECKING:  # pragma: no branch  # it is always true at run time

        def __getattr__(self, name: str) -> NoReturn:
            raise AttributeError(f"a GoalHandle has no attribute {name!r}{self._hint(name)}")

    def _hint(self, name: str) -> str:
        """Return how to write what was probably meant by an attribute; empty if it is not known."""
        if name in GoalHandle.__slots__ or name[:2] == "__":
            return ""  # it was not set, or Python itself looks for it
        request: object = self.request
        if hasattr(request, name):
            meant = f"goal.request.{name}"
        elif isinstance(request, dict) and name in request:
            meant = f"goal.request[{name!r}]"
        else:
            return ""
        return f": what the client sent is goal.request, so write {meant}"

    def __repr__(self) -> str:
        return f"<GoalHandle {self.goal_id} {self.status.name}>"
