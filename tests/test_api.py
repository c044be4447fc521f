"""`serve` and `connect`: servers and transports, started and stopped in the right order."""

from __future__ import annotations

import gc
import re
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any, cast

import anyio
import pytest

import fibaction.blocking
from fibaction import (
    Action,
    ActionInfo,
    ActionPeers,
    ActionServer,
    ClientConnection,
    GoalAborted,
    GoalHandle,
    GoalInfo,
    GoalKept,
    Outcome,
    Report,
    ServerNotFound,
    StoreError,
    TransportError,
    Watcher,
    __version__,
    action,
    call,
    connect,
    serve,
)
from fibaction.border.abc import Connection, ForwardingEndpoint, GoalRequest, GoalStream
from fibaction.border.goal_store import GoalStore
from fibaction.testing import run_executor
from fibaction.words.goals import Sender
from fibaction_transports.inprocess import InProcessTransport
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.memory_store import Fate, MemoryStore
from tests.support.one_worker import WORKER, OneWorker

pytestmark = pytest.mark.asyncio


async def test_with_an_action_it_gives_a_client_and_without_one_a_connection() -> None:
    async with serve(ActionServer(FIBONACCI, fibonacci), "inproc://connection"):
        async with connect("inproc://connection", FIBONACCI) as client:
            assert await client.call(Goal(1)) == Result([0, 1])
        async with connect("inproc://connection") as connection:
            assert isinstance(connection, ClientConnection)
            assert repr(connection) == "<ClientConnection to inproc://connection>"
            assert await connection.client(FIBONACCI).call(Goal(1)) == Result([0, 1])
            assert await connection.actions() == [FIBONACCI.info]
            assert connection.endpoint(FIBONACCI).info == FIBONACCI.info


class Keeping(InProcessTransport):
    """A transport that keeps the goals of its servers."""

    @asynccontextmanager
    async def goal_store(self) -> AsyncGenerator[GoalStore, None]:
        yield MemoryStore()


async def test_a_transport_keeps_the_goals_of_its_servers() -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    other = Action("other", goal=Goal, feedback=Feedback, result=Result)
    gateway = ForwardingEndpoint(ActionServer(other, fibonacci))
    transport = Keeping("keeping")
    async with serve([server, gateway], transport), connect(transport, FIBONACCI) as client:
        goal = await client.send_goal(Goal(1))
        await goal.result()
        assert isinstance(server.store, MemoryStore)
        assert ("fibonacci", goal.goal_id) in server.store.goals


async def test_a_transport_that_keeps_goals_takes_new_servers_without_a_store_only() -> None:
    kept = ActionServer(FIBONACCI, fibonacci, store=MemoryStore())
    with pytest.raises(TransportError, match="has a store, and this address keeps the goals"):
        async with serve(kept, Keeping("keeping")):
            pass
    async with ActionServer(FIBONACCI, fibonacci) as started:
        with pytest.raises(TransportError, match="was started before, and this address keeps"):
            async with serve(started, Keeping("keeping")):
                pass


async def test_a_connection_knows_the_workers_of_a_fleet() -> None:
    async with connect(OneWorker()) as connection:
        assert await connection.workers() == [WORKER]
        assert connection.release == __version__


async def test_without_a_block_a_client_or_a_connection_is_awaited_and_closed() -> None:
    async with serve(ActionServer(FIBONACCI, fibonacci), "inproc://connection"):
        client = await connect("inproc://connection", FIBONACCI)
        assert await client.call(Goal(1)) == Result([0, 1])
        connection = await connect("inproc://connection")
        assert await connection.client(FIBONACCI).call(Goal(1)) == Result([0, 1])
        await client.aclose()
        await connection.aclose()


async def test_a_connection_that_its_block_closes_is_not_closed_by_hand() -> None:
    async with connect("inproc://connection") as connection:
        with pytest.raises(RuntimeError, match="the block of `async with connect"):
            await connection.aclose()


async def test_a_forgotten_await_is_told_with_what_to_write() -> None:
    forgotten: Any = connect("inproc://connection", FIBONACCI)
    with pytest.raises(AttributeError, match="has no attribute 'call', because it has not conn"):
        forgotten.call(Goal(1))


