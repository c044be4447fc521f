"""`Tracing`: spans of goals for OpenTelemetry, at clients and at servers.

It needs opentelemetry-api, which `pip install "fibaction[otel]"` installs. The SDK, and where the
spans go, are the program's own choice.

Theory of operation
-------------------

A client makes a span for each goal that it sends, and puts the context of that span into the meta
of the goal. Gateways forward the meta. The server makes a span of its own from it, and sets it as
the current one in the context of the goal's executor (`Watcher.offered`), in which each step of the
executor runs. So the executor's own spans are children of it, and a span may be held across a
`yield`. The context is dropped with the goal, and nothing has to be detached.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fibaction._runtime.log import clean_logger
from fibaction._runtime.text import shortened
from fibaction.border.abc import GoalStream, Meta
from fibaction.border.watchers import NO_SPAN, GoalSpan, Watcher
from fibaction.words.errors import ActionError, GoalRejected, GoalTimeout, text_of
from fibaction.words.extras import NeedsExtra
from fibaction.words.goals import GoalID, GoalInfo, Outcome, Parent, Sender
from fibaction.words.meta import DETACHED, fitting, parent_in
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from opentelemetry.context import Context
    from opentelemetry.trace import Span, TracerProvider

__all__ = ["Tracing"]

ACTION = "fibaction.action"
GOAL_ID = "fibaction.goal.id"
STATUS = "fibaction.goal.status"
REASON_KEY = "fibaction.goal.reason"
ATTEMPT = "fibaction.goal.attempt"
SENDER = "fibaction.sender"
PARENT_ID = "fibaction.parent.id"
STEP = "fibaction.parent.step"
FEEDBACK = "fibaction.feedback.count"
ERROR_TYPE = "error.type"

REJECTED = "REJECTED"
"""The status of a goal that was not accepted."""

logger = clean_logger("fibaction.otel")


class Tracing(Watcher):
    """The source of spans for goals: a watcher of servers, and an argument of `connect`.

    One object serves any number of servers and clients. An error in it, or in a processor of spans,
    changes nothing for goals; the first one is logged.

    For example:

        tracing = Tracing()
        async with serve(server, "tcp://127.0.0.1:7400", watchers=[tracing]):
            ...
        async with connect("tcp://127.0.0.1:7400", DRIVE, tracing=tracing) as client:
            ...
    """

    def __init__(self, tracer_provider: TracerProvider | None = None) -> None:
        """Make spans by this provider, or by the global one.

        Raises:
            MissingExtra: opentelemetry-api is not installed.
        """
        with NeedsExtra("Tracing", "fibaction[otel]"):
            from opentelemetry import context, propagate, trace
        self._context, self._propagate, self._trace = context, propagate, trace
        self._tracer = trace.get_tracer("fibaction", tracer_provider=tracer_provider)
        self._spans: dict[tuple[str, GoalID], Span] = {}
        self._harmless = _Harmless()

    # At a client

    def sending(self, action: str, goal_id: GoalID, parent: Parent | None = None) -> GoalSpan:
        """Return the span of a goal that is about to be sent, perhaps by the executor of a parent.
        `ActionClient` calls this.
        """
        with self._harmless:
            trace = self._trace
            span = self._tracer.start_span(
                f"goal {action}",
                kind=trace.SpanKind.CLIENT,
                attributes=_names(action, goal_id, parent),
            )
            meta: dict[str, str] = {}
            self._propagate.inject(meta, trace.set_span_in_context(span))
            return _ClientSpan(span, fitting(meta), self._harmless)
        return NO_SPAN

    # At a server

    def offered(
        self, action: str, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> None:
        # Without a trace in the meta, it is that of the caller, such as a request of HTTP.
        parent = self._propagate.extract(meta, self._context.get_current())
        self._begin(action, goal_id, sender, meta, parent)

    def taken_over(
        self, action: str, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> None:
        nothing = self._context.Context()  # the current one is that of the server's start
        self._begin(action, goal_id, sender, meta, self._propagate.extract(meta, nothing))

    def _begin(
        self, action: str, goal_id: GoalID, sender: Sender, meta: Meta, parent: Context
    ) -> None:
        trace = self._trace
        attributes = _names(action, goal_id, parent_in(meta))
        if text := str(sender):
            attributes[SENDER] = text
        links: list[Any] = []
        if DETACHED in meta:
            # Its client does not wait for it, so the goal may last much longer than the trace.
            sender_span = trace.get_current_span(parent).get_span_context()
            links = [trace.Link(sender_span)] if sender_span.is_valid else []
            parent = trace.set_span_in_context(trace.INVALID_SPAN, parent)
        kind = trace.SpanKind.SERVER
        span = self._tracer.start_span(f"goal {action}", parent, kind, attributes, links)
        self._context.attach(trace.set_span_in_context(span, parent))
        self._spans[action, goal_id] = span

    def rejected(self, action: str, goal_id: GoalID, reason: str) -> None:
        _end(self._ending(action, goal_id), REJECTED, reason, error="GoalRejected")

    def accepted(self, action: str, info: GoalInfo, goal: bytes) -> None:
        span = self._spans.get((action, info.goal_id)) or self._trace.INVALID_SPAN
        span.set_attribute(ATTEMPT, info.attempt)
        span.add_event(GoalStatus.ACCEPTED.name)

    def changed(self, action: str, info: GoalInfo) -> None:
        span = self._spans.get((action, info.goal_id)) or self._trace.INVALID_SPAN
        span.add_event(info.status.name)

    def ended(self, action: str, info: GoalInfo, outcome: Outcome[bytes]) -> None:
        span = self._ending(action, info.goal_id)
        span.set_attribute(FEEDBACK, info.feedback_count)
        _end(span, outcome.status.name, outcome.reason, error=_error_of(outcome))

    def left(self, action: str, info: GoalInfo, reason: str) -> None:
        span = self._ending(action, info.goal_id)
        span.set_attribute(FEEDBACK, info.feedback_count)
        _end(span, info.status.name, reason)

    def _ending(self, action: str, goal_id: GoalID) -> Span:
        """Return the span of a goal that ends; one that does nothing if the goal has none."""
        return self._spans.pop((action, goal_id), self._trace.INVALID_SPAN)


def _names(action: str, goal_id: GoalID, parent: Parent | None) -> dict[str, str]:
    """Return the attributes that name a goal, and the parent whose step it is."""
    attributes = {ACTION: action, GOAL_ID: str(goal_id)}
    if parent is not None:
        attributes |= {PARENT_ID: str(parent.goal_id), STEP: parent.step}
    return attributes


def _error_of(outcome: Outcome[Any]) -> str:
    """Return the class of the error that an outcome is for a client; empty if it is not one."""
    return "GoalAborted" if outcome.status is GoalStatus.ABORTED else ""


def _end(span: Span, status: str, reason: str = "", *, error: str = "") -> None:
    """End a span with the status of its goal, and with the class of the error if it is one."""
    from opentelemetry.trace import StatusCode

    if status:
        span.set_attribute(STATUS, status)
    if reason:
        span.set_attribute(REASON_KEY, shortened(reason))
    if error:
        span.set_attribute(ERROR_TYPE, error)
        span.set_status(StatusCode.ERROR, shortened(reason))
    span.end()


class _ClientSpan(GoalSpan):
    """The span of one goal at its client, which ends once."""

    def __init__(self, span: Span, meta: dict[str, str], harmless: _Harmless) -> None:
        self.meta = meta
        self._harmless = harmless
        self._span: Span | None = span

    def accepted(self, stream: GoalStream) -> None:
        if self._span is not None:
            with self._harmless:
                self._span.add_event(GoalStatus.ACCEPTED.name)

    def failed(self, error: BaseException) -> None:
        if not isinstance(error, Exception):
            self._end("")  # the task was canceled, which is not an error
            return
        status, reason = "", text_of(error)
        if isinstance(error, GoalRejected):
            status, reason = REJECTED, error.reason
        elif isinstance(error, ActionError):
            reason = str(error)
        self._end(status, reason, error=type(error).__name__)

    def ended(self, outcome: Outcome[Any]) -> None:
        self._end(outcome.status.name, outcome.reason, error=_error_of(outcome))

    def left(self, stream: GoalStream, error: BaseException | None = None) -> None:
        if self._span is None:
            return
        if isinstance(error, GoalTimeout) and error.goal_id == stream.goal_id:
            self.failed(error)  # the outcome, if it is known by now, is that of the cancel
            return
        outcome = None
        try:
            outcome = stream.known_outcome()
        except ActionError as exc:
            error = exc
        if outcome is not None:
            self.ended(outcome)
        elif isinstance(error, ActionError):
            self.failed(error)
        else:
            self._end(stream.status.name)

    def _end(self, status: str, reason: str = "", *, error: str = "") -> None:
        span, self._span = self._span, None
        if span is not None:
            with self._harmless:
                _end(span, status, reason, error=error)


class _Harmless:
    """A block whose errors are logged, the first of them, and dropped."""

    def __init__(self) -> None:
        self._has_failed = False

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, exc: BaseException | None, traceback: object) -> bool:
        if not isinstance(exc, Exception):
            return False
        if not self._has_failed:
            self._has_failed = True
            logger.error(
                "a span of a client failed, and goals continue; later errors are not logged: %s",
                text_of(exc),
                exc_info=exc,
            )
        return True
