"""`Tracing`: the spans of goals at clients and servers, read back from memory."""

from __future__ import annotations

import gc
import logging
import threading
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from opentelemetry import baggage, context
from opentelemetry.sdk.trace import ReadableSpan, Span, SpanProcessor, TracerProvider
from opentelemetry.sdk.trace.sampling import ALWAYS_OFF

import fibaction.blocking
from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalHandle,
    GoalID,
    GoalInfo,
    GoalKept,
    GoalRejected,
    GoalStatus,
    GoalTimeout,
    Outcome,
    ServerNotFound,
    connect,
    serve,
)
from fibaction.observe.otel import Tracing
from fibaction.words.errors import ConnectionLost
from fibaction.words.meta import DETACHED
from tests.server.held import waits
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.memory_store import MemoryStore
from tests.support.spans import Spans, label

asynchronous = pytest.mark.anyio
CLIENT, SERVER = "CLIENT: goal fibonacci", "SERVER: goal fibonacci"
PAYLOAD = FIBONACCI.goal.encode(Goal(2))


@pytest.fixture
def spans() -> Spans:
    return Spans()


def reject_large(goal: Goal) -> None:
    if goal.order > 100:
        raise GoalRejected("too large")


Client = ActionClient[Goal, Feedback, Result]


@asynccontextmanager
async def reached(
    spans: Spans, executor: Callable[[GoalHandle[Goal]], Items] = fibonacci, **options: Any
) -> AsyncGenerator[Client, None]:
    """Serve with spans, and give a client with spans."""
    options = {"on_goal": reject_large, "watchers": [spans.tracing], **options}
    async with ActionServer(FIBONACCI, executor, **options) as server:
        yield ActionClient(server, FIBONACCI, tracing=spans.tracing)


def facts(span: ReadableSpan) -> dict[str, Any]:
    """Return the attributes without their common beginning, and those that every span has."""
    return {
        name.removeprefix("fibaction."): value
        for name, value in (span.attributes or {}).items()
        if name not in ("fibaction.action", "fibaction.goal.id")
    }


def status(span: ReadableSpan) -> tuple[str, str | None]:
    return span.status.status_code.name, span.status.description


def events(span: ReadableSpan) -> list[str]:
    return [event.name for event in span.events]


# The ends of goals


@asynchronous
async def test_a_goal_that_succeeds_has_a_span_at_each_end(spans: Spans) -> None:
    async with reached(spans) as client:
        with spans.tracer.start_as_current_span("mission"):
            await client.call(Goal(3))

    at_client, at_server = spans.named(CLIENT), spans.named(SERVER)
    assert spans.path(SERVER) == ["mission", CLIENT, SERVER]
    assert [label(span) for span in spans.ended] == [SERVER, CLIENT, "mission"]
    assert facts(at_client) == {"goal.status": "SUCCEEDED"}
    assert facts(at_server) == {
        "goal.status": "SUCCEEDED",
        "goal.attempt": 1,
        "feedback.count": 2,
    }
    assert (status(at_client), status(at_server)) == (("UNSET", None), ("UNSET", None))
    assert events(at_client) == ["ACCEPTED"]
    assert events(at_server) == ["ACCEPTED", "EXECUTING"]
    for span in (at_client, at_server):
        assert span.attributes is not None
        assert span.attributes["fibaction.action"] == "fibonacci"
        assert GoalID.parse(str(span.attributes["fibaction.goal.id"]))


@asynchronous
@pytest.mark.parametrize(
    ("order", "status_name", "error", "reason"),
    [
        (101, "REJECTED", GoalRejected, "too large"),
        (1, "ABORTED", GoalAborted, "the arm is stuck"),
    ],
)
async def test_a_goal_that_fails_is_an_error_with_its_reason(
    spans: Spans, order: int, status_name: str, error: type[Exception], reason: str
) -> None:
    async def fails(goal: GoalHandle[Goal]) -> Items:
        yield Feedback([])
        raise GoalAborted("the arm is stuck")

    async with reached(spans, fails) as client:
        with pytest.raises(error):
            await client.call(Goal(order))

    for name in (CLIENT, SERVER):
        span = spans.named(name)
        found = facts(span)
        assert (found["goal.status"], found["goal.reason"]) == (status_name, reason)
        assert found["error.type"] == error.__name__
        assert status(span) == ("ERROR", reason)


@asynchronous
async def test_a_canceled_goal_is_no_error(spans: Spans) -> None:
    async with reached(spans, waits) as client, client.send_goal(Goal(1)) as goal:
        await anext(goal.feedback)
        await goal.cancel()
        await goal.outcome()

    at_client, at_server = spans.named(CLIENT), spans.named(SERVER)
    assert events(at_server) == ["ACCEPTED", "EXECUTING", "CANCELING"]
    assert facts(at_client)["goal.status"] == facts(at_server)["goal.status"] == "CANCELED"
    assert (status(at_client), status(at_server)) == (("UNSET", None), ("UNSET", None))


