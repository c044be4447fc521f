"""Children of goals: what is wrong to write, and what a planned stop does not end."""

from __future__ import annotations

from collections.abc import AsyncGenerator

import anyio
import pytest

from fibaction import (
    ActionClient,
    ActionServer,
    ConnectionLost,
    Endpoint,
    GoalCanceled,
    GoalHandle,
    GoalID,
    GoalStatus,
    Outcome,
)
from fibaction.border.abc import ForwardingEndpoint, GoalStream
from fibaction.testing.contract.test_senders import MISSION, Items, Mission
from fibaction.words.goal_steps import GoalStep, GoalSteps
from tests.support.executors import Steps
from tests.support.fibonacci import FIBONACCI, Goal, fibonacci
from tests.support.matching import End
from tests.support.memory_store import MemoryStore

pytestmark = pytest.mark.anyio


async def reason_of(mission: object, arm_server: Endpoint) -> str:
    """Run a mission with an arm, and return the reason of its abort."""

    async def run(goal: GoalHandle[int]) -> Items:
        await mission(goal, ActionClient(arm_server, FIBONACCI))  # type: ignore[operator]  # a test's own
        yield [0]

    async with ActionServer(MISSION, run) as server:
        goal = await ActionClient(server, MISSION).send_goal(3)
        outcome = await goal.outcome()
        return outcome.reason.replace(str(goal.goal_id), "<id>")


async def test_a_step_is_taken_once_in_an_attempt() -> None:
    async def twice(goal: GoalHandle[int], arm: ActionClient[Goal, object, object]) -> None:
        for _ in range(2):
            await arm.call(Goal(1), step=goal.step("pick"))

    async with ActionServer(FIBONACCI, fibonacci) as server:
        assert await reason_of(twice, server) == (
            "ValueError: the step 'pick' of goal <id> was taken before: give each step a name of"
            " its own, such as 'pick 2'"
        )


async def test_a_step_has_a_block_and_its_own_id() -> None:
    async def awaited(goal: GoalHandle[int], arm: ActionClient[Goal, object, object]) -> None:
        with pytest.raises(TypeError, match="give goal_id or step, not both"):
            arm.send_goal(Goal(1), goal_id=GoalID.random(), step=goal.step("pick"))
        await arm.send_goal(Goal(1), step=goal.step("pick"))

    async with ActionServer(FIBONACCI, fibonacci) as server:
        assert await reason_of(awaited, server) == (
            "TypeError: a step is not awaited, because a cancel of its goal is to reach it: write"
            " `async with client.send_goal(..., step=...) as child`"
        )


class Losing(ForwardingEndpoint):
    """An endpoint that loses the answer to the first goal, and the end of a canceled one."""

    def __init__(self, inner: Endpoint) -> None:
        super().__init__(inner)
        self.is_lost = True

    async def offer_goal(self, request: object) -> object:  # type: ignore[override]  # short
        stream = await super().offer_goal(request)  # type: ignore[arg-type]  # as above
        if self.is_lost:
            self.is_lost = False
            raise ConnectionLost("the line broke")
        return stream


async def test_a_step_whose_connection_was_lost_is_taken_again_and_runs_once() -> None:
    async def again(goal: GoalHandle[int], arm: ActionClient[Goal, object, object]) -> None:
        with pytest.raises(ConnectionLost):
            await arm.call(Goal(1), timeout=60, step=goal.step("pick"))
        await arm.call(Goal(1), timeout=60, step=goal.step("pick"))

    child = Steps(go=True)
    async with ActionServer(FIBONACCI, child) as server:
        assert await reason_of(again, Losing(server)) == ""
    assert child.runs.total() == 1


