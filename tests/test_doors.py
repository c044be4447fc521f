"""One table, doors by rules: each rule is tried at each door, by a test here or elsewhere, or there
is a reason why not. A new door is an entry in `tests.doors`, and red until its cells are filled.
"""

from __future__ import annotations

import logging
import re
import socket
import struct
from collections.abc import AsyncGenerator, Awaitable, Callable
from pathlib import Path
from typing import Any, Final

import anyio
import msgspec
import pytest
from anyio.abc import SocketAttribute
from anyio.lowlevel import checkpoint

from fibaction import (
    Action,
    ActionServer,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    RejectionCode,
)
from fibaction.cli.output import render
from fibaction.words.intake import IntakeChange, IntakeMode
from tests.doors import DOORS
from tests.hostile.test_doors import dialed
from tests.support.certificates import pems
from tests.support.nats_server import IS_LEFT_OUT
from tests.transports.web.upgrade import upgrade

pytestmark = pytest.mark.anyio

ROOT = Path(__file__).parents[1]
ALL: Final = [*DOORS, "ros2", "dds", "zenoh", "console", "store"]
"""Each door; the last ones are tried elsewhere."""

RULES = {
    "garbage": "a client that talks nonsense and resets its connection ends nothing else, and is no"
    " traceback in the log",
    "documents": "a costly document keeps no other client waiting",
    "unknown fields": "a field that the goal does not have is refused, with the one that was meant",
    "busy": "a goal for which there is no room now has a code that says so, or the word 'later'",
    "later": "such a goal runs when it is sent again, with the same ID where clients give IDs",
    "paused": "a goal for an action that is paused is told so in the same ways, or it waits",
    "stopping": "a goal that comes while the server stops is told so in the same ways",
    "same ID": "a goal that is sent again with its ID runs once, and another goal is refused",
    "others' goals": "a client cancels the goals of others only if it may",
    "unread feedback": "a client that reads nothing costs a bounded amount, and delays nobody",
    "described": "names, defaults and descriptions are the same as anywhere",
    "no goal": "an action that needs no goal is called without one",
}

