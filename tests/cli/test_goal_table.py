"""Goals in columns: what is cut where there is little room, their outcomes and their families."""

from __future__ import annotations

import io
import json
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import anyio
import pytest
from rich.console import Console

from fibaction import (
    Action,
    ActionClient,
    ActionInfo,
    ActionServer,
    GoalAborted,
    GoalHandle,
    GoalID,
    GoalInfo,
    GoalStatus,
    Outcome,
    Parent,
    UnknownGoal,
    serve,
)
from fibaction.cli.arguments.goal_lookup import goals_of
from fibaction.cli.output.goal_details import Outcomes
from fibaction.cli.output.goal_table import (
    CSV_COLUMNS,
    Family,
    GoalRow,
    csv_cells,
    duration,
    family_of,
    in_color,
    in_columns,
    ordinal,
    picture,
    step_of,
    unambiguous,
)
from fibaction.cli.verbs.follow import attach
from fibaction.cli.verbs.list_goals import Form, list_goals
from fibaction.observe.monitor import AnyClient, GoalKey, GoalSnapshot, Monitor
from tests.cli.served import Altered, counter

A = GoalID.parse("aaaaaaaa" + "0" * 24)
B = GoalID.parse("aaaaaaaa" + "1" * 24)
C = GoalID.parse("cccccccc" + "0" * 24)
NOON = 1_769_860_800 * 10**9
"""2026-01-31T12:00:00Z."""
WAITING = GoalInfo(C, 10**9, GoalStatus.ACCEPTED, 0, "me", 2, 5)


def row(goal_id: GoalID = A, *, status: int = 2, stamp: int = 1, client: str = "") -> GoalRow:
    return GoalRow("arm/pick", GoalInfo(goal_id, stamp * 10**9, GoalStatus(status), 0, client))


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


def test_steps_are_cut_after_clients_and_ids_differ_from_those_of_parents() -> None:
    info = GoalInfo(C, 10**9, GoalStatus(2), 0, "a long name", parent=Parent(B, "to the shelf"))
    rows = [row(client="me"), GoalRow("arm/pick", info)]

    def child(width: int) -> str:
        return in_columns(rows, actions=True, width=width, now=2.0)[2]

    assert child(95).startswith("cccccccc0  /arm/pick  EXECUTING  to the shelf of aaaaaaaa1  ")
    assert child(86).endswith("  to the shelf of aaaaaaaa1  1.0 s         0  a long n…")
    assert child(60) == "cccccccc0  /arm/pi…  EXECUTING  to the …  1.0 s         0  a long …"


def test_a_reason_or_a_result_is_shown_as_far_as_there_is_room() -> None:
    aborted = row(C, status=6)
    rows = [row(client="me"), GoalRow("arm/pick", aborted.info, end="the arm is stuck " * 9)]
    whole = in_columns(rows, actions=True, now=2.0)
    assert whole[0].endswith("FEEDBACK  CLIENT  REASON, RESULT")
    assert whole[1].endswith("  me")
    assert "  -       the arm is stuck the arm" in whole[2]
    assert whole[2].endswith("…")

    lines = in_columns(rows, actions=True, width=100, now=2.0)
    assert max(map(len, lines)) == 100
    assert lines[2].startswith("cccccccc  /arm/pick"), "an end is worth more than a whole ID"
    assert lines[2].endswith("  -       the arm is stuck the arm is stuck the arm …")
    assert "RESULT" not in in_columns(rows, actions=True, width=70, now=2.0)[0]
    suspect = GoalRow("a", GoalInfo(A, 1, GoalStatus.EXECUTING, reason="a suspect"))
    assert in_columns([suspect], actions=True, now=2.0)[1].endswith("  -       a suspect")


def test_ids_are_cut_where_they_still_differ() -> None:
    assert unambiguous([]) == unambiguous([str(A)]) == unambiguous([str(A), str(C)]) == 8
    assert unambiguous([str(A), str(C), str(B)]) == 9
    assert unambiguous([str(A), str(A)]) == 8


def test_text_of_a_client_cannot_control_the_terminal() -> None:
    assert row(client="a\x1b[2J").client == "a\\x1b[2J"


def test_a_goal_without_a_worker_says_so() -> None:
    left = GoalRow("a", GoalInfo(A, 1, GoalStatus.EXECUTING, has_worker=False))
    assert left.status == "no worker"
    assert left.json()["has_worker"] is False


