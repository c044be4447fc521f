"""`fibaction_transports.inprocess`: names and places. The contract suite has the rest."""

from __future__ import annotations

import gc

import anyio
import pytest
from msgspec.structs import replace

from fibaction import (
    Action,
    ActionServer,
    ConnectionLost,
    GoalID,
    GoalStatus,
    ServerNotFound,
    TransportError,
    __version__,
    connect,
    serve,
)
from fibaction.border.abc import Endpoint
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction.words.goals import Sender
from fibaction.words.intake import IntakeChange, IntakeMode
from fibaction_transports import inprocess
from fibaction_transports.inprocess import InProcessTransport
from tests.cli.served import Altered
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci

pytestmark = pytest.mark.asyncio


@pytest.mark.parametrize("url", ["inproc://", "inproc://a/b", "inproc://ä", "inproc://a b"])
async def test_a_url_with_no_good_name_is_rejected(url: str) -> None:
    with pytest.raises(TransportError, match="an in-process URL is like inproc://robot, not"):
        InProcessTransport.from_url(url)


async def test_it_takes_the_settings_of_every_client() -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    async with serve(server, "inproc://settings"):
        url = "inproc://settings?token=secret&heartbeat=2"
        async with connect(url, FIBONACCI, reconnect_timeout=5, window=3) as client:
            assert await client.call(Goal(1)) == Result([0, 1])


@pytest.mark.parametrize("setting", ["tokens", "authorize", "insecure"])
async def test_settings_that_would_protect_a_server_are_rejected(setting: str) -> None:
    with pytest.raises(TypeError, match=f"InProcessTransport has no setting '{setting}'"):
        InProcessTransport.from_url("inproc://a", **{setting: None})


async def test_an_invalid_setting_is_an_error_without_its_value() -> None:
    with pytest.raises(TransportError) as caught:
        InProcessTransport.from_url("inproc://a?heartbeat=x&token=secret")
    assert str(caught.value) == "inproc://a: the setting 'heartbeat' cannot be 'x'"


async def test_transports_of_one_name_meet_and_those_without_a_name_do_not() -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    async with server, serve(server, InProcessTransport("here")):
        async with connect(InProcessTransport.from_url("inproc://here"), FIBONACCI) as client:
            assert await client.call(Goal(1)) == Result([0, 1])
        async with connect(InProcessTransport(), FIBONACCI) as client:
            with pytest.raises(ServerNotFound):
                await client.call(Goal(1))


async def test_one_action_cannot_be_served_twice_at_one_place() -> None:
    async with ActionServer(FIBONACCI, fibonacci) as server:
        with pytest.raises(TransportError, match="'fibonacci' is already served at inproc://x"):
            async with InProcessTransport("x").serve(server, server):
                raise AssertionError("the block must not run")
        async with InProcessTransport("x").serve(server):
            with pytest.raises(TransportError, match="'fibonacci' is already served at inproc://x"):
                async with InProcessTransport("x").serve(server):
                    raise AssertionError("the block must not run")


async def test_a_server_that_is_not_there_is_named_with_what_to_do() -> None:
    async with connect("inproc://empty", FIBONACCI) as client, connect("inproc://empty") as other:
        with pytest.raises(ServerNotFound) as caught:
            await client.send_goal(Goal(1))
        assert str(caught.value) == (
            "the action 'fibonacci' is not served at inproc://empty: start its server in this"
            " process, or wait for it with wait_for_server()"
        )
        assert await other.actions() == []
        assert other.release == __version__


async def test_a_name_that_is_not_served_is_told_with_those_that_are() -> None:
    def served(name: str) -> ActionServer[Goal, Feedback, Result]:
        action = Action(name, goal=Goal, feedback=Feedback, result=Result)
        return ActionServer(action, fibonacci)

    async with connect("inproc://mistyped", FIBONACCI) as client:
        for names, shown in (
            (["look", "drive"], "; served there: drive, look"),
            ([f"a{n}" for n in range(11)], "a8, and others"),
        ):
            async with serve([served(name) for name in names], "inproc://mistyped"):
                with pytest.raises(ServerNotFound) as caught:
                    await client.send_goal(Goal(1))
                assert str(caught.value).endswith(shown)