# The client


@asynchronous
async def test_a_server_that_is_not_found_is_an_error_of_the_client(spans: Spans) -> None:
    async with connect("inproc://traced", FIBONACCI, tracing=spans.tracing) as client:
        with pytest.raises(ServerNotFound) as caught:
            await client.call(Goal(1))

    text = str(caught.value)
    assert facts(spans.named(CLIENT)) == {"goal.reason": text, "error.type": "ServerNotFound"}
    assert status(spans.named(CLIENT)) == ("ERROR", text)


@asynchronous
async def test_the_span_of_a_block_ends_with_the_block(spans: Spans) -> None:
    async with reached(spans, waits) as client:
        with pytest.raises(ValueError, match="enough"):
            async with client.send_goal(Goal(1)) as goal:
                await anext(goal.feedback)
                assert not spans.ended
                raise ValueError("enough")
        assert facts(spans.named(CLIENT)) == {"goal.status": "EXECUTING"}
        assert status(spans.named(CLIENT)) == ("UNSET", None)


@asynchronous
async def test_the_span_of_a_block_has_the_end_of_a_goal_whose_outcome_was_not_read(
    spans: Spans,
) -> None:
    async with reached(spans) as client, client.send_goal(Goal(3)) as goal:
        assert len([item async for item in goal.feedback]) == 2

    assert facts(spans.named(CLIENT)) == {"goal.status": "SUCCEEDED"}


@asynchronous
async def test_a_goal_that_no_code_references_any_more_ends_its_span(spans: Spans) -> None:
    async with reached(spans, waits) as client:
        goal = await client.send_goal(Goal(3))
        await anext(goal.feedback)
        del goal
        gc.collect()

        assert facts(spans.named(CLIENT)) == {"goal.status": "EXECUTING"}


@asynchronous
@pytest.mark.parametrize("timeout", [None, 60.0])
async def test_a_call_that_is_canceled_before_the_answer_is_no_error(
    spans: Spans, timeout: float | None
) -> None:
    asked = anyio.Event()

    async def decides(goal: Goal) -> None:
        asked.set()
        await anyio.sleep_forever()

    async with reached(spans, on_goal=decides) as client, anyio.create_task_group() as tasks:

        async def call() -> None:
            await client.call(Goal(1), timeout=timeout)

        tasks.start_soon(call)
        await asked.wait()
        tasks.cancel_scope.cancel()

    assert status(spans.named(CLIENT)) == ("UNSET", None)
    assert facts(spans.named(CLIENT)) == {}
    assert facts(spans.named(SERVER))["goal.status"] == "REJECTED"


@asynchronous
@pytest.mark.parametrize("reads", [False, True])
async def test_a_timeout_is_an_error_of_the_client(spans: Spans, reads: bool) -> None:
    async with reached(spans, waits) as client:
        with pytest.raises(GoalTimeout):
            await client.call(Goal(1), timeout=0.05, on_feedback=print if reads else None)

    assert facts(spans.named(CLIENT))["error.type"] == "GoalTimeout"
    assert status(spans.named(CLIENT))[0] == "ERROR"


@pytest.mark.parametrize("is_own", [True, False])
def test_a_timeout_counts_more_than_the_outcome_of_its_cancel(spans: Spans, is_own: bool) -> None:
    class Stream:
        goal_id = GoalID.random()
        status = GoalStatus.CANCELED

        def known_outcome(self) -> Outcome[bytes]:
            return Outcome(GoalStatus.CANCELED)

    stream: Any = Stream()
    goal_id = stream.goal_id if is_own else GoalID.random()
    span = spans.tracing.sending("fibonacci", stream.goal_id)
    span.left(stream, GoalTimeout("it took too long", goal_id=goal_id))

    expected = ("error.type", "GoalTimeout") if is_own else ("goal.status", "CANCELED")
    assert expected in facts(spans.named(CLIENT)).items()


def test_the_first_end_of_a_span_counts(spans: Spans) -> None:
    class Stream:
        status = GoalStatus.EXECUTING

        def known_outcome(self) -> None:
            raise ConnectionLost("the line broke")

    stream: Any = Stream()
    span = spans.tracing.sending("fibonacci", GoalID.random())
    span.left(stream)
    span.accepted(stream)
    span.failed(ValueError())
    span.ended(Outcome(GoalStatus.SUCCEEDED))
    span.left(stream)

    assert facts(spans.named(CLIENT))["error.type"] == "ConnectionLost"
    assert events(spans.named(CLIENT)) == []