def test_a_row_for_programs_has_all_of_it() -> None:
    assert json.dumps(row(client="me").json(), separators=(",", ":")) == (
        f'{{"action":"arm/pick","goal_id":"{A}","stamp":1000000000,"status":"EXECUTING",'
        '"feedback_count":0,"client":"me","place":0,"queue_length":0,"attempt":1,'
        '"has_worker":true,"worker":"","parent":null,"labels":{},"began_at":null,'
        '"ended_at":null,"waited":null,"ran":null,"reason":""}'
    )
    ended = GoalRow("a", WAITING, Outcome(GoalStatus.ABORTED, {"n": 1}, "stuck")).json()
    assert (ended["reason"], ended["result"]) == ("stuck", {"n": 1})
    assert GoalRow("a", WAITING).json()["place"] == 2
    assert GoalRow("a", WAITING).json()["queue_length"] == 5


@pytest.mark.parametrize(
    ("number", "text"),
    [
        *((1, "1st"), (2, "2nd"), (3, "3rd"), (4, "4th"), (10, "10th")),
        *((11, "11th"), (12, "12th"), (13, "13th"), (21, "21st"), (22, "22nd"), (23, "23rd")),
        *((100, "100th"), (101, "101st"), (111, "111th"), (1012, "1012th"), (1021, "1021st")),
    ],
)
def test_a_place_is_an_ordinal_number(number: int, text: str) -> None:
    assert ordinal(number) == text


def test_a_goal_that_waits_has_its_place_instead_of_its_status() -> None:
    rows = [row(), GoalRow("arm/pick", WAITING)]
    lines = in_columns(rows, actions=True, width=80, now=2.0)

    assert lines == [
        "ID        ACTION     STATUS             AGE  FEEDBACK  CLIENT",
        "aaaaaaaa  /arm/pick  EXECUTING        1.0 s         -  -",
        "cccccccc  /arm/pick  waits, 2nd of 5  1.0 s         0  me",
    ]
    colored = in_color(rows, lines)[2]
    assert [colored.plain[one.start : one.end] for one in colored.spans] == ["waits, 2nd of 5"]


def test_a_picture_has_the_active_goals_first_and_says_what_is_left_out() -> None:
    screen = Console(file=io.StringIO(), width=80, height=10)
    rows = [
        GoalRow("one", GoalInfo(GoalID(bytes([n] * 16)), n, GoalStatus(4 if n % 2 else 2)))
        for n in range(1, 21)
    ]
    lines = picture(screen, rows, "", actions=True).plain.splitlines()

    assert len(lines) == 9
    assert [line[:2] for line in lines[1:8]] == ["14", "12", "10", "0e", "0c", "0a", "08"]
    assert lines[8] == "10 active, 10 ended; 13 not shown"
    away = picture(screen, [], "gone\x1b", actions=True).plain.splitlines()
    assert away[1] == "The server is away: gone\\x1b"


@pytest.mark.load
def test_the_time_for_a_table_grows_with_its_rows() -> None:
    rows = [GoalRow("a", GoalInfo(GoalID.random(), 1, GoalStatus.EXECUTING, 0, "x" * 200))] * 50_000

    assert len(in_columns(rows, actions=True, width=80, now=0)) == 50_001


def csv_row(row: GoalRow) -> dict[str, str]:
    return dict(zip(CSV_COLUMNS, csv_cells(row), strict=True))


def test_a_row_of_csv_has_times_spans_and_the_result() -> None:
    began, ended = NOON + 1_500_000_000, NOON + 4_000_001_000
    info = GoalInfo(
        *(A, NOON, GoalStatus.SUCCEEDED, 3, "robot7 at 10.0.0.7:4"),
        attempt=2,
        parent=Parent(B, "pick"),
        began_at=began,
        ended_at=ended,
        labels={"order": "17"},
        worker="gpu-3",
    )
    row = GoalRow("arm/pick", info, Outcome(GoalStatus.SUCCEEDED, {"cup": [-1]}))

    assert ",".join(CSV_COLUMNS) == (
        "action,goal_id,status,accepted_at,began_at,ended_at,waited,ran,attempt,feedback_count,"
        "client,parent,step,reason,result,labels,worker"
    )
    assert ",".join(csv_cells(row)) == (
        f"arm/pick,{A},SUCCEEDED,2026-01-31T12:00:00.000000Z,2026-01-31T12:00:01.500000Z,"
        "2026-01-31T12:00:04.000001Z,1.500000,2.500001,2,3,robot7 at 10.0.0.7:4,"
        f'{B},pick,,{{"cup":[-1]}},{{"order":"17"}},gpu-3'
    )


