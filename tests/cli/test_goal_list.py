"""Goals found over all actions, picked by the beginning of an ID, and laid out in columns."""

from __future__ import annotations

import anyio
import pytest

from fibaction import ActionClient, ConnectionLost, GoalID, GoalInfo, GoalStatus, ServerNotFound
from fibaction.cli.ending import ExitCode, Failure
from fibaction.cli.goal_list import (
    Clients,
    Row,
    duration,
    goal_digits,
    goals_of,
    in_columns,
    pick,
    unambiguous,
)
from tests.cli.served import Served, counter

A = GoalID.parse("aaaaaaaa" + "0" * 24)
B = GoalID.parse("aaaaaaaa" + "1" * 24)
C = GoalID.parse("cccccccc" + "0" * 24)


def row(goal_id: GoalID = A, *, status: int = 2, stamp: int = 1, client: str = "") -> Row:
    return Row("arm/pick", GoalInfo(goal_id, stamp * 10**9, GoalStatus(status), 0, client))


def test_active_goals_come_first_and_the_newest_of_each() -> None:
    rows = [row(status=status, stamp=stamp) for status, stamp in ((4, 9), (2, 1), (6, 8), (1, 3))]

    ordered = sorted(rows, key=lambda one: one.rank)

    assert [one.info.stamp // 10**9 for one in ordered] == [3, 1, 9, 8]


# Finding


@pytest.mark.asyncio
async def test_goals_of_all_actions_come_in_the_order_of_their_acceptance() -> None:
    one, other = counter("one"), counter("other")
    async with one, other:
        clients = await Clients(Served(one, other).connection).now()
        await clients["other"].send_goal(1, goal_id=A)
        await clients["one"].send_goal(1, goal_id=B)
        await clients["other"].send_goal(1, goal_id=C)
        rows = await goals_of(clients)

    assert [(one.action, one.info.goal_id) for one in rows] == [
        ("other", A),
        ("one", B),
        ("other", C),
    ]


@pytest.mark.asyncio
async def test_clients_come_and_go_with_their_actions() -> None:
    one, other = counter("one"), counter("other")
    served = Served(one)
    clients = Clients(served.connection)
    first = await clients.now()
    served.servers["other"] = other
    second = await clients.now()
    del served.servers["one"]

    assert list(first) == ["one"]
    assert list(second) == ["one", "other"]
    assert second["one"] is first["one"]
    assert list(await clients.now()) == ["other"]


@pytest.mark.asyncio
async def test_an_action_that_cannot_be_used_here_is_left_out_and_told_of_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    served = Served(counter("one"), counter("other"))
    served.unusable.add("one")
    clients = Clients(served.connection)

    assert list(await clients.now()) == list(await clients.now()) == ["other"]
    assert capsys.readouterr().err == "/one is left out: the type of one is not installed\n"


@pytest.mark.asyncio
async def test_the_one_that_is_asked_for_is_looked_up_once() -> None:
    served = Served(counter("one"), counter("other"))
    clients = Clients(served.connection, "/other")
    assert list(await clients.now()) == ["other"]
    served.error = ServerNotFound("nobody")

    assert list(await clients.now()) == ["other"]
    with pytest.raises(Failure):
        await Clients(Served().connection, "other").now()


@pytest.mark.asyncio
async def test_servers_that_are_gone_are_left_out_unless_it_is_all_of_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one, other = counter("one"), counter("other")
    async with one:
        clients = await Clients(Served(one, other).connection).now()
        await ActionClient(one, one.action).send_goal(1, goal_id=A)
        assert [row.info.goal_id for row in await goals_of(clients)] == [A]

    with pytest.raises(ServerNotFound):
        await goals_of(clients)
    assert await goals_of({}) == []


# Picking


@pytest.mark.asyncio
async def test_the_beginning_of_an_id_is_enough_if_it_is_the_only_one() -> None:
    one, other = counter("one", [11, anyio.Event()], ["done"]), counter("other")
    async with one, other:
        clients = await Clients(Served(one, other).connection).now()
        await clients["one"].send_goal(1, goal_id=A)
        await clients["other"].send_goal(1, goal_id=C)
        assert await pick(clients, "c") == ("other", C)
        goal = await clients["one"].send_goal(1, goal_id=B)
        await goal.result()
        assert await pick(clients, "a") == ("one", A), "the active one"
        assert await pick(clients, "aaaaaaaa1") == ("one", B)
        await clients["other"].send_goal(1, goal_id=GoalID(b"\xaa" * 16))
        with pytest.raises(Failure, match="2 goals have an ID that begins with a: aaa") as several:
            await pick(clients, "a")
        with pytest.raises(Failure, match="there is no goal dd at any server") as none:
            await pick(clients, "dd")
        with pytest.raises(Failure, match="there is no goal dd at the server of /one"):
            await pick({"one": clients["one"]}, "dd")

    assert several.value.exit_code == none.value.exit_code == ExitCode.USAGE


@pytest.mark.asyncio
async def test_many_that_could_be_meant_are_not_all_listed() -> None:
    one = counter("one")
    async with one:
        clients = await Clients(Served(one).connection).now()
        for number in range(7):
            await clients["one"].send_goal(1, goal_id=GoalID(bytes([0xAA] * 15 + [number])))
        with pytest.raises(Failure, match=r"7 goals .*, [.]{3}$"):
            await pick(clients, "aa")


@pytest.mark.asyncio
async def test_a_whole_id_of_a_known_action_needs_no_looking() -> None:
    one = counter("one")
    clients = {"one": ActionClient(one, one.action)}

    assert await pick(clients, str(A)) == ("one", A)


@pytest.mark.parametrize("text", ["", "-", "fibonacci", "0" * 33])
def test_what_is_no_id_is_said_to_be_none(text: str) -> None:
    with pytest.raises(Failure, match="32 hexadecimal digits") as failure:
        goal_digits(text)
    assert failure.value.exit_code == ExitCode.USAGE


def test_an_id_may_be_written_as_a_uuid_and_in_capitals() -> None:
    assert goal_digits("AAAAAAAA-0000-") == "aaaaaaaa0000"


# Laying out


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (-3, "0.0 s"),
        (0.05, "0.1 s"),
        (9.9, "9.9 s"),
        (10, "10 s"),
        (119, "119 s"),
        (120, "2 min"),
        (3600 * 2, "2 h"),
        (3600 * 48, "2 d"),
    ],
)
def test_a_duration_is_as_long_as_it_need_be(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_columns_have_names_and_numbers_stand_to_the_right() -> None:
    rows = [row(client="127.0.0.1:5"), row(C, status=6)]

    assert in_columns(rows, actions=True, now=13.0) == [
        "ID                                ACTION     STATUS      AGE  FEEDBACK  CLIENT",
        f"{A}  /arm/pick  EXECUTING  12 s         0  127.0.0.1:5",
        f"{C}  /arm/pick  ABORTED    12 s         -  -",
    ]


def test_the_action_is_left_out_where_it_is_known() -> None:
    assert in_columns([row()], actions=False, now=2.0) == [
        "ID                                STATUS       AGE  FEEDBACK  CLIENT",
        f"{A}  EXECUTING  1.0 s         -  -",
    ]
    assert " d " in in_columns([row()], actions=False)[1]


def test_with_little_room_ids_are_cut_then_clients_then_actions() -> None:
    rows = [row(client="somebody at 127.0.0.1:5"), row(C)]

    def fits(width: int) -> list[str]:
        lines = in_columns(rows, actions=True, width=width, now=2.0)
        assert max(map(len, lines)) <= width
        return lines

    assert fits(120)[1].startswith(str(A))
    assert fits(80)[1] == (
        "aaaaaaaa  /arm/pick  EXECUTING  1.0 s         0  somebody at 127.0.0.1:5"
    )
    assert fits(60)[1].endswith("  somebody a…")
    assert fits(56)[1] == "aaaaaaaa  /arm/pi…  EXECUTING  1.0 s         0  somebod…"
    narrow = in_columns([row(client="somebody")], actions=False, width=10, now=2.0)
    assert narrow[1] == "aaaaaaaa  EXECUTING  1.0 s         0  somebody"


def test_ids_are_cut_where_they_still_differ() -> None:
    assert unambiguous([]) == unambiguous([str(A)]) == unambiguous([str(A), str(C)]) == 8
    assert unambiguous([str(A), str(C), str(B)]) == 9
    assert unambiguous([str(A), str(A)]) == 8


def test_what_others_have_written_cannot_control_the_terminal() -> None:
    assert row(client="a\x1b[2J").client == "a\\x1b[2J"


def test_a_row_for_programs_has_all_of_it() -> None:
    assert row(client="me").json() == {
        "action": "arm/pick",
        "goal_id": str(A),
        "stamp": 10**9,
        "status": "EXECUTING",
        "feedback_count": 0,
        "client": "me",
    }


@pytest.mark.asyncio
async def test_a_connection_that_is_lost_is_no_empty_list(monkeypatch: pytest.MonkeyPatch) -> None:
    one = counter("one")

    async def lost(*_: object) -> None:
        raise ConnectionLost("the line is dead")

    monkeypatch.setattr(one, "status", lost)
    with pytest.raises(ConnectionLost):
        await goals_of(await Clients(Served(one).connection).now())
