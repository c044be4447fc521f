"""Lookup of goals over all actions, and by the beginning of an ID."""

from __future__ import annotations

import anyio
import pytest
from msgspec.structs import replace

from fibaction import (
    ActionClient,
    ConnectionLost,
    GoalID,
    GoalInfo,
    GoalStatus,
    ServerNotFound,
)
from fibaction.border.abc import Endpoint, ForwardingEndpoint
from fibaction.cli.arguments.goal_lookup import (
    ActionClients,
    GoalChoice,
    find_goal,
    goal_digits,
    goals_of,
    with_past,
)
from fibaction.cli.output.goal_table import GoalRow
from fibaction.cli.process.exit_codes import ExitCode, Failure
from fibaction.words import goal_query
from fibaction.words.goal_query import GoalQuery, PastPage
from tests.cli.served import Altered, Served, counter

A = GoalID.parse("aaaaaaaa" + "0" * 24)
B = GoalID.parse("aaaaaaaa" + "1" * 24)
C = GoalID.parse("cccccccc" + "0" * 24)


@pytest.mark.asyncio
async def test_clients_come_and_go_with_their_actions() -> None:
    one, other = counter("one"), counter("other")
    served = Served(one)
    clients = ActionClients(served.connection)
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
    clients = ActionClients(served.connection)

    assert list(await clients.now()) == list(await clients.now()) == ["other"]
    assert capsys.readouterr().err == "/one is left out: the type of one is not installed\n"


@pytest.mark.asyncio
async def test_the_one_that_is_asked_for_is_looked_up_once() -> None:
    served = Served(counter("one"), counter("other"))
    clients = ActionClients(served.connection, "/other")
    assert list(await clients.now()) == ["other"]
    served.error = ServerNotFound("nobody")

    assert list(await clients.now()) == ["other"]
    with pytest.raises(Failure):
        await ActionClients(Served().connection, "other").now()


@pytest.mark.asyncio
async def test_servers_that_are_gone_are_left_out_unless_it_is_all_of_them() -> None:
    one, other = counter("one"), counter("other")
    async with one:
        clients = await ActionClients(Served(one, other).connection).now()
        await ActionClient(one, one.action).send_goal(1, goal_id=A)
        assert [row.info.goal_id for row in await goals_of(clients)] == [A]

    with pytest.raises(ServerNotFound):
        await goals_of(clients)
    assert await goals_of({}) == []


@pytest.mark.asyncio
async def test_the_beginning_of_an_id_is_enough_if_it_is_the_only_one() -> None:
    one, other = counter("one", [11, anyio.Event()], ["done"]), counter("other")
    async with one, other:
        clients = await ActionClients(Served(one, other).connection).now()
        await clients["one"].send_goal(1, goal_id=A)
        await clients["other"].send_goal(1, goal_id=C)
        assert await find_goal(clients, "c") == ("other", C)
        goal = await clients["one"].send_goal(1, goal_id=B)
        await goal.result()
        assert await find_goal(clients, "a") == ("one", A), "the active one"
        assert await find_goal(clients, "aaaaaaaa1") == ("one", B)
        await clients["other"].send_goal(1, goal_id=GoalID(b"\xaa" * 16))
        with pytest.raises(Failure, match="2 goals have an ID that begins with a: aaa") as several:
            await find_goal(clients, "a")
        with pytest.raises(Failure, match="there is no goal dd at any server") as none:
            await find_goal(clients, "dd")
        with pytest.raises(Failure, match="there is no goal dd at the server of /one"):
            await find_goal({"one": clients["one"]}, "dd")

    assert several.value.exit_code == none.value.exit_code == ExitCode.USAGE


def timed(
    number: int, began_at: int | None = None, ended_at: int | None = None, client: str = ""
) -> GoalRow:
    status = GoalStatus.EXECUTING if ended_at is None else GoalStatus.SUCCEEDED
    info = GoalInfo(GoalID(bytes([number] * 16)), number, status, 0, client)
    return GoalRow("one", replace(info, began_at=began_at, ended_at=ended_at))


@pytest.mark.parametrize(
    ("sort", "order"),
    [
        ("accepted", [1, 2, 3, 4]),
        ("began", [4, 3, 1, 2]),
        ("ended", [3, 4, 2, 1]),
        ("waited", [4, 3, 1, 2]),
        ("ran", [3, 4, 2, 1]),
        ("status", [3, 4, 1, 2]),
        ("action", [1, 2, 3, 4]),
        ("client", [4, 2, 3, 1]),
    ],
)
def test_a_sorted_list_ends_with_the_greatest_and_begins_with_what_is_not_known(
    sort: str, order: list[int]
) -> None:
    rows = [
        timed(1, 101, 201, "c"),
        timed(2, 107, 108, "b"),
        timed(3, 50, None, "b"),
        timed(4, None, None, "a"),
    ]

    def found(limit: int) -> tuple[list[int], int]:
        chosen, left_out = GoalChoice(sort=sort, limit=limit).of(rows)
        return [row.info.stamp for row in chosen], left_out

    assert found(0) == (order, 0)
    assert found(4) == (order, 0)
    assert found(3) == (order[1:], 1)


def test_an_id_may_be_written_as_a_uuid_and_in_capitals() -> None:
    assert goal_digits("AAAAAAAA-0000-") == "aaaaaaaa0000"


@pytest.mark.asyncio
async def test_a_connection_that_is_lost_is_no_empty_list() -> None:
    async def lost() -> None:
        raise ConnectionLost("the line is dead")

    one = Altered(counter("one"), status=lost)
    with pytest.raises(ConnectionLost):
        await goals_of(await ActionClients(Served(one).connection).now())


class Past(ForwardingEndpoint):
    """An endpoint whose history has these goals, and which gives two of them at once."""

    def __init__(self, inner: Endpoint, *infos: GoalInfo) -> None:
        super().__init__(inner)
        self.infos = infos

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        return [info for info in self.infos if page.has(info)][:2]


@pytest.mark.asyncio
async def test_goals_of_the_past_are_listed_beside_those_that_are_remembered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(goal_query, "MOST_PAST", 2)
    past = [
        GoalInfo(GoalID(bytes([number] * 16)), number, GoalStatus.SUCCEEDED)
        for number in (4, 3, 2, 1)
    ]
    remembered = GoalRow("one", replace(past[1], reason="as it is remembered"))
    active = GoalRow("one", GoalInfo(A, 9, GoalStatus.EXECUTING))
    async with counter("one") as one, counter("other") as other:
        served = Served(Past(one, *past), Past(other, past[0]))
        clients = await ActionClients(served.connection).now()
        rows = await with_past(clients, [active, remembered], GoalQuery(since=2))
    assert [(row.action, row.info.stamp) for row in rows] == [
        *(("one", 2), ("one", 3), ("one", 4), ("other", 4), ("one", 9))
    ]
    assert rows[1] is remembered