def test_a_goal_that_runs_has_waited_and_no_time_of_its_run() -> None:
    info = GoalInfo(A, NOON, GoalStatus.EXECUTING, began_at=NOON + 10**9)
    cells = csv_row(GoalRow("arm/pick", info))
    assert (cells["waited"], cells["ran"]) == ("1.000000", "")


def test_the_reason_of_an_outcome_that_is_not_known_is_that_of_the_list() -> None:
    info = GoalInfo(A, NOON, GoalStatus.ABORTED, reason="too hot")
    assert csv_row(GoalRow("arm/pick", info))["reason"] == "too hot"
    whole = Outcome[object](GoalStatus.ABORTED, reason="too hot, and more")
    assert csv_row(GoalRow("arm/pick", info, whole))["reason"] == "too hot, and more"


@pytest.mark.parametrize(
    ("reason", "cell"),
    [
        ("=1+1", "'=1+1"),
        ("+1", "'+1"),
        ("-1", "'-1"),
        ("@A1", "'@A1"),
        ("a=1", "a=1"),
        ("one\ntwo\x1b[2J", "one\\x0atwo\\x1b[2J"),
    ],
)
def test_text_of_others_is_one_line_of_csv_and_no_formula(reason: str, cell: str) -> None:
    info = GoalInfo(A, NOON, GoalStatus.ABORTED, reason=reason)
    assert csv_row(GoalRow("arm/pick", info))["reason"] == cell


@pytest.mark.asyncio
async def test_goals_that_have_ended_have_a_reason_or_a_result() -> None:
    ends = (["done\x1b"], [GoalAborted("stuck")], [GoalAborted("")], [anyio.Event()])
    server = counter("count", *ends)
    async with server:
        client = ActionClient(server, server.action)
        for _ in range(3):
            await (await client.send_goal(1)).outcome()
        await client.send_goal(1)
        clients: dict[str, AnyClient] = {"count": client}
        rows = await goals_of(clients)
        whole = await Outcomes().of(clients, rows)
        assert [row.info for row in whole] == [row.info for row in rows]
        assert [row.end for row in whole] == ["done\\x1b", "stuck", "", ""]
        succeeded, aborted, empty, running = (row.outcome for row in whole)
        assert succeeded is not None
        assert (succeeded.status, succeeded.result) == (GoalStatus.SUCCEEDED, "done\x1b")
        assert aborted is not None
        assert empty is not None
        assert running is None

        newest = await Outcomes(1).of(clients, rows)
        assert [row.outcome is not None for row in newest] == [False, False, True, False]


@pytest.mark.asyncio
async def test_a_server_that_does_not_give_an_outcome_is_left_with_its_list() -> None:
    async with counter("count", ["done"]) as server:
        altered = Altered(server)
        client = ActionClient(altered, server.action)
        await client.call(1)
        rows = await goals_of({"count": client})

        async def forgotten(goal_id: object) -> None:
            raise UnknownGoal(rows[0].info.goal_id)

        async def silent(goal_id: object) -> None:
            await anyio.sleep_forever()

        for answer in (forgotten, silent):
            altered.calls["get_result"] = answer
            assert await Outcomes().of({"count": client}, rows, 0.01) == rows


@pytest.mark.asyncio
async def test_an_outcome_is_asked_for_once_while_its_goal_is_listed() -> None:
    async with counter("count", ["one"], ["two"]) as server:
        altered = Altered(server)
        client = ActionClient(altered, server.action)
        await client.call(1)
        await client.call(1)
        clients: dict[str, AnyClient] = {"count": client}
        rows = await goals_of(clients)
        kept = Outcomes()
        assert [row.end for row in await kept.of(clients, rows)] == ["one", "two"]

        async def forgotten(goal_id: object) -> None:
            raise UnknownGoal(rows[0].info.goal_id)

        altered.calls["get_result"] = forgotten
        assert [row.end for row in await kept.of(clients, rows)] == ["one", "two"]
        await kept.of(clients, rows[1:])
        assert [row.end for row in await kept.of(clients, rows)] == ["", "two"]


URL = "inproc://family"
DRIVE = Action("drive", goal=str, feedback=int, result=str)
FETCH = Action("base/fetch", goal=str, feedback=int, result=str)
MISSION, LEG, PART = (GoalID(bytes([number]) * 16) for number in (0xAA, 0xBB, 0xCC))


