"""One trace from the code that sends a goal to the spans that its executor makes."""

from __future__ import annotations

from collections.abc import AsyncGenerator

import anyio
import pytest

from fibaction import ActionServer, GoalHandle, GoalStatus, connect
from fibaction.testing.contract.reach import Reach
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.support.spans import Spans

pytestmark = pytest.mark.anyio


class Traced:
    """An executor that holds a span across each `yield`, and makes another one at its end."""

    def __init__(self, spans: Spans) -> None:
        self._tracer = spans.tracer

    async def __call__(self, goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        try:
            with self._tracer.start_as_current_span("work"):
                for number in range(goal.request.order):
                    with self._tracer.start_as_current_span(f"step {number}"):
                        yield Feedback([number])
                        await anyio.lowlevel.checkpoint()
        finally:
            self._tracer.start_span("clean up").end()
        yield Result([])


@pytest.mark.promise("EXECUTE-13")
async def test_a_trace_leads_from_the_client_to_the_spans_of_the_executor(reach: Reach) -> None:
    spans = Spans()
    server = ActionServer(FIBONACCI, Traced(spans), watchers=[spans.tracing])
    async with reach.url(server) as url, connect(url, FIBONACCI, tracing=spans.tracing) as client:
        with spans.tracer.start_as_current_span("mission"):
            await client.call(Goal(1))

    goal = ["mission", "CLIENT: goal fibonacci", "SERVER: goal fibonacci"]
    assert spans.path("step 0") == [*goal, "work", "step 0"]
    assert spans.path("clean up") == [*goal, "clean up"]


@pytest.mark.promise("EXECUTE-13")
async def test_spans_that_are_held_across_a_yield_are_closed_in_their_context(
    reach: Reach, caplog: pytest.LogCaptureFixture
) -> None:
    spans = Spans()
    server = ActionServer(FIBONACCI, Traced(spans), watchers=[spans.tracing])
    async with reach.url(server) as url, connect(url, FIBONACCI, tracing=spans.tracing) as client:
        async with client.send_goal(Goal(1000000)) as goal:
            await anext(goal.feedback)
            await goal.cancel()
            assert (await goal.outcome()).status is GoalStatus.CANCELED
        async with client.send_goal(Goal(1000000)) as goal:
            await anext(goal.feedback)  # the end of the block cancels it
        ended = await client.attach(goal.goal_id)
        await ended.outcome()

    works = [span for span in spans.ended if span.name == "work"]
    servers = [span for span in spans.ended if span.kind.name == "SERVER"]
    assert len(works) == 2
    assert [span.parent and span.parent.span_id for span in works] == [
        span.context.span_id for span in servers
    ]
    assert not [record for record in caplog.records if record.name.startswith("opentelemetry")]
