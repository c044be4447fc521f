"""New names of actions behind a bridge."""

from __future__ import annotations

import pytest

from fibaction import ActionServer, GoalID, GoalStatus
from fibaction.cli.arguments.names import ROOT, Namespace
from fibaction.cli.bridge.renames import AS_THEY_ARE, Renames
from fibaction.cli.process.exit_codes import Failure
from tests.support.fibonacci import FIBONACCI, Goal, fibonacci

ARM, LAB = Namespace("/arm"), Namespace("/lab")


@pytest.mark.parametrize(
    ("source", "target", "old", "new"),
    [
        (ROOT, None, "pick", "pick"),
        (ROOT, None, "/arm/pick", "/arm/pick"),
        (ROOT, LAB, "/arm/pick", "lab/arm/pick"),
        (ROOT, LAB, "pick", "lab/pick"),
        (ARM, LAB, "arm/pick", "lab/pick"),
        (ARM, LAB, "/arm/left/pick", "lab/left/pick"),
        (ARM, ROOT, "/arm/pick", "pick"),
        (ARM, None, "/arm/pick", "/arm/pick"),
        (ARM, LAB, "/army/pick", "lab/army/pick"),
    ],
)
def test_a_namespace_takes_the_place_of_another(
    source: Namespace, target: Namespace | None, old: str, new: str
) -> None:
    assert Renames(source, target).new_name(old) == new


@pytest.mark.parametrize(
    ("rule", "source", "target", "old", "new"),
    [
        ("pick=grasp", ROOT, None, "/pick", "grasp"),
        ("/arm/pick=grasp", ROOT, None, "arm/pick", "grasp"),
        ("pick:=grasp", ARM, None, "/arm/pick", "arm/grasp"),
        ("pick=left/grasp", ARM, LAB, "/arm/pick", "lab/left/grasp"),
        ("/arm/pick=/grasp", ARM, LAB, "/arm/pick", "grasp"),
    ],
)
def test_a_rule_comes_before_the_namespace(
    rule: str, source: Namespace, target: Namespace | None, old: str, new: str
) -> None:
    assert Renames.parse([rule], source, target).new_name(old) == new


def test_names_that_clash_are_found_only_among_new_ones() -> None:
    AS_THEY_ARE.check(["pick", "/pick"])  # as the server has them
    with pytest.raises(Failure, match=r"^/arm/pick and /pick cannot both be served as /pick"):
        Renames.parse(["arm/pick=pick"], ROOT, None).check(["pick", "arm/pick"])
    Renames.parse(["arm/pick=pick", "pick=arm/pick"], ROOT, None).check(["pick", "arm/pick"])


@pytest.mark.asyncio
async def test_an_endpoint_under_a_new_name_is_the_same_one() -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    assert AS_THEY_ARE.endpoint(server) is server
    renamed = Renames(ROOT, LAB).endpoint(server)
    assert renamed.info.name == "lab/fibonacci"
    assert renamed.info.goal == server.info.goal
    async with server:
        goal = FIBONACCI.goal.encode(Goal(2))
        with await renamed.send_goal(GoalID.random(), goal) as stream:
            assert (await stream.outcome()).status is GoalStatus.SUCCEEDED