async def drive(goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
    yield f"at the {goal.request}"


@asynccontextmanager
async def fetched() -> AsyncGenerator[tuple[str, str, str], None]:
    """Serve a mission that has driven twice; give its ID, and those of its children."""
    ids: list[str] = []

    async def fetch(goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
        for place in ("shelf", "dock"):
            step = goal.step(f"to the {place}")
            ids.append(str(step.child_id("drive")))
            await ActionClient(drives, DRIVE).call(place, step=step)
        yield "fetched"

    async with (
        ActionServer(DRIVE, drive) as drives,
        ActionServer(FETCH, fetch) as fetches,
        serve([drives, fetches], URL),
    ):
        goal = await ActionClient(fetches, FETCH).send_goal("cup")
        await goal.result()
        yield str(goal.goal_id), ids[0], ids[1]


@pytest.mark.asyncio
async def test_a_list_for_programs_has_the_parents_and_the_children(
    capsys: pytest.CaptureFixture[str],
) -> None:
    async with fetched() as (mission, shelf, dock):
        await list_goals(URL, form=Form.JSON)

    found = {
        line["goal_id"]: line for line in map(json.loads, capsys.readouterr().out.split("\n")[:-1])
    }
    assert found[mission]["parent"] is None
    assert found[mission]["children"] == [shelf, dock]
    assert found[shelf]["parent"] == {"goal_id": mission, "step": "to the shelf"}
    assert found[dock]["children"] == []


@pytest.mark.asyncio
@pytest.mark.parametrize("as_json", [False, True])
async def test_attach_says_which_step_a_goal_is(
    as_json: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    async with fetched() as (mission, shelf, _):
        await attach(URL, shelf, None, full=False, as_json=as_json)
        await attach(URL, mission, None, full=False, as_json=as_json)

    lines = capsys.readouterr().out.splitlines()
    if as_json:
        child, parent = (json.loads(line) for line in lines if "accepted" in line)
        assert child["parent"] == {"goal_id": mission, "step": "to the shelf"}
        assert "parent" not in parent
    else:
        at = lines.index(f"Goal accepted with ID: {shelf}")
        assert lines[at + 1] == f"It is the step to the shelf of {mission}"
        at = lines.index(f"Goal accepted with ID: {mission}")
        assert lines[at + 1] == ""


def test_a_step_without_a_name_is_one_all_the_same_and_none_controls_the_terminal() -> None:
    assert step_of(Parent(MISSION), 8) == "step of aaaaaaaa"
    assert step_of(Parent(MISSION, "a\x1b[2J"), 8) == "a\\x1b[2J of aaaaaaaa"


def test_a_goal_may_be_a_step_and_have_children() -> None:
    leg = GoalInfo(LEG, 2, GoalStatus.EXECUTING, parent=Parent(MISSION, "drive"))
    family = Family([leg, GoalInfo(PART, 3, GoalStatus.EXECUTING, parent=Parent(LEG))])

    assert family.text(leg, 4) == "drive of aaaa, 1 child"
    assert not Family([GoalInfo(LEG, 2, GoalStatus.EXECUTING)])


def snapshot(monitor: Monitor, goal_id: GoalID) -> GoalSnapshot:
    found = monitor.find(goal_id)
    assert found is not None
    return found


def test_the_details_of_a_goal_have_its_parent_and_its_children_with_their_states() -> None:
    monitor = Monitor()
    monitor.on_actions([ActionInfo("fetch"), ActionInfo("drive")], "")
    monitor.on_event("fetch", GoalInfo(MISSION, 1, GoalStatus.EXECUTING))
    monitor.on_event(
        "drive", GoalInfo(LEG, 2, GoalStatus.SUCCEEDED, parent=Parent(MISSION, "shelf"))
    )
    monitor.on_event("drive", GoalInfo(PART, 3, GoalStatus.EXECUTING, parent=Parent(MISSION)))

    assert family_of(monitor, snapshot(monitor, MISSION)).splitlines() == [
        "Children:",
        f"  shelf: {LEG}, /drive SUCCEEDED",
        f"  step: {PART}, /drive EXECUTING",
    ]
    assert family_of(monitor, snapshot(monitor, LEG)) == (
        f"Parent: shelf of {MISSION}, /fetch EXECUTING"
    )
    monitor.on_event("fetch", GoalInfo(MISSION, 0, GoalStatus.UNKNOWN))
    assert family_of(monitor, snapshot(monitor, LEG)) == (
        f"Parent: shelf of {MISSION}, of another server, or forgotten"
    )
    assert snapshot(monitor, LEG).key == GoalKey("drive", LEG)