async def test_a_cancel_after_a_planned_stop_has_interrupted_reaches_the_child() -> None:
    child, store = Steps(), MemoryStore()
    interrupted, cleaned = anyio.Event(), anyio.Event()

    async def mission(goal: GoalHandle[int]) -> AsyncGenerator[int | list[int], None]:
        try:
            await ActionClient(arm, FIBONACCI).call(Goal(1), step=goal.step("pick"))
        except anyio.get_cancelled_exc_class():
            interrupted.set()
            await cleaned.wait()
            raise
        yield [0]

    async with ActionServer(FIBONACCI, child) as arm:
        server = ActionServer(MISSION, mission, store=store, at_stop="keep", shutdown_timeout=60)
        async with anyio.create_task_group() as tasks, server:
            client = ActionClient(server, MISSION)
            goal = await client.send_goal(3)
            await child.began.wait()
            tasks.start_soon(server.stop)
            await interrupted.wait()
            assert (await goal.cancel()).accepted
            cleaned.set()
            assert (await goal.outcome()).status is GoalStatus.CANCELED
        assert (await arm.get_result(next(iter(child.runs)))).status is GoalStatus.CANCELED


async def test_a_timeout_inside_an_executor_cancels_the_child_and_waits_for_its_end() -> None:
    child = Steps()

    async def mission(goal: GoalHandle[int]) -> Items:
        step = goal.step("pick", wait_for_end=True)
        with anyio.CancelScope() as scope:
            async with ActionClient(arm, FIBONACCI).send_goal(Goal(1), step=step):
                await child.began.wait()
                scope.cancel()
                await anyio.sleep_forever()
        outcome = await arm.get_result(next(iter(child.runs)))
        yield [outcome.status]

    async with ActionServer(FIBONACCI, child) as arm, ActionServer(MISSION, mission) as server:
        goal = await ActionClient(server, MISSION).send_goal(3)
        assert await goal.outcome() == End(GoalStatus.SUCCEEDED, [GoalStatus.CANCELED])


async def test_a_mission_without_a_connection_to_its_child_still_ends() -> None:
    """The cancel has no answer, and the end of the child is not known."""

    class Gone(ForwardingEndpoint):
        async def offer_goal(self, request: object) -> None:  # type: ignore[override]  # short
            sending.set()
            await anyio.sleep_forever()

        async def get_result(self, goal_id: GoalID) -> Outcome[bytes]:
            raise ConnectionLost("the line broke")

    sending = anyio.Event()
    async with ActionServer(FIBONACCI, fibonacci) as inner:
        mission = Mission(ActionClient(Gone(inner), FIBONACCI), wait_for_end=True)
        async with ActionServer(MISSION, mission) as server:
            goal = await ActionClient(server, MISSION).send_goal(3)
            await sending.wait()
            await goal.cancel()
            assert (await goal.outcome()).status is GoalStatus.CANCELED


class SecondAttempt:
    """A goal whose executor runs again."""

    goal_id = GoalID.random()
    attempt = 2
    is_kept = False


class Away(ForwardingEndpoint):
    """An endpoint whose server is away when a client follows a goal."""

    async def feedback(
        self, goal_id: GoalID, *, after: int | None = None, own: bool = False, attempt: int = 1
    ) -> GoalStream:
        raise ConnectionLost("the line broke")


async def test_a_later_attempt_sends_a_child_that_was_never_sent_and_no_other() -> None:
    step = GoalStep(GoalSteps(SecondAttempt()), "pick", wait_for_end=False)
    async with ActionServer(FIBONACCI, fibonacci) as server:
        with pytest.raises(ConnectionLost):
            await ActionClient(Away(server), FIBONACCI).call(Goal(1), step=step)
        client = ActionClient(server, FIBONACCI)
        assert await client.goals() == []
        await client.call(Goal(1), step=step)
        assert [info.goal_id for info in await client.goals()] == [step.child_id("fibonacci")]


async def test_a_step_whose_connection_is_lost_in_its_block_may_be_taken_again() -> None:
    step = GoalStep(GoalSteps(SecondAttempt()), "pick", wait_for_end=False)
    async with ActionServer(FIBONACCI, fibonacci) as server:
        client = ActionClient(server, FIBONACCI)
        with pytest.raises(ConnectionLost):
            async with client.send_goal(Goal(1), step=step):
                raise ConnectionLost("the line broke")
        with pytest.raises(GoalCanceled):  # the block has canceled it, and it is the same goal
            await client.call(Goal(1), step=step)