async def test_servers_without_a_block_are_stopped_in_another_task() -> None:
    opened: list[Any] = []

    async def open_servers() -> None:
        opened.append(await serve(ActionServer(FIBONACCI, fibonacci), "inproc://kept"))

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(open_servers)
    [servers] = opened
    assert servers.urls == ("inproc://kept",)
    assert repr(servers) == "<KeptServers at inproc://kept>"
    assert await call("inproc://kept", FIBONACCI, Goal(2)) == Result([0, 1, 1])
    with pytest.raises(TransportError, match="already served"):
        await serve(ActionServer(FIBONACCI, fibonacci), "inproc://kept")
    await servers.aclose()
    await servers.aclose()
    with pytest.raises(ServerNotFound):
        await call("inproc://kept", FIBONACCI, Goal(2))


async def test_servers_whose_value_is_dropped_stop_and_the_log_says_what_to_write(
    caplog: pytest.LogCaptureFixture,
) -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    await serve(server, "inproc://dropped")
    gc.collect()
    assert "write `async with serve(...):`" in caplog.text
    with anyio.fail_after(5):
        while server.is_running:
            await anyio.lowlevel.checkpoint()


async def test_servers_without_a_block_tell_the_failure_of_their_store() -> None:
    store = MemoryStore(lambda _number, _what: Fate.FAILED)
    server = ActionServer(FIBONACCI, fibonacci, store=store)
    servers = await serve(server, "inproc://failing")
    with pytest.raises(GoalKept):
        await call("inproc://failing", FIBONACCI, Goal(2))
    with pytest.raises(StoreError, match="broken, on purpose"):
        await servers.aclose()
    await servers.aclose()


async def test_the_servers_and_the_clients_of_an_action_are_those_that_the_transport_knows() -> (
    None
):
    class Told(InProcessTransport):
        """A transport that knows."""

        @asynccontextmanager
        async def connect(self) -> AsyncGenerator[Connection, None]:
            async with super().connect() as connection:
                yield Knowing(connection)

    class Knowing(ClientConnection):
        async def peers(self, action: str) -> ActionPeers:
            return ActionPeers(servers=(f"who serves {action}",))

        async def interface_texts(self, action: ActionInfo) -> dict[str, str]:
            return {action.type_name: "---\n---\n"}

        async def nodes(self) -> set[str]:
            return {"/robot1/arm"}

    async with connect(Told()) as connection:
        assert await connection.nodes() == {"/robot1/arm"}
        assert await connection.peers("fibonacci") == ActionPeers(("who serves fibonacci",))
        assert await connection.interface_texts(ActionInfo("a", "b")) == {"b": "---\n---\n"}
    async with connect(InProcessTransport()) as connection:
        assert await connection.peers("fibonacci") == ActionPeers()


class Refusing(InProcessTransport):
    """A transport whose connections have no action."""

    def __init__(self) -> None:
        super().__init__()
        self.open = 0

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        class Without(Connection):
            def endpoint(self, action: Any) -> Any:
                raise TransportError("its types do not fit")

            async def actions(self) -> list[ActionInfo]:
                return []

        self.open += 1
        try:
            yield Without()
        finally:
            self.open -= 1


@pytest.mark.parametrize("is_block", [True, False])
async def test_a_connection_that_cannot_have_the_action_is_closed(*, is_block: bool) -> None:
    transport = Refusing()

    with pytest.raises(TransportError, match="do not fit"):
        if is_block:
            async with connect(transport, FIBONACCI):
                raise AssertionError("it is connected")
        else:
            await connect(transport, FIBONACCI)

    assert transport.open == 0


async def test_settings_go_to_the_transport() -> None:
    with pytest.raises(TransportError, match="reconnect_timeout must be between 0 and inf"):
        async with connect("inproc://connection", FIBONACCI, reconnect_timeout=-1):
            raise AssertionError("the block must not run")


SERVER = ActionServer(FIBONACCI, fibonacci)


@pytest.mark.parametrize(
    ("where", "given", "text"),
    [
        *(
            (
                "inproc://a",
                given,
                f"connect() takes an address and, optionally, an Action; {given!r} is not an",
            )
            for given in (SERVER, "fibonacci", Goal)
        ),
        ("inproc://a", fibonacci, "make one of it with @action('fibonacci')"),
        (FIBONACCI, "inproc://a", f"not {FIBONACCI!r}"),
    ],
)
async def test_what_is_no_action_or_no_address_is_told_in_one_sentence(
    where: Any, given: Any, text: str
) -> None:
    with pytest.raises(TypeError, match=re.escape(text)):
        connect(where, given)


