"""The text that goes with a goal, for traces, from the client to the watchers of the server."""

from __future__ import annotations

import pytest

from fibaction import ActionServer, GoalID, InvalidMessage, Sender, Watcher
from fibaction.border.abc import Meta
from fibaction.testing.contract.fibonacci import FIBONACCI, Goal, fibonacci
from fibaction.testing.contract.reach import Reach

pytestmark = pytest.mark.anyio

GOAL = FIBONACCI.goal.encode(Goal(3))


class Noting(Watcher):
    """A watcher that notes the meta of each goal."""

    def __init__(self) -> None:
        self.metas: list[dict[str, str]] = []

    def offered(
        self, action: str, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> None:
        self.metas.append(dict(meta))


@pytest.mark.promise("ACCEPT-16")
async def test_the_meta_of_a_goal_reaches_the_watchers(reach: Reach) -> None:
    noting = Noting()
    meta = {"traceparent": "00-" + "0af7" * 8 + "-" + "b7ad" * 4 + "-01", "baggage": "käse=ja"}
    async with reach(ActionServer(FIBONACCI, fibonacci, watchers=[noting])) as client:
        for carried in (meta, None, {}):
            stream = await client.endpoint.send_goal(GoalID.random(), GOAL, meta=carried)
            await stream.outcome()
        await client.call(Goal(1))

    assert noting.metas == [meta, {}, {}, {}]


@pytest.mark.promise("ACCEPT-16")
async def test_a_meta_over_the_limits_is_an_error_and_nothing_is_sent(reach: Reach) -> None:
    noting = Noting()
    async with reach(ActionServer(FIBONACCI, fibonacci, watchers=[noting])) as client:
        for meta in ({"a": "x" * 4096}, {str(number): "" for number in range(9)}):
            with pytest.raises(InvalidMessage, match=r"^the goal's meta has .* the limit$"):
                await client.endpoint.send_goal(GoalID.random(), GOAL, meta=meta)
        await client.call(Goal(1))

    assert noting.metas == [{}]


@pytest.mark.promise("ACCEPT-19")
async def test_lists_have_the_labels_of_a_goal_also_after_its_end(reach: Reach) -> None:
    labels = {"order": "17", "site": "käse"}
    async with reach(ActionServer(FIBONACCI, fibonacci)) as client:
        async with client.send_goal(Goal(3), labels=labels) as goal:
            first = {info.goal_id: info.labels for info in await client.goals()}
            await goal.result()
        await client.call(Goal(1), labels={"order": "18"})
        await client.call(Goal(1))
        last = [info.labels for info in await client.goals()]
        with pytest.raises(ValueError, match="'parent' is not the key of a label"):
            await client.call(Goal(1), labels={"parent": "17"})

    assert first == {goal.goal_id: labels}
    assert last == [labels, {"order": "18"}, {}]