async def test_a_client_waits_for_its_own_action_only() -> None:
    other = Action("other", goal=Goal, feedback=Feedback, result=Result)
    found = anyio.Event()
    async with connect("inproc://wait", FIBONACCI) as client, anyio.create_task_group() as tasks:

        async def wait() -> None:
            await client.wait_for_server()
            found.set()

        tasks.start_soon(wait)
        await anyio.wait_all_tasks_blocked()
        async with serve(ActionServer(other, fibonacci), "inproc://wait"):
            await anyio.wait_all_tasks_blocked()
            assert not found.is_set()
            async with serve(ActionServer(FIBONACCI, fibonacci), "inproc://wait"):
                with anyio.fail_after(30):
                    await found.wait()


@pytest.mark.parametrize("stops", ["before", "meanwhile"])
async def test_a_wait_for_a_server_is_not_ended_by_one_that_has_stopped(stops: str) -> None:
    place, found, stopped = InProcessTransport(), anyio.Event(), anyio.Event()

    async def wait(endpoint: Endpoint) -> None:
        await endpoint.wait_for_server()
        found.set()

    async def until_stopped() -> None:
        await stopped.wait()
        raise ServerNotFound("it has stopped")

    old = Altered(ActionServer(FIBONACCI, fibonacci), wait_for_server=until_stopped)
    with anyio.fail_after(5):
        async with place.connect() as connection, anyio.create_task_group() as tasks:
            async with place.serve(old):
                if stops == "before":
                    stopped.set()
                tasks.start_soon(wait, connection.endpoint(FIBONACCI))
                await anyio.wait_all_tasks_blocked()
                assert not found.is_set()
            async with serve(ActionServer(FIBONACCI, fibonacci), place):
                await anyio.wait_all_tasks_blocked()
                stopped.set()
                await found.wait()


async def test_an_endpoint_hands_everything_on() -> None:
    async with serve(ActionServer(FIBONACCI, fibonacci), "inproc://all"):
        async with connect("inproc://all") as connection:
            endpoint = connection.endpoint(FIBONACCI.info)
            assert endpoint.info == FIBONACCI.info
            await endpoint.wait_for_server()
            stream = await endpoint.send_goal(GoalID.random(), FIBONACCI.goal.encode(Goal(1)))
            assert (await stream.outcome()).status is GoalStatus.SUCCEEDED
            assert (await endpoint.feedback(stream.goal_id)).goal_id == stream.goal_id
            again = await endpoint.feedback(stream.goal_id, after=1, own=True, attempt=2)
            assert again.cursor == 0
            assert not (await endpoint.cancel_goals(stream.goal_id)).accepted
            first = await (await endpoint.status()).receive()
            assert first is not None
            assert first.goal_id == stream.goal_id
            assert await endpoint.past_goals(PastPage()) == []
            await endpoint.read_past(GoalQuery(), print)
            paused = await endpoint.change_intake(IntakeChange(IntakeMode.HOLD))
            assert paused == await endpoint.intake()
            assert await endpoint.rerun(stream.goal_id) is None
            assert await endpoint.log_lines(stream.goal_id) is None


async def test_a_gateway_names_the_owner_of_a_goal_and_any_other_sender_is_its_connection() -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    async with serve(server, "inproc://owned"), connect("inproc://owned") as connection:
        endpoint, goal = connection.endpoint(FIBONACCI.info), FIBONACCI.goal.encode(Goal(1))
        theirs, own = GoalID.random(), GoalID.random()
        ann = Sender("ann", b"ann")
        assert (await endpoint.send_goal(theirs, goal, sender=ann)).own
        assert (await server.send_goal(theirs, goal, sender=ann)).own
        assert not (await endpoint.send_goal(theirs, goal)).own
        assert (await endpoint.send_goal(own, goal)).own
        assert not (await server.send_goal(own, goal, sender=ann)).own
        assert endpoint.owner_of(theirs) == b"ann"
        assert endpoint.owner_of(own) == server.owner_of(own) != b""
        elsewhere = connection.endpoint(replace(FIBONACCI.info, name="elsewhere"))
        assert elsewhere.owner_of(own) == b""


async def test_a_place_that_is_not_used_any_more_is_forgotten() -> None:
    InProcessTransport("passing")
    gc.collect()
    assert "inproc://passing" not in inprocess._directories


async def test_a_connection_that_was_closed_says_so() -> None:
    async with InProcessTransport("closed").connect() as connection:
        endpoint = connection.endpoint(FIBONACCI)
    with pytest.raises(ConnectionLost, match="the connection to inproc://closed was closed here"):
        await endpoint.status()


async def test_a_transport_knows_its_url() -> None:
    assert InProcessTransport("robot").url == "inproc://robot"