ELSEWHERE = """
[garbage]
inproc: values of the same process are not bytes
mcp: test_a_message_with_half_a_character_is_answered
command: test_a_hostile_schema_is_one_short_sentence
rosbridge client: test_garbage_ends_the_connection_and_its_goals
nats: test_a_message_for_an_unknown_line_is_ignored
dds: test_an_attack_by_datagrams_costs_the_others_little
ros2, zenoh: the library of the middleware reads the bytes

[documents]
rest, sse, rosbridge: test_the_loop_goes_on_while_a_document_is_checked
mcp, mcp http, a2a: test_the_loop_goes_on_while_a_document_is_checked
tcp: test_an_attack_costs_the_others_little
tls, unix, ws, wss, nats: frames are read as those of tcp
inproc: values of the same process are not documents
rosbridge client: a client that trusts its robot with its own time
command: test_large_messages_are_shown_in_part
dds, zenoh, ros2: test_the_limit_is_one_for_all_arrays_of_a_payload

[unknown fields]
dds, zenoh, ros2: the fields of a message of ROS are fixed by its type

[busy]
dds, zenoh, ros2: a response of SendGoal has one bit

[later]
dds, zenoh, ros2: a client of ROS gives each goal an ID of its own

[paused]
dds, zenoh, ros2: a response of SendGoal has one bit

[stopping]
nats: test_a_worker_whose_server_has_stopped_is_left_for_another
dds, zenoh, ros2: a response of SendGoal has one bit

[same ID]
rosbridge: test_of_two_goals_with_the_same_id_the_later_is_canceled
rosbridge client: test_a_goal_is_not_sent_twice_by_a_retry
mcp, mcp http: test_a_goal_that_was_lost_is_found_again_when_it_is_asked_about
command: each call of the command has an ID of its own
dds, zenoh, ros2: test_no_goal_of_a_cyclone_client_is_lost_or_answered_twice

[others' goals]
tcp: test_a_request_that_is_not_allowed_fails_and_the_endpoint_is_not_asked
tls, unix, ws, wss: the session is that of tcp
inproc: clients in the process of their server have no tokens
nats: a client that knows the token of the brokers may do all
rest: test_who_may_not_see_goals_chooses_none_to_cancel
sse: test_the_goal_of_another_is_observed_and_not_canceled_by_a_cut
rosbridge, rosbridge client: test_permissions_are_those_of_all_clients
mcp: test_what_is_not_allowed_does_not_exist
mcp http: test_the_answer_of_another_client_does_not_send_a_goal
a2a: test_a_goal_of_others_can_be_followed_and_canceled_only_if_nobody_is_asked
command: it has the permissions of the address that it connects to
dds, zenoh, ros2: a request of CancelGoal does not say who asks

[unread feedback]
tcp, tls, unix, ws: test_clients_that_do_not_read_keep_no_client_out_and_no_server_from_stopping
rest, sse: test_clients_that_do_not_read_keep_no_client_out_and_no_server_from_stopping
rosbridge: test_clients_that_do_not_read_keep_no_client_out_and_no_server_from_stopping
wss: frames are sent as those of ws and tls
inproc: test_a_client_that_stalls_loses_the_oldest_and_is_told_how_many
rosbridge client: the robot bounds what it holds for a client
nats: test_a_reader_that_takes_nothing_holds_the_sender_back
mcp, mcp http: progress is sent only for a call that is waited for
a2a: test_a_client_that_is_cut_twenty_times_loses_and_repeats_nothing
command: test_large_feedback_on_a_live_line_is_shown_in_part
dds, zenoh, ros2: a writer of ROS keeps its last messages only

[described]
tcp, rest, mcp, a2a, command, console: test_an_action_looks_the_same_at_each_door
inproc, tls, unix, ws, wss, nats: actions are listed as over tcp
sse, mcp http: the schema is that of rest, or of mcp
rosbridge, rosbridge client: test_a_rosbridge_client_has_the_same_names_and_defaults
dds, zenoh, ros2: types of ROS have no descriptions

[no goal]
tcp, rest, rosbridge, rosbridge client: test_an_action_that_needs_no_goal_is_called_without_one
mcp, a2a, command: test_an_action_that_needs_no_goal_is_called_without_one
inproc, tls, unix, ws, wss, nats: the goal is made by the client, as over tcp
sse, mcp http: the goal is read as that of rest, or of mcp
dds: test_no_goal_and_a_goal_without_fields_are_the_same
zenoh, ros2: messages are those of dds
console: test_a_form_begins_with_the_template_of_the_command_line
"""
"""The other cells: by rule, doors and the name of a test, or a reason in words."""

PAGE, FILE = "it is a page that speaks REST and SSE", "it is a file of the server's, and no way in"
CELLS: dict[tuple[str, str], str] = {}
"""What shows that a door keeps a rule: a test, or a reason in words."""


def shown(rule: str, doors: str, by: str) -> None:
    """Fill the cells of a rule for these doors, which commas separate."""
    for door in doors.split(", "):
        assert (door, rule) not in CELLS, (door, rule)
        CELLS[door, rule] = by


for _part in ELSEWHERE.strip().split("\n\n"):
    _rule, *_lines = _part.splitlines()
    for _line in _lines:
        shown(_rule.strip("[]"), *_line.split(": "))
for _rule in RULES:
    CELLS.setdefault(("console", _rule), PAGE)
    CELLS.setdefault(("store", _rule), FILE)


def each_door(rule: str, without: str = "") -> Callable[..., Any]:
    """Run a test for each door that can be opened, but for those that are shown otherwise."""
    doors = [door for door in DOORS if door not in without.split(", ")]

    def parametrized(test: Callable[..., Any]) -> Any:
        shown(rule, ", ".join(doors), test.__name__)
        return pytest.mark.parametrize("door", doors)(test)

    return parametrized


# A server behind each door


class Drive(msgspec.Struct):
    """Drive straight on."""

    meters: int
    speed: float = 0.5


DRIVE = Action("drive", goal=Drive, feedback=int, result=str, type_name="drive_msgs/action/Drive")
BUSY, STOPPING, NO = 2, 3, 4
REJECTIONS = {
    BUSY: GoalRejected("the battery is charging", code=RejectionCode.BUSY),
    STOPPING: GoalRejected("it goes to bed", code=RejectionCode.STOPPING),
    NO: GoalRejected("busybox is missing"),
}