def test_a_blocking_client_has_spans_below_that_of_its_thread(spans: Spans) -> None:
    ready, stop = threading.Event(), threading.Event()
    urls: list[str] = []

    async def run() -> None:
        server = ActionServer(FIBONACCI, fibonacci, watchers=[spans.tracing])
        async with serve(server, "tcp://127.0.0.1:0") as found:
            urls.extend(found)
            ready.set()
            await anyio.to_thread.run_sync(stop.wait)

    thread = threading.Thread(target=anyio.run, args=(run,))
    thread.start()
    try:
        assert ready.wait(10)
        with fibaction.blocking.connect(urls[0], FIBONACCI, tracing=spans.tracing) as client:
            with spans.tracer.start_as_current_span("mission"):
                assert client.call(Goal(3)) == Result([0, 1, 1, 2])
    finally:
        stop.set()
        thread.join()

    assert spans.path(SERVER) == ["mission", CLIENT, SERVER]
    assert facts(spans.named(SERVER))["sender"].startswith("127.0.0.1:")


# What goes with a goal


@asynchronous
async def test_baggage_of_the_client_is_seen_by_the_executor(spans: Spans) -> None:
    seen: list[object] = []

    async def looks(goal: GoalHandle[Goal]) -> Items:
        seen.append(baggage.get_baggage("robot"))
        yield Result([])

    async with reached(spans, looks) as client:
        token = context.attach(baggage.set_baggage("robot", "7"))
        try:
            await client.call(Goal(1))
        finally:
            context.detach(token)

    assert seen == ["7"]


@asynchronous
async def test_baggage_that_is_too_large_is_left_behind_and_the_goal_goes(spans: Spans) -> None:
    async with reached(spans) as client:
        token = context.attach(baggage.set_baggage("robot", "x" * 4080))
        try:
            await client.call(Goal(3))
        finally:
            context.detach(token)

    assert spans.path(SERVER) == [CLIENT, SERVER]


@asynchronous
async def test_a_goal_whose_client_does_not_wait_has_a_trace_of_its_own(spans: Spans) -> None:
    async with reached(spans) as client:
        span = spans.tracing.sending("fibonacci", GoalID.random())
        assert span.meta is not None
        meta = {**span.meta, DETACHED: "1"}
        stream = await client.endpoint.send_goal(GoalID.random(), PAYLOAD, meta=meta)
        await stream.outcome()
        span.left(stream)

    at_client, at_server = spans.named(CLIENT), spans.named(SERVER)
    assert at_server.parent is None
    assert [link.context.span_id for link in at_server.links] == [at_client.context.span_id]


@asynchronous
async def test_a_goal_without_a_trace_begins_one(spans: Spans) -> None:
    async with reached(spans) as client:
        for meta in (None, {DETACHED: "1"}):
            stream = await client.endpoint.send_goal(GoalID.random(), PAYLOAD, meta=meta)
            await stream.outcome()

    assert [(span.parent, list(span.links)) for span in spans.ended] == [(None, [])] * 2


@asynchronous
async def test_a_goal_without_a_trace_belongs_to_the_current_span(spans: Spans) -> None:
    async with ActionServer(FIBONACCI, fibonacci, watchers=[spans.tracing]) as server:
        with spans.tracer.start_as_current_span("request"):
            await ActionClient(server, FIBONACCI).call(Goal(3))

    assert spans.path(SERVER) == ["request", SERVER]


# Goals of a store


@asynchronous
async def test_a_goal_that_runs_again_stays_in_the_trace_of_its_client(spans: Spans) -> None:
    options: Any = {"store": MemoryStore(), "recovery": "rerun", "at_stop": "keep"}

    async def again(goal: GoalHandle[Goal]) -> Items:
        with spans.tracer.start_as_current_span("again"):
            yield Result([])

    with spans.tracer.start_as_current_span("mission"):
        async with reached(spans, waits, **options) as client:
            goal = await client.send_goal(Goal(4))
            await anext(goal.feedback)
        with pytest.raises(GoalKept):
            await goal.outcome()
    async with reached(spans, again, **options) as client:
        await (await client.attach(goal.goal_id)).outcome()

    first, second = (span for span in spans.ended if label(span) == SERVER)
    at_client = spans.named(CLIENT)
    assert first.parent is not None
    assert second.parent is not None
    assert first.parent.span_id == second.parent.span_id == at_client.context.span_id
    assert (facts(first)["goal.status"], facts(first)["feedback.count"]) == ("EXECUTING", 1)
    assert "runs the goal again" in facts(first)["goal.reason"]
    assert facts(second)["goal.status"] == "SUCCEEDED"
    assert spans.named("again").parent == second.context
    assert facts(at_client)["error.type"] == "GoalKept"