async def test_a_call_without_an_action_is_told_in_one_sentence() -> None:
    nothing: Any = None
    text = "call() takes an address, an Action and its goal; None is not an Action"
    with pytest.raises(TypeError, match=re.escape(text)):
        await call("inproc://connection", nothing, 3)
    with pytest.raises(TypeError, match=re.escape(text)):
        fibaction.blocking.call("tcp://127.0.0.1:1", nothing, 3)


async def test_a_connection_says_which_clients_have_what_it_has_not() -> None:
    async with connect("inproc://connection") as connection:
        unknown: Any = connection
        with pytest.raises(AttributeError, match=r"or `connection.client\(ACTION\).call`"):
            unknown.call(3)
        with pytest.raises(AttributeError, match=r"a connection has no attribute 'nonsense'$"):
            unknown.nonsense()


OTHER = Action("other", goal=Goal, feedback=Feedback, result=Result)


async def test_several_servers_at_several_addresses() -> None:
    servers = [ActionServer(FIBONACCI, fibonacci), ActionServer(OTHER, fibonacci)]
    async with serve(servers, "inproc://a", InProcessTransport("b")) as urls:
        assert urls == ("inproc://a", "inproc://b")
        for url in urls:
            async with connect(url) as connection:
                for action in (FIBONACCI, OTHER):
                    assert await connection.client(action).call(Goal(1)) == Result([0, 1])


class Ends(Watcher):
    """A watcher that counts the ends of goals."""

    def __init__(self) -> None:
        self.actions: list[str] = []

    def ended(self, action: str, info: GoalInfo, outcome: Outcome[bytes]) -> None:
        self.actions.append(action)


async def test_watchers_are_added_to_each_server_and_to_servers_only() -> None:
    ends = Ends()
    servers = [ActionServer(FIBONACCI, fibonacci), ActionServer(OTHER, fibonacci)]
    async with serve(servers, "inproc://a", watchers=[ends]), connect("inproc://a") as connection:
        for action in (FIBONACCI, OTHER):
            await connection.client(action).call(Goal(1))
    assert ends.actions == ["fibonacci", "other"]

    wrapped = ForwardingEndpoint(ActionServer(FIBONACCI, fibonacci))
    with pytest.raises(TypeError, match="only an ActionServer can have watchers"):
        async with serve(wrapped, "inproc://a", watchers=[ends]):
            pytest.fail("it is served")


async def test_a_server_that_runs_already_is_neither_started_nor_stopped() -> None:
    async with ActionServer(FIBONACCI, fibonacci) as server:
        for url in ("inproc://first", "inproc://second"):
            async with serve(server, url), connect(url, FIBONACCI) as client:
                assert await client.call(Goal(1)) == Result([0, 1])


async def test_a_server_that_was_stopped_is_not_served_again_in_silence() -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    async with serve(server, "inproc://once"):
        pass
    with pytest.raises(RuntimeError, match="was started before; make another one"):
        async with serve(server, "inproc://once"):
            raise AssertionError("the block must not run")


async def test_clients_are_answered_before_the_address_is_closed() -> None:
    async def waits(goal: GoalHandle[Goal]) -> Items:
        yield Feedback([1])
        await anyio.sleep_forever()

    async with connect("inproc://bye", FIBONACCI) as client:
        async with serve(
            [ActionServer(FIBONACCI, waits), ActionServer(OTHER, waits)], "inproc://bye"
        ):
            goal = await client.send_goal(Goal(1))
        with pytest.raises(GoalAborted, match="server stopped"):
            await goal.result()
        with pytest.raises(ServerNotFound, match="the action 'fibonacci' is not served"):
            await client.send_goal(Goal(1))


async def test_an_address_that_cannot_be_used_stops_what_was_started() -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    with pytest.raises(TransportError, match="no transport for pigeon://"):
        async with serve(server, "inproc://a", "pigeon://b"):
            raise AssertionError("the block must not run")
    assert server.is_new
    async with serve(ActionServer(FIBONACCI, fibonacci), "inproc://a"):
        with pytest.raises(TransportError, match="is already served at inproc://a"):
            async with serve(server, "inproc://a"):
                raise AssertionError("the block must not run")
    assert repr(server) == "<ActionServer 'fibonacci' stopped goals=0>"


async def test_settings_go_to_the_transports() -> None:
    with pytest.raises(TypeError, match="tokens"):
        async with serve(ActionServer(FIBONACCI, fibonacci), "inproc://a", tokens={"x": "me"}):
            raise AssertionError("the block must not run")