class Driver:
    """An executor that counts its goals, and rejects those of some lengths."""

    def __init__(self) -> None:
        self.driven: list[int] = []
        self.on_goal: Callable[[Drive], GoalRejected | None] = lambda goal: REJECTIONS.get(
            goal.meters
        )
        self.drive: Callable[[], Awaitable[object]] = checkpoint
        self.server = ActionServer(DRIVE, self._drive, on_goal=self._decide)

    async def _drive(self, goal: GoalHandle[Drive]) -> AsyncGenerator[int | str, None]:
        self.driven.append(goal.request.meters)
        await self.drive()
        yield "there"

    def _decide(self, goal: Drive) -> None:
        if (rejection := self.on_goal(goal)) is not None:
            raise rejection


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
def driver(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Driver:
    if request.getfixturevalue("door") == "nats":
        if IS_LEFT_OUT:
            pytest.skip("nats-server is not installed: see the extra `broker`")
        request.node.add_marker("processes")
    monkeypatch.setenv("SSL_CERT_FILE", pems().ca)
    monkeypatch.setattr(render, "log_connection", lambda: None)  # it would change log levels
    return Driver()


# Garbage

HOSTILE = {
    "a line": b"GARBAGE\r\n\r\n",
    "zeros": bytes(8),
    "a length that never comes": b"\xff" * 8,
    "half a request": b"POST /a HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 10000\r\n\r\n{",
    "half a request for WebSocket": upgrade()[:60],
    "nonsense in a WebSocket": upgrade() + b"\x81\xfe\xff\xff" + b"GARBAGE" * 9,
    "operations that are none": upgrade({b"Sec-WebSocket-Protocol": None}) + b"\x81\x83\0\0\0\0[[[",
    "nothing": b"",
}
"""What a client says before it resets its connection."""
NO_BYTES = "inproc, mcp, command, nats, rosbridge client"


async def reset(url: str, said: bytes) -> None:
    """Connect, say something, and end the connection at once, with RST where there is one."""
    scheme, _, rest = url.partition("://")
    scheme = {"wss": "tls", "https": "tls", "unix": "unix", "tls": "tls"}.get(scheme, "tcp")
    host = rest if scheme == "unix" else rest.partition("/")[0]
    stream = await dialed(f"{scheme}://{host.partition('?')[0]}")
    await stream.send(said)
    raw = stream.extra(SocketAttribute.raw_socket)
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    await anyio.aclose_forcefully(stream)


@each_door("garbage", without=NO_BYTES)
async def test_a_client_that_talks_nonsense_and_resets_its_connection_ends_nothing(
    door: str, driver: Driver, caplog: pytest.LogCaptureFixture
) -> None:
    with anyio.fail_after(30):
        async with DOORS[door](driver.server) as way:
            for said in HOSTILE.values():
                async with anyio.create_task_group() as tasks:
                    for _ in range(10):
                        tasks.start_soon(reset, way.url, said)
                assert (await way.send({"meters": 1})).result == "there"
    assert [one.getMessage() for one in caplog.records if one.exc_info] == []
    assert [one for one in caplog.records if one.levelno >= logging.ERROR] == []
    assert "Traceback" not in caplog.text


# Goals


@each_door("unknown fields")
async def test_a_field_that_does_not_exist_is_refused_with_the_one_that_was_meant(
    door: str, driver: Driver
) -> None:
    async with DOORS[door](driver.server) as way:
        told = await way.send({"meters": 1, "sped": 2})
        assert 'goal has no field "sped"; did you mean speed?' in told.reason
        assert told.code in (None, RejectionCode.UNREADABLE)
        assert driver.driven == []
        assert (await way.send({"meters": 1})).result == "there"


@each_door("busy")
async def test_only_a_temporary_rejection_says_so(door: str, driver: Driver) -> None:
    async with DOORS[door](driver.server) as way:
        for meters, rejection in REJECTIONS.items():
            told = await way.send({"meters": meters})
            assert rejection.reason in told.reason
            assert told.code is rejection.code or told.is_later is not None
            assert told.code in (None, rejection.code)
            assert told.is_later in (None, rejection.code.is_temporary)
    assert driver.driven == []


@each_door("later")
async def test_a_goal_that_came_too_early_runs_when_it_is_sent_again(
    door: str, driver: Driver
) -> None:
    goal_id = {} if door in NO_IDS.split(", ") else {"goal_id": GoalID.random()}
    rejections = [REJECTIONS[BUSY]] * 2
    driver.on_goal = lambda _: rejections.pop() if rejections else None
    async with DOORS[door](driver.server) as way:
        for _ in range(2):
            assert "the battery is charging" in (await way.send({"meters": 1}, **goal_id)).reason
        assert (await way.send({"meters": 1}, **goal_id)).result == "there"
    assert driver.driven == [1]


@each_door("paused")
async def test_a_goal_for_a_paused_action_is_told_so_and_runs_after_the_pause(
    door: str, driver: Driver
) -> None:
    server = driver.server
    refuse, hold, resume = (
        IntakeChange(mode, "the floor is wet")
        for mode in (IntakeMode.REFUSE, IntakeMode.HOLD, IntakeMode.OPEN)
    )
    async with DOORS[door](server) as way:
        await server.change_intake(refuse)
        told = await way.send({"meters": 1})
        assert told.result is None
        assert ": the floor is wet" in told.reason
        assert told.code is RejectionCode.BUSY or told.is_later is not False
        await server.change_intake(resume)
        assert (await way.send({"meters": 1})).result == "there"
        await server.change_intake(hold)

        async def send() -> None:
            assert (await way.send({"meters": 5})).result == "there"

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(send)
            with await server.status() as statuses:
                while (info := await statuses.receive()) is not None:
                    if info.status is GoalStatus.ACCEPTED:
                        break
            assert driver.driven == [1]
            await server.change_intake(resume)
    assert driver.driven == [1, 5]


@each_door("stopping", without="nats")
async def test_a_goal_that_comes_while_the_server_stops_may_come_later(
    door: str, driver: Driver
) -> None:
    begun, stops, cleans_up, goes_on, done = (anyio.Event() for _ in range(5))

    async def run_server() -> None:
        async with driver.server:
            begun.set()
            await stops.wait()
        done.set()

    async def clean_up() -> None:
        try:
            await anyio.sleep_forever()
        finally:
            cleans_up.set()
            await goes_on.wait()

    driver.drive = clean_up
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(run_server)
        await begun.wait()
        async with DOORS[door](driver.server) as way:
            await driver.server.send_goal(GoalID.random(), DRIVE.goal.encode(Drive(9)))
            await anyio.wait_all_tasks_blocked()
            stops.set()
            await cleans_up.wait()
            told = await way.send({"meters": 1})
            goes_on.set()
            await done.wait()
    assert "the server is stopping" in told.reason
    assert told.code is RejectionCode.STOPPING or told.is_later
    assert driver.driven == [9]


NO_IDS = "rosbridge, rosbridge client, mcp, mcp http, command"


@each_door("same ID", without=NO_IDS)
async def test_a_goal_that_is_sent_again_with_its_id_runs_once(door: str, driver: Driver) -> None:
    goal_id = GoalID.random()
    async with DOORS[door](driver.server) as way:
        for _ in range(3):
            assert (await way.send({"meters": 1}, goal_id=goal_id)).result == "there"
        told = await way.send({"meters": 5}, goal_id=goal_id)
        assert told.result is None
        assert told.code in (None, RejectionCode.DUPLICATE)
    assert driver.driven == [1]


# The table


@pytest.fixture(scope="module")
def tests() -> set[str]:
    """The names of all tests."""
    folders = [ROOT / "tests", ROOT / "fibaction" / "testing"]
    modules = [path for folder in folders for path in folder.rglob("test_*.py")]
    return {
        name for path in modules for name in re.findall(r"def (test_\w+)", path.read_text("utf-8"))
    }


@pytest.mark.parametrize("rule", RULES)
def test_each_cell_of_the_table_is_a_test_or_a_reason(rule: str, tests: set[str]) -> None:
    cells = {door: CELLS.get((door, rule), "") for door in ALL}
    assert [door for door, cell in cells.items() if not (cell in tests or " " in cell)] == []


def test_the_table_names_no_door_and_no_rule_that_does_not_exist() -> None:
    assert {door for door, _ in CELLS} == set(ALL)
    assert {rule for _, rule in CELLS} == set(RULES)
