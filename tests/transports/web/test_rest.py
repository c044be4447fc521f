"""`fibaction_transports.web.rest.handlers`, as curl meets it: requests, answers, and events."""

from __future__ import annotations

import math
import re
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any, ClassVar, cast

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionServer,
    CancelRejected,
    GoalAborted,
    GoalHandle,
    GoalHistory,
    GoalID,
    GoalRejected,
    Limits,
    Peer,
    Permission,
    RejectionCode,
    Sender,
    SqliteStore,
    Watcher,
    __version__,
    connect,
    serve,
)
from fibaction.border.abc import ForwardingEndpoint, GoalStream, LogLine, Meta
from fibaction.schema.payload import PayloadError
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ConnectionLost
from fibaction_transports._http.problems import problem_of
from fibaction_transports.web.rest import goal_events
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.transports.hearing import Hearing
from tests.transports.tcp.servers import new_server
from tests.transports.web.http_client import Answer, client_of, fetch, permitting, served

pytestmark = pytest.mark.anyio

ACTION = "/actions/fibonacci"
GOALS = f"{ACTION}/goals"
ID = "0123456789abcdef0123456789abcdef"
EVENTS = "text/event-stream"
BEGIN = [("accepted", ""), ("status", "")]


class Held:
    """An executor that gives as much feedback as the goal asks for, and then waits."""

    def __init__(self) -> None:
        self.go_on = anyio.Event()
        self.canceled = anyio.Event()

    async def __call__(self, goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        try:
            for number in range(goal.request.order):
                yield Feedback([number])
            await self.go_on.wait()
        except BaseException:
            self.canceled.set()
            raise
        yield Result([goal.request.order])

    @property
    def server(self) -> ActionServer[Goal, Feedback, Result]:
        return ActionServer(FIBONACCI, self.__call__)


async def status_of(url: str, goal_id: str) -> Any:
    return (await fetch(url, "GET", f"{GOALS}/{goal_id}")).json


# Actions


async def test_actions_are_listed_and_described() -> None:
    async with served() as url:
        (listed,) = (await fetch(url, "GET", "/actions")).json
        assert (listed["name"], set(listed)) == (
            "fibonacci",
            {"name", "type_name", "goal", "feedback", "result", "schedule"},
        )
        assert (await fetch(url, "GET", ACTION)).json == listed
        described = await fetch(url, "GET", "/openapi.json")
        assert GOALS in described.json["paths"]
        assert described.json["info"]["x-fibaction"] == __version__
        assert described.headers["content-type"] == "application/json"
        assert described.headers["x-content-type-options"] == "nosniff"


# Sending


async def test_a_goal_that_is_posted_runs_on_by_itself() -> None:
    held = Held()
    async with served(held.server) as url:
        answer = await fetch(url, "POST", GOALS, {"order": 1})
        assert answer.status == 201
        goal_id = answer.json["goal_id"]
        assert answer.headers["location"] == f"{GOALS}/{goal_id}"
        assert answer.json["status"] == "ACCEPTED"
        assert int(answer.json["stamp"]) > 2**53
        held.go_on.set()
        ended = (await fetch(url, "GET", f"{GOALS}/{goal_id}?wait=10")).json
        assert (ended["status"], ended["result"]) == ("SUCCEEDED", {"sequence": [1]})
        (listed,) = (await fetch(url, "GET", GOALS)).json
        assert (listed["goal_id"], listed["status"]) == (goal_id, "SUCCEEDED")
        assert listed["feedback_count"] == 1
        assert int(answer.json["stamp"]) <= int(listed["began_at"]) <= int(listed["ended_at"])
        assert (listed["waited"] >= 0, listed["ran"] >= 0) == (True, True)
        assert listed["reason"] == ""


class Noting(Watcher):
    """A watcher that notes the meta of each goal."""

    def __init__(self) -> None:
        self.metas: list[dict[str, str]] = []

    def offered(
        self, action: str, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> None:
        self.metas.append(dict(meta))


async def test_the_headers_of_a_trace_go_with_the_goal() -> None:
    noting = Noting()
    headers = {"traceparent": "00-1", "tracestate": "a=1", "baggage": "b=2", "traces": "3"}
    async with served(ActionServer(FIBONACCI, fibonacci, watchers=[noting])) as url:
        for path in (f"{GOALS}?wait=10", GOALS):
            await fetch(url, "POST", path, {"order": 1}, **headers)
        await fetch(url, "POST", GOALS, {"order": 1}, accept=EVENTS)

    del headers["traces"]
    assert noting.metas == [headers, {"detached": "1", **headers}, {}]


async def test_a_wait_that_is_over_answers_with_what_is_known() -> None:
    async with served(Held().server) as url:
        answer = await fetch(url, "POST", f"{GOALS}?wait=0.05", {"order": 0})
        assert answer.json["status"] == "EXECUTING"
        assert "result" not in answer.json


async def test_a_goal_that_is_put_runs_once() -> None:
    async with served() as url:
        first = await fetch(url, "PUT", f"{GOALS}/{ID}?wait=10", {"order": 3})
        again = await fetch(url, "PUT", f"{GOALS}/{ID}?wait=10", {"order": 3})
        assert (first.status, again.status) == (201, 200)
        assert first.json == again.json
        other = await fetch(url, "PUT", f"{GOALS}/{ID}", {"order": 4})
        assert other.status == 409
        assert len((await fetch(url, "GET", GOALS)).json) == 1


async def test_a_goal_is_streamed_from_its_beginning_to_its_end() -> None:
    async with served() as url:
        answer = await fetch(url, "POST", GOALS, {"order": 3}, accept=EVENTS)
        assert answer.status == 201
        assert answer.headers["content-type"] == EVENTS
        names = [(name, event_id) for name, event_id, _ in answer.events]
        assert names == [*BEGIN, ("feedback", "1"), ("feedback", "2"), ("result", "end")]
        assert answer.events[2][2] == {"partial_sequence": [0, 1, 1]}
        assert answer.events[-1][2] == {
            "status": "SUCCEEDED",
            "result": {"sequence": [0, 1, 1, 2]},
            "reason": "",
            "feedback_dropped": 0,
        }


async def test_a_streaming_request_that_is_cut_cancels_its_goal() -> None:
    held = Held()
    async with served(held.server) as url:
        async with client_of(url) as client:
            await client.ask("POST", GOALS, {"order": 1}, accept=EVENTS)
            await client.until("id: 1")
        await held.canceled.wait()


async def test_a_goal_with_a_key_goes_on_when_its_stream_is_cut_and_can_be_followed_again() -> None:
    held = Held()
    key = {"idempotency-key": "17", "accept": EVENTS}
    async with served(held.server) as url:
        async with client_of(url) as client:
            await client.ask("POST", GOALS, {"order": 1}, **key)
            await client.until("id: 1")
        held.go_on.set()
        again = await fetch(url, "POST", GOALS, {"order": 1}, **key)
        assert (again.status, again.events[-1][2]["status"]) == (200, "SUCCEEDED")


@pytest.mark.parametrize("query", ["", "?wait=30"])
async def test_a_plain_request_that_is_cut_leaves_its_goal(query: str) -> None:
    held = Held()
    async with served(held.server) as url:
        async with client_of(url) as client:
            with anyio.move_on_after(0.2):
                await client.ask("PUT", f"{GOALS}/{ID}{query}", {"order": 1})
        held.go_on.set()
        ended = await fetch(url, "GET", f"{GOALS}/{ID}?wait=10")
        assert ended.json["status"] == "SUCCEEDED"


async def test_who_may_not_see_goals_chooses_none_to_cancel() -> None:
    others = {*Permission} - {Permission.OBSERVE}
    async with served(Held().server, authorize=permitting(others)) as url:
        await fetch(url, "POST", f"{GOALS}?label=order=17", {"order": 0})
        chosen = await fetch(url, "DELETE", f"{GOALS}?label=order=17")
        of_all = await fetch(url, "DELETE", GOALS)
        assert (chosen.status, of_all.status) == (403, 202)


async def test_a_cut_of_one_who_may_not_cancel_is_logged(log: Hearing) -> None:
    held, others = Held(), {*Permission} - {Permission.CANCEL}
    async with served(held.server, authorize=permitting(others)) as url:
        async with client_of(url) as client:
            await client.ask("PUT", f"{GOALS}/{ID}", {"order": 1}, accept=EVENTS)
            await client.until("id: 1")
        await log.until(f"has gone, and goal {ID} runs on: this client may not cancel")
        assert (await status_of(url, ID))["status"] == "EXECUTING"


async def test_the_goal_of_another_is_observed_and_not_canceled_by_a_cut() -> None:
    held = Held()
    async with served(held.server) as url, connect(url, FIBONACCI) as owner:
        goal = await owner.send_goal(Goal(1), goal_id=GoalID.parse(ID))
        async with client_of(url) as client:
            status, _ = await client.ask("PUT", f"{GOALS}/{ID}", {"order": 1}, accept=EVENTS)
            assert status == 200
            await client.until("id: 1")
        held.go_on.set()
        assert await goal.result() == Result([1])


# Following


async def test_events_go_on_behind_the_last_one() -> None:
    held = Held()
    async with served(held.server) as url:
        await fetch(url, "PUT", f"{GOALS}/{ID}", {"order": 5})
        where = f"{GOALS}/{ID}/events"
        for path, last, wanted in (
            (where, "0", [b"1", b"2", b"3", b"4", b"5"]),
            (where, "3", [b"4", b"5"]),
            (f"{where}?after=4", "", [b"5"]),
        ):
            async with client_of(url) as client:
                await client.ask("GET", path, last_event_id=last)
                assert re.findall(rb"id: (\d+)", await client.until("id: 5")) == wanted
        held.go_on.set()
        end = await fetch(url, "GET", where, last_event_id="5")
        assert [name for name, _, _ in end.events] == ["accepted", "result"]
        timed = await fetch(url, "GET", f"{where}?times=true")
        plain = await fetch(url, "GET", where)
        accepted, *feedback, _ = [data for _, _, data in timed.events]
        assert [one["feedback"] for one in feedback] == [data for _, _, data in plain.events[1:-1]]
        ended = await fetch(url, "GET", f"{GOALS}/{ID}")
        times = [accepted["stamp"], *(one["at"] for one in feedback), ended.json["ended_at"]]
        assert times == sorted(times), "when it was reported, and not when it was asked for"
        nothing = await fetch(url, "GET", where, last_event_id="end")
        assert (nothing.status, nothing.body) == (204, b"")


async def test_a_quiet_stream_is_kept_alive(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(goal_events, "KEEP_ALIVE_AFTER", 0.05)
    async with served(Held().server) as url, client_of(url) as client:
        await client.ask("POST", GOALS, {"order": 0}, accept=EVENTS)
        await client.until("\n\n:\n\n:\n\n")


async def test_a_client_that_does_not_read_is_let_go() -> None:
    async def endless(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        try:
            while True:
                yield Feedback([0] * 10_000)
        except BaseException:
            canceled.set()
            raise

    canceled = anyio.Event()
    server, limits = ActionServer(FIBONACCI, endless), Limits(write=0.1)
    async with served(server, limits=limits) as url, client_of(url) as client:
        await client.ask("POST", GOALS, {"order": 0}, accept=EVENTS)
        await canceled.wait()


async def test_a_stream_that_breaks_while_its_end_is_waited_for_is_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    streams: list[GoalStream] = []
    answers: list[Answer] = []

    class Followed(ForwardingEndpoint):
        async def feedback(self, *arguments: Any, **settings: Any) -> GoalStream:
            streams.append(await super().feedback(*arguments, **settings))
            return streams[-1]

    async def wait(url: str) -> None:
        answers.append(await fetch(url, "GET", f"{GOALS}/{ID}?wait=30"))

    monkeypatch.setattr(goal_events, "AT_ONCE", 0.0)
    async with served(Followed(Held().server)) as url:
        await fetch(url, "PUT", f"{GOALS}/{ID}", {"order": 0})
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait, url)
            while not streams:
                await anyio.lowlevel.checkpoint()
            await anyio.wait_all_tasks_blocked()
            streams[0].fail(ConnectionLost("the cable"))
    assert (answers[0].status, answers[0].json["detail"]) == (502, "the cable")


async def test_a_bug_of_an_endpoint_is_an_answer_without_its_text(log: Hearing) -> None:
    class Failing(ForwardingEndpoint):
        async def feedback(self, *arguments: Any, **settings: Any) -> GoalStream:
            raise ValueError("a secret")

    async with served(Failing(new_server())) as url:
        answer = await fetch(url, "GET", f"{GOALS}/{ID}")
        assert (answer.status, answer.json["type"]) == (500, "urn:fibaction:ServerFailed")
        assert b"secret" not in answer.body
        record = await log.until("its request failed")
        assert record.exc_info is not None


# Canceling


async def test_a_goal_is_canceled() -> None:
    held = Held()
    async with served(held.server) as url:
        await fetch(url, "PUT", f"{GOALS}/{ID}", {"order": 0})
        answer = await fetch(url, "DELETE", f"{GOALS}/{ID}")
        assert answer.status == 202
        assert [goal["goal_id"] for goal in answer.json["goals_canceling"]] == [ID]
        assert (await fetch(url, "GET", f"{GOALS}/{ID}?wait=10")).json["status"] == "CANCELED"
        late = await fetch(url, "DELETE", f"{GOALS}/{ID}")
        assert (late.status, late.json["detail"]) == (409, "the goal has ended")
        unknown = await fetch(url, "DELETE", f"{GOALS}/{ID[::-1]}")
        assert unknown.status == 404


async def test_a_cancel_that_is_rejected_has_its_reason() -> None:
    def never(goal: GoalHandle[Goal]) -> None:
        raise CancelRejected("the arm is over the table")

    server = ActionServer(FIBONACCI, Held(), on_cancel=never)
    async with served(server) as url:
        await fetch(url, "PUT", f"{GOALS}/{ID}", {"order": 0})
        answer = await fetch(url, "DELETE", f"{GOALS}/{ID}")
        assert (answer.status, answer.json["detail"]) == (409, "the arm is over the table")


async def test_all_goals_are_canceled_or_those_before_a_time() -> None:
    async with served(Held().server) as url:
        first = (await fetch(url, "POST", GOALS, {"order": 0})).json
        second = (await fetch(url, "POST", GOALS, {"order": 0})).json
        for query, goal in ((f"?before={first['stamp']}", first), ("", second)):
            answer = await fetch(url, "DELETE", f"{GOALS}{query}")
            assert answer.status == 202
            assert [one["goal_id"] for one in answer.json["goals_canceling"]] == [goal["goal_id"]]
        await fetch(url, "POST", GOALS, {"order": 0})
        for time in ("1h", "2026-01-31T12:00:00Z", "1970-01-01", "0001-01-01"):
            none = await fetch(url, "DELETE", f"{GOALS}?before={time}")
            assert (none.status, none.json["goals_canceling"]) == (202, [])
        answer = await fetch(url, "DELETE", f"{GOALS}?before=0s")
        assert len(answer.json["goals_canceling"]) == 1


async def test_the_goals_that_a_filter_chooses_are_canceled_and_no_others() -> None:
    async with served(Held().server) as url:
        for label in ("order=17", "order=17", "order=18"):
            await fetch(url, "POST", f"{GOALS}?label={label}", {"order": 0})
        stamps = [goal["stamp"] for goal in (await fetch(url, "GET", GOALS)).json]
        canceled = list[int]()
        for query in (
            "label=order=16",
            "status=SUCCEEDED",
            "client=nobody",
            "since=2100-01-01",
            f"parent={ID}",
            f"label=order=17&before={stamps[0]}",
            "label=order=17",
            "status=EXECUTING",
        ):
            answer = await fetch(url, "DELETE", f"{GOALS}?{query}")
            assert answer.status == 202
            canceled.append(len(answer.json["goals_canceling"]))

        assert canceled == [0, 0, 0, 0, 0, 1, 1, 1]


async def test_a_cancel_of_chosen_goals_that_is_rejected_has_its_reason() -> None:
    def never(_: object) -> None:
        raise CancelRejected("the arm is over the table")

    async with served(ActionServer(FIBONACCI, Held(), on_cancel=never)) as url:
        await fetch(url, "POST", f"{GOALS}?label=order=17", {"order": 0})
        answer = await fetch(url, "DELETE", f"{GOALS}?label=order=17")
        assert (answer.status, answer.json["detail"]) == (409, "the arm is over the table")


@pytest.mark.parametrize(
    ("method", "path", "hint"),
    [
        ("DELETE", f"{GOALS}?befor=10m", "did you mean before?"),
        (
            "DELETE",
            f"{GOALS}?limit=1",
            "it has status, client, label, since, until, parent, before",
        ),
        ("GET", f"{GOALS}?stauts=EXECUTING", "did you mean status?"),
        ("GET", "/actions?x=1", "it has none"),
        ("GET", f"{GOALS}/{ID}?after=3", "it has wait"),
        ("GET", f"{GOALS}/{ID}/events?wait=3", "it has after, times"),
        ("POST", f"{GOALS}?wiat=10", "did you mean wait?"),
        ("PUT", f"{GOALS}/{ID}?lable=a=b", "did you mean label?"),
    ],
)
async def test_a_parameter_that_would_not_count_is_refused(
    method: str, path: str, hint: str
) -> None:
    async with served(Held().server) as url:
        answer = await fetch(url, method, path, {"order": 0} if method[0] == "P" else None)
        assert answer.status == 400
        assert answer.json["detail"].endswith(f" here: {hint}")
        assert (await fetch(url, "GET", GOALS)).json == []


# Tokens and permissions


async def test_a_token_is_asked_for_and_known(log: Hearing) -> None:
    held = Held()
    async with served(held.server, tokens={"8Zq0r1 ü": "kitchen"}) as url:
        for headers in ({}, {"authorization": "Bearer guessed"}, {"authorization": "Basic x"}):
            answer = await fetch(url, "GET", "/actions", **headers)
            assert answer.status == 401
            assert answer.headers["www-authenticate"] == "Bearer"
        assert all("HTTP 401" in line for line in log.warnings)
        assert len(log.warnings) == 3
        token = "Bearer 8Zq0r1 ü".encode().decode("latin-1")
        put = [
            await fetch(url, "PUT", f"{GOALS}/{ID}", {"order": 0}, authorization=token)
            for _ in range(2)
        ]
        assert [answer.status for answer in put] == [201, 200]
        (goal,) = (await fetch(url, "GET", GOALS, authorization=token)).json
        assert goal["client"].startswith("kitchen at 127.0.0.1:")


async def test_permissions_are_those_of_the_token(log: Hearing) -> None:
    def cook_sends(peer: Peer, action: str, permission: Permission) -> bool:
        return peer.name == "cook" and permission is Permission.SEND

    tokens = {"a": "cook", "b": "guest"}
    async with served(tokens=tokens, authorize=cook_sends) as url:
        cook, guest = {"authorization": "bearer a"}, {"authorization": "bearer b"}
        where = f"{GOALS}/{ID}"
        assert (await fetch(url, "PUT", where, {"order": 1}, **guest)).status == 403
        assert (await fetch(url, "PUT", where, {"order": 1}, **cook)).status == 201
        assert (await fetch(url, "GET", f"{where}?wait=5", **cook)).status == 200
        denied = [
            await fetch(url, "GET", where, **guest),
            await fetch(url, "GET", f"{where}/events", **guest),
            await fetch(url, "GET", GOALS, **cook),
            await fetch(url, "DELETE", where, **cook),
            await fetch(url, "GET", "/actions/other/goals", **cook),
        ]
        assert {answer.status for answer in denied} == {403}
        assert "may not observe" in denied[0].json["detail"]


# Bad input


@pytest.mark.parametrize(
    ("method", "path", "body", "headers", "status"),
    [
        ("POST", GOALS, b'{"order": NaN}', {}, 400),
        ("POST", GOALS, b'{"order"', {}, 400),
        ("POST", GOALS, b"\xff\xfe", {}, 400),
        ("POST", GOALS, b"", {}, 422),
        ("POST", GOALS, b"[" * 500 + b"]" * 500, {}, 422),
        ("POST", GOALS, b'{"order": 1e400}', {}, 400),
        ("POST", GOALS, b'{"order": "3"}', {}, 422),
        ("POST", GOALS, b'{"order": 3, "speed": 1}', {}, 422),
        ("POST", GOALS, b'{"order": 18446744073709551616}', {}, 422),
        ("POST", GOALS, b"{}", {}, 422),
        ("POST", GOALS, b"{}", {"content_type": "text/plain"}, 415),
        ("POST", GOALS, b" " * 40_000, {}, 413),
        ("POST", GOALS, b"[" * 10_000 + b"]" * 10_000, {}, 400),
        ("POST", f"{GOALS}?wait=x", b'{"order": 3}', {}, 400),
        ("POST", f"{GOALS}?wait=nan", b'{"order": 3}', {}, 400),
        ("POST", f"{GOALS}?wait=1e9", b'{"order": 3}', {}, 400),
        ("POST", f"{GOALS}?wait=1_0", b'{"order": 3}', {}, 400),
        ("POST", "/actions/no/goals", b'{"order": 3}', {}, 404),
        ("GET", "/actions/%2e%2e/%2e%2e/etc", None, {}, 404),
        ("DELETE", f"{GOALS}?before=now", None, {}, 400),
        ("DELETE", f"{GOALS}?before=0", None, {}, 400),
        ("DELETE", f"{GOALS}?before=", None, {}, 400),
        ("DELETE", f"{GOALS}?label=", None, {}, 400),
        ("DELETE", f"{GOALS}?client=", None, {}, 400),
        ("GET", f"{GOALS}/{ID}/events?after=", None, {}, 400),
        ("GET", f"{GOALS}/{ID}/events?after=x", None, {}, 400),
        ("GET", f"{GOALS}/{ID}/events?times=", None, {}, 400),
        ("PATCH", GOALS, None, {}, 405),
        ("GET", "/actions", None, {"origin": "http://evil.example"}, 403),
        ("GET", "/actions", None, {"origin": "null"}, 403),
    ],
)
async def test_bad_input_gets_its_status_and_one_line_of_the_log(
    method: str, path: str, body: bytes | None, headers: dict[str, str], status: int, log: Hearing
) -> None:
    held = Held()
    async with served(held.server, limits=Limits(frame=30_000)) as url:
        other = f"{GOALS}/{'e' * 32}"
        assert (await fetch(url, "PUT", other, {"order": 3})).status == 201
        answer = await fetch(url, method, path, body, **headers)
        assert answer.status == status
        assert answer.json["status"] == status
        assert answer.headers["content-type"] == "application/problem+json"
        assert len(log.warnings) == 1
        assert f"HTTP {status}: " in log.warnings[0]
        held.go_on.set()
        assert (await fetch(url, "GET", f"{other}?wait=5")).json["result"] == {"sequence": [3]}


async def test_a_goal_that_the_server_rejects_has_its_reason(log: Hearing) -> None:
    def too_far(goal: Goal) -> None:
        raise GoalRejected("too far", code=RejectionCode(goal.order))

    async with served(ActionServer(FIBONACCI, Held(), on_goal=too_far)) as url:
        answer = await fetch(url, "POST", GOALS, {"order": 0})
        assert (answer.status, answer.json["detail"]) == (422, "too far")
        busy = await fetch(url, "POST", GOALS, {"order": 1}, accept=EVENTS)
        assert (busy.status, busy.headers["retry-after"]) == (503, "1")
        assert (await fetch(url, "GET", f"{GOALS}/{ID}")).status == 404
    assert log.warnings == []


async def test_numbers_beyond_what_javascript_has_stay_what_they_are() -> None:
    wide: Action[Any, Any, Any] = Action(
        "wide", goal=dict[str, int], feedback=float, result=list[int]
    )

    async def echo(goal: GoalHandle[Any]) -> AsyncGenerator[Any, None]:
        yield math.nan
        yield [goal.request["n"]]

    async with served(ActionServer(wide, echo)) as url:
        for number in (2**53 + 1, 2**63, -(2**63)):
            answer = await fetch(url, "POST", "/actions/wide/goals?wait=5", {"n": number})
            assert answer.json["result"] == [number]
        told = await fetch(url, "POST", "/actions/wide/goals", {"n": 1}, accept=EVENTS)
        assert told.events[2] == ("feedback", "1", None)


async def test_what_json_cannot_express_is_a_failure() -> None:
    odd: Action[Any, Any, Any] = Action(
        "odd", goal=int, feedback=dict[tuple[int, int], int], result=str
    )

    async def execute(goal: GoalHandle[Any]) -> AsyncGenerator[Any, None]:
        yield {(1, 2): 3}
        yield "done"

    async with served(ActionServer(odd, execute)) as url:
        told = await fetch(url, "POST", "/actions/odd/goals", 1, accept=EVENTS)
        assert told.events[-1][0] == "failure"


async def test_a_result_that_cannot_be_read_is_told_in_place_of_it() -> None:
    odd = Action("odd", goal=int, feedback=str, result=msgspec.Raw)

    async def execute(goal: GoalHandle[int]) -> AsyncGenerator[Any, None]:
        if goal.request:
            raise GoalAborted("it is worn", result=msgspec.Raw(b"\xc1"))
        yield msgspec.Raw(b"\xc1")

    async with served(ActionServer(odd, execute)) as url:
        for request, before in ((0, ""), (1, "it is worn; ")):
            told = await fetch(url, "POST", "/actions/odd/goals", request, accept=EVENTS)
            end = told.events[-1][2]
            kept = (
                await fetch(url, "GET", f"/actions/odd/goals/{told.events[0][2]['goal_id']}")
            ).json
            for found in (end, kept):
                assert found["result"] is None
                assert found["reason"].startswith(f"{before}its result cannot be read: ")


async def test_an_action_with_slashes_has_its_address() -> None:
    arm: Action[Any, Any, Any] = Action("/left/arm", goal=int, feedback=str, result=int)

    async def echo(goal: GoalHandle[int]) -> AsyncGenerator[Any, None]:
        yield goal.request

    async with served(ActionServer(arm, echo)) as url:
        for name in ("%2Fleft%2Farm", "/left/arm"):
            answer = await fetch(url, "POST", f"/actions/{name}/goals?wait=5", 7)
            assert answer.json["result"] == 7
            assert (await fetch(url, "GET", answer.headers["location"])).json["result"] == 7


async def test_a_schema_that_changes_is_read_again() -> None:
    class Changing(ForwardingEndpoint):
        schema: ClassVar[dict[str, Any]] = {}

        @property
        def info(self) -> ActionInfo:
            return msgspec.structs.replace(super().info, goal=self.schema)

    async with served(Changing(new_server())) as url:
        statuses: list[int] = []
        for schema in ({}, {"type": "string"}):
            Changing.schema = schema
            statuses.append((await fetch(url, "POST", GOALS, {"order": 1})).status)
        assert statuses == [201, 422]


async def test_a_gateway_shows_a_goal_only_to_those_who_may_observe() -> None:
    def boss_observes(peer: Peer, action: str, permission: Permission) -> bool:
        return peer.name == "boss" or permission is Permission.SEND

    async with (
        serve(new_server(), "tcp://127.0.0.1:0") as (behind,),
        connect(behind) as connection,
    ):
        endpoint = connection.endpoint((await connection.actions())[0])
        tokens = {"a": "boss", "b": "guest"}
        async with served(endpoint, tokens=tokens, authorize=boss_observes) as url:
            where = f"{GOALS}/{ID}?wait=5"
            first = await fetch(url, "PUT", where, {"order": 3}, authorization="Bearer a")
            again = await fetch(url, "PUT", where, {"order": 3}, authorization="Bearer b")
            posted = await fetch(url, "POST", GOALS, {"order": 3}, authorization="Bearer b")
        assert [first.status, again.status, posted.status] == [201, 403, 201]


# Connections


async def test_pages_that_are_named_get_the_headers_of_cors() -> None:
    origin = "https://console.example"
    async with served(origins=[origin]) as url:
        answer = await fetch(url, "GET", "/actions", origin=origin)
        assert answer.headers["access-control-allow-origin"] == origin
        asked = await fetch(url, "OPTIONS", GOALS, origin=origin)
        assert asked.status == 204
        for header in ("authorization", "traceparent"):
            assert header in asked.headers["access-control-allow-headers"]
        assert "access-control-allow-origin" not in (await fetch(url, "GET", "/actions")).headers


async def test_goals_that_the_server_has_forgotten_are_listed_from_its_history(
    tmp_path: Path,
) -> None:
    store = SqliteStore(tmp_path / "goals.db", history=GoalHistory())
    server = ActionServer(FIBONACCI, fibonacci, store=store, result_timeout=0)
    async with served(server) as url:
        sent = [
            (await fetch(url, "POST", f"{GOALS}?wait=60", {"order": 1})).json["goal_id"]
            for _ in range(3)
        ]
        assert (await fetch(url, "GET", GOALS)).json == []
        past = f"{GOALS}?past=true&status=SUCCEEDED"
        first = await fetch(url, "GET", f"{past}&limit=2")
        link = re.fullmatch(r'<(\?limit=2&\S+)>; rel="next"', first.headers["link"])
        assert link
        second = await fetch(url, "GET", f"{GOALS}{link[1]}")
        assert "link" not in second.headers
        assert [goal["goal_id"] for goal in first.json + second.json] == sent
        one = await fetch(url, "GET", f"{GOALS}/{sent[0]}")
        assert (one.status, one.json["status"]) == (200, "SUCCEEDED")
        assert one.json["result"]["sequence"][0] == 0
        assert (await fetch(url, "GET", f"{GOALS}?past=1")).status == 400


async def test_goals_are_found_by_the_labels_with_which_they_were_sent(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "goals.db", history=GoalHistory())
    server = ActionServer(FIBONACCI, fibonacci, store=store, result_timeout=0)
    async with served(server) as url:
        for query in ("label=order=17&label=site=north", "label=order=18", ""):
            await fetch(url, "POST", f"{GOALS}?wait=60&{query}", {"order": 1})
        one = f"{GOALS}/{1:032x}?wait=60&label=order%3D17"
        assert (await fetch(url, "PUT", one, {"order": 1})).status == 201

        async def found(query: str) -> list[dict[str, str]]:
            listed = await fetch(url, "GET", f"{GOALS}?past=true&{query}")
            return [goal.get("labels", {}) for goal in listed.json]

        both = {"order": "17", "site": "north"}
        assert await found("") == [both, {"order": "18"}, {}, {"order": "17"}]
        assert await found("label=order=17") == [both, {"order": "17"}]
        assert await found("label=order=17&label=site=north") == [both]
        for method, query in (("GET", "label=order"), ("POST", "label=step=2")):
            wrong = await fetch(url, method, f"{GOALS}?{query}", {"order": 1})
            assert (wrong.status, "label: '" in wrong.json["detail"]) == (400, True)


async def test_one_goal_is_told_with_what_a_list_tells_of_it(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "goals.db", history=GoalHistory())
    server = ActionServer(FIBONACCI, fibonacci, store=store, result_timeout=0)
    async with served(server) as url:
        sent = await fetch(url, "POST", f"{GOALS}?wait=60&label=order=17", {"order": 3})
        listed = (await fetch(url, "GET", f"{GOALS}?past=true")).json[0]
        past = await fetch(url, "GET", f"{GOALS}/{listed['goal_id']}")
    del listed["place"], listed["queue_length"]
    times = {"began_at", "ended_at", "waited", "ran"}
    assert {"labels", "client", "feedback_count", *times} < listed.keys()
    assert past.json == listed | {"result": {"sequence": [0, 1, 1, 2]}}
    told = {name: value for name, value in sent.json.items() if name not in times}
    assert sent.json.keys() == past.json.keys()
    assert told.items() < past.json.items()


async def test_a_child_has_its_parent_wherever_it_is_described() -> None:
    parent, meta = GoalID.random(), {"step": "pick"}
    told = {"goal_id": str(parent), "step": "pick"}
    server = new_server()
    async with served(server) as url:
        child, payload = GoalID.random(), FIBONACCI.goal.encode(Goal(1))
        await server.send_goal(child, payload, meta={**meta, "parent": str(parent)})
        await fetch(url, "POST", f"{GOALS}?wait=10", {"order": 1})
        one = await fetch(url, "GET", f"{GOALS}/{child}?wait=10")
        assert one.json["parent"] == told
        (listed,) = (await fetch(url, "GET", f"{GOALS}?limit=1&parent={parent}")).json
        assert (listed["goal_id"], listed["parent"]) == (str(child), told)
        assert len((await fetch(url, "GET", GOALS)).json) == 2
        events = (await fetch(url, "GET", f"{GOALS}/{child}/events", accept=EVENTS)).events
        assert events[0][2]["parent"] == told


async def test_head_is_get_without_a_body_and_options_tells_the_methods() -> None:
    allowed = {
        "/": "GET, HEAD, OPTIONS",
        "/healthz": "GET, HEAD, OPTIONS",
        "/openapi.json": "GET, HEAD, OPTIONS",
        "/actions": "GET, HEAD, OPTIONS",
        "/actions/fibonacci": "GET, HEAD, OPTIONS",
        GOALS: "GET, HEAD, POST, DELETE, OPTIONS",
        f"{GOALS}/{ID}": "GET, HEAD, PUT, DELETE, OPTIONS",
        f"{GOALS}/{ID}/events": "GET, HEAD, OPTIONS",
        f"{GOALS}/{ID}/rerun": "POST, OPTIONS",
    }
    held = Held()
    async with served(held.server) as url:
        assert (await fetch(url, "PUT", f"{GOALS}/{ID}", {"order": 3})).status == 201
        for path, methods in allowed.items():
            head, asked = await fetch(url, "HEAD", path), await fetch(url, "OPTIONS", path)
            assert (head.status, head.body) == (200 if "HEAD" in methods else 405, b"")
            assert (asked.status, asked.headers["allow"]) == (204, methods)
            assert asked.headers["access-control-allow-methods"] == methods
            if not path.endswith("/events"):
                got = await fetch(url, "GET", path)
                assert head.headers["content-type"] == got.headers["content-type"]
        assert (await fetch(url, "HEAD", f"{GOALS}/{'e' * 32}/events")).status == 404
        assert (await fetch(url, "OPTIONS", "/nothing")).status == 204


async def test_one_cause_has_one_type_of_problem() -> None:
    async with served() as url:
        unknown = f"{GOALS}/{'e' * 32}"
        types = {(await fetch(url, method, unknown)).json["type"] for method in ("GET", "DELETE")}
    assert types == {"urn:fibaction:UnknownGoal"}
    unreadable = GoalRejected("goal.order is missing", code=RejectionCode.UNREADABLE)
    assert problem_of(unreadable) == problem_of(PayloadError("goal.order is missing"))


async def test_a_goal_that_is_posted_again_with_its_key_runs_once() -> None:
    held = Held()
    key = {"idempotency-key": '"order-17"'}
    async with served(held.server) as url:
        first, again = [await fetch(url, "POST", GOALS, {"order": 3}, **key) for _ in range(2)]
        assert (first.status, again.status) == (201, 200)
        assert first.json["goal_id"] == again.json["goal_id"]
        other = await fetch(url, "POST", GOALS, {"order": 4}, **key)
        assert (other.status, other.json["code"]) == (409, "DUPLICATE")
        assert (await fetch(url, "POST", GOALS, {"order": 3})).json != first.json


async def test_a_key_is_of_one_client_and_its_goal_tells_nothing_of_the_token() -> None:
    tokens = {"a": "cook", "b": "cook", "c": "guest"}
    ids: list[str] = []
    for _ in range(2):  # two servers
        async with served(tokens=tokens) as url:
            for token in tokens:
                head = {"idempotency-key": "17", "authorization": f"Bearer {token}"}
                posted = await fetch(url, "POST", GOALS, {"order": 1}, **head)
                assert posted.status in {200, 201}
                ids.append(posted.json["goal_id"])
    assert ids[0] == ids[1]
    assert ids[3] == ids[4]
    assert len(set(ids)) == 4


async def test_a_body_that_is_compressed_is_refused_with_the_coding_that_is_taken() -> None:
    async with served() as url:
        packed = await fetch(url, "POST", GOALS, {"order": 1}, content_encoding="gzip")
        assert (packed.status, packed.headers["accept-encoding"]) == (415, "identity")
        plain = await fetch(url, "POST", GOALS, {"order": 1}, content_encoding="identity")
        assert plain.status == 201


@pytest.mark.parametrize("method", ["GET", "POST", "DELETE"])
async def test_more_labels_than_a_goal_can_have_are_refused(method: str) -> None:
    labels = "&".join(f"label=k{number}=1" for number in range(9))
    async with served() as url:
        answer = await fetch(url, method, f"{GOALS}?{labels}", {"order": 1})
    assert answer.status == 400
    assert answer.json["detail"] == "label is there 9 times, and 8 are the limit"


async def test_a_preference_to_wait_is_that_of_the_parameter() -> None:
    async with served() as url:
        answer = await fetch(url, "POST", GOALS, {"order": 1}, prefer="respond-async, wait=20")
        assert answer.json["result"] == {"sequence": [0, 1]}
        assert answer.headers["preference-applied"] == "wait=20"
        again = await fetch(url, "GET", f"{GOALS}/{answer.json['goal_id']}", prefer="wait=20")
        assert again.json["status"] == "SUCCEEDED"


async def test_a_description_that_is_known_is_not_sent_again() -> None:
    async with served() as url:
        first = await fetch(url, "GET", "/openapi.json", accept_encoding="gzip")
        tag = first.headers["etag"]
        known = await fetch(url, "GET", "/openapi.json", if_none_match=tag)
        assert (known.status, known.body) == (304, b"")
        assert known.headers["etag"] == tag.removeprefix("W/")
        assert known.headers["vary"] == first.headers["vary"] == "Accept-Encoding"
        assert (await fetch(url, "GET", "/openapi.json", if_none_match="*")).status == 304
        assert first.headers["content-encoding"] == "gzip"
        assert len(first.body) < 5000


# What was logged, and what was given up


GOAL_ID, OLD_ID, NEW_ID = (GoalID.random() for _ in range(3))


class Logging(ForwardingEndpoint):
    """A server with the lines of one goal."""

    async def log_lines(self, goal_id: GoalID) -> list[LogLine] | None:
        return [LogLine(7, "INFO", "arm", "grips")] if goal_id == GOAL_ID else None


async def test_the_lines_of_a_goal_are_told_to_those_who_may_observe() -> None:
    may = {Permission.OBSERVE}

    async with served(Logging(new_server()), authorize=permitting(may)) as url:
        told = await fetch(url, "GET", f"{GOALS}/{GOAL_ID}/log")
        line = {"at": "7", "level": "INFO", "logger": "arm", "text": "grips"}
        assert (told.status, told.json) == (200, {"lines": [line]})
        none = await fetch(url, "GET", f"{GOALS}/{GoalID.random()}/log")
        assert (none.status, none.json) == (200, {"lines": None})
        may.clear()
        assert (await fetch(url, "GET", f"{GOALS}/{GOAL_ID}/log")).status == 403


class Again(ForwardingEndpoint):
    """A server that has given up one goal."""

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        return NEW_ID if goal_id == OLD_ID else None


async def test_an_operator_gets_the_id_of_the_new_goal_if_the_old_one_was_given_up() -> None:
    may = {Permission.OBSERVE}

    async with served(Again(new_server()), authorize=permitting(may)) as url:
        assert (await fetch(url, "POST", f"{GOALS}/{OLD_ID}/rerun")).status == 403
        may.add(Permission.OPERATE)
        answer = await fetch(url, "POST", f"{GOALS}/{OLD_ID}/rerun")
        assert (answer.status, answer.json) == (201, {"goal_id": str(NEW_ID)})
        assert answer.headers["location"].endswith(f"{GOALS}/{NEW_ID}")
        again = await fetch(url, "POST", f"{GOALS}/{NEW_ID}/rerun")
        assert (again.status, "was not given up" in again.json["detail"]) == (409, True)


class GivenUp(ForwardingEndpoint):
    """A server that has given up each of its goals at a checkpoint."""

    checkpoint = b""

    async def feedback(self, *arguments: Any, **more: Any) -> GoalStream:
        stream: Any = await super().feedback(*arguments, **more)
        stream.checkpoint = self.checkpoint
        return cast("GoalStream", stream)


async def test_the_details_of_a_goal_that_was_given_up_have_its_checkpoint_for_observers() -> None:
    may = {Permission.SEND, Permission.OBSERVE}

    robot = GivenUp(new_server())
    tokens = {"secret": "ann"}
    async with served(robot, authorize=permitting(may), tokens=tokens) as url:
        ann = {"Authorization": "Bearer secret"}
        sent = await fetch(url, "POST", f"{GOALS}?wait=9", {"order": 2}, **ann)
        path = f"{GOALS}/{sent.json['goal_id']}"
        assert "checkpoint" not in sent.json
        for robot.checkpoint, told in ((b"", None), (b"\x04", 4), (b"\xc1", None)):
            assert (await fetch(url, "GET", path, **ann)).json["checkpoint"] == told
        may.remove(Permission.OBSERVE)
        own = await fetch(url, "GET", path, **ann)
        assert (own.status, "checkpoint" in own.json) == (200, False)