@pytest.mark.parametrize(
    ("given", "where", "shown"),
    [
        ("inproc://a?token=secret", SERVER, "'inproc://a'"),
        (FIBONACCI, "inproc://a", repr(FIBONACCI)),
        ([SERVER, FIBONACCI], "inproc://a", repr(FIBONACCI)),
        (["inproc://b", SERVER], "inproc://a", "'inproc://b'"),
        (None, "inproc://a", "None"),
        (fibonacci, "inproc://a", repr(fibonacci)),
    ],
    ids=["swapped", "an action", "an action in a list", "a URL in a list", "nothing", "a function"],
)
async def test_what_is_no_server_is_told_in_one_sentence(
    given: Any, where: Any, shown: str
) -> None:
    hint = ""
    if shown == repr(FIBONACCI):
        hint = ": write serve(ActionServer(FIBONACCI, executor), ...)"
    elif given is fibonacci:
        hint = ": make an action of a function with @action, or give it to an ActionServer"
    with pytest.raises(TypeError) as caught:
        async with serve(given, where):
            raise AssertionError("the block must not run")
    assert str(caught.value) == (
        f"serve() takes servers, such as ActionServer(action, executor), and then addresses;"
        f" {shown} is not a server{hint}"
    )
    assert SERVER.is_new


async def test_serving_without_an_address_is_rejected_with_what_to_do_instead() -> None:
    with pytest.raises(TypeError) as caught:
        async with serve(SERVER):
            raise AssertionError("the block must not run")
    assert str(caught.value) == (
        "serve() needs at least one address: a URL such as tcp://127.0.0.1:7400, or a transport; to"
        " use a server without an address, enter it with `async with`, and give it to an"
        " ActionClient"
    )
    assert SERVER.is_new


class Audited(ForwardingEndpoint):
    """A wrapper that notes who sends goals."""

    def __init__(self, inner: ActionServer[Goal, Feedback, Result]) -> None:
        super().__init__(inner)
        self.senders: list[Sender] = []

    async def offer_goal(self, request: GoalRequest) -> GoalStream:
        self.senders.append(request.sender)
        return await super().offer_goal(request)


async def test_a_server_that_is_wrapped_is_started_served_and_stopped() -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    wrapper = Audited(server)
    async with serve(wrapper, "tcp://127.0.0.1:0") as (url,), connect(url, FIBONACCI) as client:
        assert server.is_running
        assert await client.call(Goal(2)) == Result([0, 1, 1])
        (info,) = await client.goals()
    (sender,) = wrapper.senders
    assert info.client == str(sender) == sender.address != ""
    assert sender.owner != b""
    assert not server.is_running


@action
async def drive(report: Report[int], meters: int) -> str:
    await report(meters)
    return f"drove {meters} m"


@action
async def home() -> str:
    return "at home"


async def test_functions_that_are_actions_are_served_and_called() -> None:
    found: list[int] = []
    async with serve([drive, home], "inproc://functions", "tcp://127.0.0.1:0") as (here, there):
        async with connect(here, drive) as client:
            assert await client.call(1) == "drove 1 m"
        assert await call(there, drive, 3, on_feedback=found.append) == "drove 3 m"
        assert await call(there, home) == "at home"
    assert found == [3]
    async with serve(drive, "inproc://functions"):
        assert await call("inproc://functions", drive, 1, timeout=5) == "drove 1 m"


class Rover:
    def __init__(self, name: str) -> None:
        self.name = name

    @action
    async def move(self, report: Report[float], x: float, speed: float = 1.0) -> str:
        await report(x)
        return f"{self.name} moved {x:g} m at {speed:g} m/s"

    @action("arm/grip")
    async def grip(self) -> str:
        return f"{self.name} grips"


async def test_an_object_is_served_with_the_actions_that_are_its_methods() -> None:
    rover = Rover("rover")
    for served in (rover, [rover], [rover.move, rover.grip]):
        async with serve(served, "inproc://rover"):
            assert await call("inproc://rover", Rover.move, 2) == "rover moved 2 m at 1 m/s"
            assert await call("inproc://rover", rover.grip) == "rover grips"
    with pytest.raises(TypeError, match=r": serve an object of it, as in serve\(Rover\(\), "):
        async with serve(Rover, "inproc://rover"):
            raise AssertionError("the block must not run")