@asynchronous
async def test_a_goal_that_is_taken_over_does_not_belong_to_the_start_of_the_server(
    spans: Spans,
) -> None:
    options: Any = {"store": MemoryStore(), "at_stop": "keep"}
    async with ActionServer(FIBONACCI, waits, **options) as server:
        goal = await ActionClient(server, FIBONACCI).send_goal(Goal(4))
        await anext(goal.feedback)
    with spans.tracer.start_as_current_span("start"):
        async with reached(spans, fibonacci, **options) as client:
            await (await client.attach(goal.goal_id)).outcome()

    assert spans.path(SERVER) == [SERVER]


# What goes wrong with spans


class Broken(SpanProcessor):
    """A processor whose methods raise errors."""

    def __init__(self, *names: str) -> None:
        self._names = names

    def on_start(self, span: Span, parent_context: context.Context | None = None) -> None:
        if "on_start" in self._names:
            raise OSError("no memory")

    def on_end(self, span: ReadableSpan) -> None:
        if "on_end" in self._names:
            raise OSError("no memory")


@asynchronous
@pytest.mark.parametrize("name", ["on_start", "on_end"])
async def test_a_processor_that_fails_is_logged_once_for_each_end_and_goals_go_on(
    spans: Spans, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    spans.provider.add_span_processor(Broken(name))
    options: Any = {"store": MemoryStore(), "recovery": "rerun", "at_stop": "keep"}
    async with reached(spans, **options) as client:
        for _ in range(2):
            assert await client.call(Goal(3)) == Result([0, 1, 1, 2])
            with pytest.raises(GoalRejected):
                await client.call(Goal(101))
    async with reached(spans, waits, **options) as client:
        goal = await client.send_goal(Goal(1))
        await anext(goal.feedback)

    texts = [one.getMessage() for one in caplog.records if one.levelno >= logging.WARNING]
    assert sum("a span of a client failed, and goals continue" in text for text in texts) == 1
    assert sum("Tracing." in text for text in texts) == 2  # each server logs it once
    assert len(texts) == 3


@asynchronous
@pytest.mark.parametrize("provider", [None, TracerProvider(ALWAYS_OFF, shutdown_on_exit=False)])
async def test_goals_go_on_without_an_sdk_and_without_a_sample(
    provider: TracerProvider | None,
) -> None:
    tracing = Tracing(provider)
    async with ActionServer(FIBONACCI, fibonacci, watchers=[tracing]) as server:
        client = ActionClient(server, FIBONACCI, tracing=tracing)
        assert await client.call(Goal(3)) == Result([0, 1, 1, 2])


# Children


@asynchronous
async def test_the_spans_of_a_child_are_below_its_parent_and_name_it(spans: Spans) -> None:
    async def mission(goal: GoalHandle[Goal]) -> Items:
        yield await child.call(Goal(2), step=goal.step("count"))

    parents = Action("mission", goal=Goal, feedback=Feedback, result=Result)
    tracing = spans.tracing
    async with (
        reached(spans) as child,
        ActionServer(parents, mission, watchers=[tracing]) as server,
    ):
        sent = await ActionClient(server, parents, tracing=tracing).send_goal(Goal(1))
        await sent.result()

    assert spans.path(SERVER) == [
        "CLIENT: goal mission",
        "SERVER: goal mission",
        CLIENT,
        SERVER,
    ]
    for span in (spans.named(CLIENT), spans.named(SERVER)):
        assert facts(span)["parent.id"] == str(sent.goal_id)
        assert facts(span)["parent.step"] == "count"
    assert "parent.id" not in facts(spans.named("SERVER: goal mission"))


@asynchronous
async def test_a_child_of_a_client_without_spans_names_its_parent_at_its_server(
    spans: Spans,
) -> None:
    meta = {"parent": "07" * 16}
    async with ActionServer(FIBONACCI, fibonacci, watchers=[spans.tracing]) as server:
        stream = await server.send_goal(GoalID.random(), PAYLOAD, meta=meta)
        await stream.outcome()

    found = facts(spans.named(SERVER))
    assert (found["parent.id"], found["parent.step"]) == ("07" * 16, "")


def test_events_of_a_goal_that_has_no_span_are_left_out(spans: Spans) -> None:
    info = GoalInfo(GoalID.random(), 1, GoalStatus.EXECUTING)
    tracing = spans.tracing
    tracing.accepted("fibonacci", info, b"")
    tracing.changed("fibonacci", info)
    tracing.ended("fibonacci", info, Outcome(GoalStatus.SUCCEEDED, b""))
    tracing.left("fibonacci", info, "it is kept")
    tracing.rejected("fibonacci", info.goal_id, "too large")

    assert not spans.ended


def test_what_is_not_an_error_but_an_end_of_the_program_passes(
    spans: Spans, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(spans.tracing._tracer, "start_span", interrupt)
    with pytest.raises(KeyboardInterrupt):
        spans.tracing.sending("fibonacci", GoalID.random())
