"""Names of actions behind a bridge, and its serving end, of each of its two kinds."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import anyio
import pytest

from fibaction import Action, ActionServer, ClientConnection, GoalID, GoalStatus, connect
from fibaction.cli.arguments.names import ROOT, Namespace
from fibaction.cli.bridge.ends import AS_THEY_ARE, Renames, open_end
from fibaction.cli.process.exit_codes import Failure
from fibaction.words.errors import ServerNotFound, TransportError
from fibaction_transports.inprocess import InProcessTransport
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci

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


async def names(connection: ClientConnection) -> list[str]:
    return sorted(info.name for info in await connection.actions())


def named(name: str) -> Action[Goal, Feedback, Result]:
    return Action(name, goal=Goal, feedback=Feedback, result=Result)


@pytest.fixture(params=["inproc://bridge_end", "unix"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return f"unix://{tmp_path}/socket" if request.param == "unix" else request.param


@pytest.mark.asyncio
async def test_actions_are_added_and_removed_while_others_run(url: str) -> None:
    action = named("one")
    one, other = ActionServer(action, fibonacci), ActionServer(named("other"), fibonacci)
    with anyio.fail_after(10):
        async with one, other, open_end(url) as end:
            await end.add(one)
            await end.begin()
            assert end.can_change
            assert end.where == url
            async with connect(url) as connection:
                client = connection.client(action)
                goal = await client.send_goal(Goal(3))
                async with anyio.create_task_group() as tasks:
                    tasks.start_soon(connection.client(named("other")).wait_for_server)
                    assert await names(connection) == ["one"]
                    await end.add(other)
                assert await names(connection) == ["one", "other"]
                await end.remove("other")
                assert await names(connection) == ["one"]
                assert (await goal.result()).sequence == [0, 1, 1, 2]
                await end.remove("one")
                with pytest.raises((ServerNotFound, TransportError)):
                    await client.call(Goal(1))
        with suppress(TransportError):
            async with connect(url) as connection:
                assert await names(connection) == []


@pytest.mark.asyncio
async def test_an_action_that_cannot_be_served_leaves_the_others() -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    with anyio.fail_after(10):
        async with server, open_end("inproc://bridge_end") as end:
            await end.add(server)
            with pytest.raises(TransportError):
                await end.add(server)
            async with connect("inproc://bridge_end") as connection:
                assert await names(connection) == ["fibonacci"]


@pytest.mark.asyncio
async def test_a_server_whose_actions_stay_begins_with_all_of_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(InProcessTransport, "shares_address", False)
    one, other = (ActionServer(named(name), fibonacci) for name in ("one", "other"))
    with anyio.fail_after(10):
        async with open_end("inproc://bridge_end") as end:
            assert not end.can_change
            await end.add(one)
            await end.add(other)
            await end.remove("other")
            await end.begin()
            async with connect(end.where) as connection:
                assert await names(connection) == ["one"]


@pytest.mark.asyncio
async def test_an_address_that_cannot_be_used_is_an_error() -> None:
    with pytest.raises(TransportError, match="is for clients: serve at http://"):
        async with open_end("rosbridge://127.0.0.1:9090"):
            pass