async def test_arguments_are_given_by_place_by_name_or_as_a_goal_beside_options() -> None:
    found: list[float] = []
    move = Rover.move
    async with serve(Rover("rover"), "tcp://127.0.0.1:0") as (url,), connect(url, move) as client:
        for answer in (
            await call(url, move, 2, 3),
            await call(url, move, x=2, speed=3),
            await call(url, move, move.goal_of(2, speed=3), on_feedback=found.append),
            await client.call(2, speed=3),
            await client.call(move.goal_of(2, 3), timeout=5),
            await (await client.send_goal(x=2, speed=3)).result(),
        ):
            assert answer == "rover moved 2 m at 3 m/s"
        assert await client.call(2, on_feedback=found.append) == "rover moved 2 m at 1 m/s"
    assert found == [2, 2]


@action("cook")
async def cook(minutes: int, timeout: float = 1.0) -> float:
    return minutes + timeout


@action
async def log_in(token: str) -> str:
    return token


ANY_LOG_IN = cast("Any", log_in)
PLAIN: Any = Action("plain", goal=int, feedback=int, result=str)
ANY_COOK, ANY_DRIVE, ANY_HOME = (cast("Any", one) for one in (cook, drive, home))


@pytest.mark.parametrize(
    ("action", "args", "given", "text"),
    [
        (ANY_COOK, (1,), {"timeout": 2.0}, "make the goal with `cook.goal_of(timeout=...)`, and"),
        (ANY_DRIVE, (), {}, "drive(meters: int): missing a required argument: 'meters'"),
        (ANY_DRIVE, (1, 2), {}, "drive(meters: int): too many positional arguments"),
        (ANY_DRIVE, (1,), {"sped": 2}, "; the parameters of 'drive' are meters"),
        (ANY_HOME, (1,), {}, "home(): too many positional arguments"),
        (ANY_DRIVE, (drive.goal_of(1), 2), {}, "is a whole goal of 'drive', and stands alone"),
        (ANY_LOG_IN, (), {"token": "x"}, "'token' is a setting of connections, and a parameter"),
        (PLAIN, (), {"a": 2}, "; the goal of 'plain' is one value, given as one argument"),
        (PLAIN, (1, 2), {}, "is one value, and is given as one argument: there are several"),
    ],
)
async def test_arguments_that_do_not_fit_are_told_in_one_sentence(
    action: Any, args: tuple[Any, ...], given: dict[str, Any], text: str
) -> None:
    with pytest.raises(TypeError) as caught:
        await call("tcp://127.0.0.1:9", action, *args, reconnect=False, **given)
    assert text in str(caught.value)


async def test_a_parameter_with_the_name_of_an_option_is_given_in_a_goal() -> None:
    async with serve(cook, "inproc://cook"), connect("inproc://cook", cook) as client:
        assert await client.call(cook.goal_of(1, timeout=2.0), timeout=5) == 3.0
        for timeout in (2.0, None):
            with pytest.raises(TypeError, match="'timeout' is an option of the call, and a param"):
                await client.send_goal(cast("Any", 1), timeout=timeout)


async def test_a_parameter_may_have_the_name_of_any_argument_of_a_call() -> None:
    async def name(where: str, action: str, self: str) -> str:
        return where + action + self

    named = action(name)
    fields = {"where": "a", "action": "b", "self": "c"}
    async with serve(named, "inproc://name"), connect("inproc://name", named) as client:
        assert await client.call(**fields) == "abc"
        assert await call("inproc://name", named, **fields) == "abc"
    assert (await run_executor(named, **fields)).outcome.result == "abc"


async def old_drive(meters: int) -> str:
    return f"drove {meters} m"


async def new_drive(meters: int, speed: float = 1.0) -> str:
    return f"drove {meters} m at {speed:g} m/s"


async def test_a_new_parameter_with_a_default_keeps_older_programs_working_both_ways() -> None:
    old, new = action("drive")(old_drive), action("drive")(new_drive)
    first, second = action("home")(home._function), action("home")(new_home)
    async with serve([new, second], "tcp://127.0.0.1:0") as (url,):
        assert await call(url, old, 3) == "drove 3 m at 1 m/s"
        assert await call(url, first) == "at home in 0 s"
    async with serve([old, first], "tcp://127.0.0.1:0") as (url,):
        assert await call(url, new, 3, speed=2.0) == "drove 3 m"
        assert await call(url, second, within=1.0) == "at home"


async def new_home(within: float = 0.0) -> str:
    return f"at home in {within:g} s"


async def test_an_address_that_is_none_is_told_without_the_parameters() -> None:
    with pytest.raises(TypeError) as caught:
        await call(cast("Any", 3), drive, 1)
    assert "parameters" not in str(caught.value)
