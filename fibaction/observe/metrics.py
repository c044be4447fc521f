"""`Metrics`: a watcher that counts for Prometheus what happens to goals.

It needs prometheus-client, which `pip install "fibaction[metrics]"` installs. No series is labelled
by goal or client, so their number depends on the number of actions only.

The text is in one of two formats: `wants_openmetrics` says which one a request asks for.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from time import monotonic
from typing import TYPE_CHECKING, Any

import anyio

from fibaction.border.abc import FeedbackItem, Meta
from fibaction.border.watchers import Watcher
from fibaction.wire.wire_server import CONNECTIONS
from fibaction.words.extras import NeedsExtra
from fibaction.words.goals import CancelAnswer, GoalID, GoalInfo, Outcome, Sender
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry, Counter
    from prometheus_client.core import Metric

__all__ = ["CONTENT_TYPE", "Metrics"]

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""The content type of the text format of Prometheus."""
OPENMETRICS_CONTENT_TYPE = "application/openmetrics-text; version=1.0.0; charset=utf-8"
"""The content type of OpenMetrics."""

_OPENMETRICS = "application/openmetrics-text"
_PLAIN = "text/plain"


def wants_openmetrics(accept: str) -> bool:
    """Return whether a request with this header asks for OpenMetrics.

    It does if it names that format, in version 1.0.0 or in any, and does not prefer plain text. A
    wildcard names no format.
    """
    weights = {_OPENMETRICS: 0.0, _PLAIN: 0.0}
    for one in accept.lower().split(","):
        kind, *parameters = (part.strip() for part in one.split(";"))
        given: dict[str, str] = {}
        for part in parameters:
            name, _, value = part.partition("=")
            given[name] = value
        is_other = kind == _OPENMETRICS and given.get("version", "1.0.0").strip('"') != "1.0.0"
        if kind in weights and not is_other:
            weights[kind] = max(weights[kind], _weight_of(given.get("q", "1")))
    return weights[_OPENMETRICS] > 0 and weights[_OPENMETRICS] >= weights[_PLAIN]


def _weight_of(text: str) -> float:
    """Return a weight between 0 and 1; 0 if the text is not one."""
    try:
        weight = float(text)
    except ValueError:
        return 0.0
    return weight if 0 <= weight <= 1 else 0.0


DURATIONS = (0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30, 60, 300, 900, 3600)
"""Bounds of the buckets for durations, in seconds."""
LAGS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 10)
"""Bounds of the buckets for the lag of the event loop, in seconds."""
BEAT = 0.25
"""Seconds between two measurements of the lag."""


class _ActiveGoal:
    """An active goal."""

    __slots__ = ("accepted_at", "is_waiting")

    def __init__(self, *, is_waiting: bool) -> None:
        self.accepted_at = monotonic()
        self.is_waiting = is_waiting


class _ConnectionErrors:
    """The source of the series of errors, which has as many kinds as have come."""

    def collect(self) -> Iterator[Metric]:
        """Yield the series, as prometheus-client asks for it."""
        from prometheus_client.core import CounterMetricFamily

        family = CounterMetricFamily(
            "fibaction_connection_errors", "Connections ended by an error.", labels=["kind"]
        )
        for kind, count in CONNECTIONS.errors.copy().items():
            family.add_metric([kind], count)
        yield family


def _add_connections(registry: CollectorRegistry) -> None:
    """Add the series of the connections of this process."""
    from prometheus_client import Gauge

    Gauge(
        "fibaction_connections", "Open connections of clients to this process.", registry=registry
    ).set_function(lambda: CONNECTIONS.open)
    registry.register(_ConnectionErrors())


class Metrics(Watcher):
    """The series of any number of servers of this process.

    For example:

        metrics = Metrics()
        async with serve(server, "tcp://127.0.0.1:7400", watchers=[metrics]):
            ...
            print(metrics.text().decode())
    """

    def __init__(self, registry: CollectorRegistry | None = None) -> None:
        """Add the series to a registry of prometheus-client, or to a new one.

        Raises:
            MissingExtra: prometheus-client is not installed.
            ValueError: The registry has such series already.
        """
        with NeedsExtra("Metrics", "fibaction[metrics]"):
            import prometheus_client as prometheus
        self.registry = prometheus.CollectorRegistry() if registry is None else registry
        """The registry that has the series."""
        into = self.registry
        counter = partial(prometheus.Counter, registry=into)
        gauge = partial(prometheus.Gauge, registry=into)
        histogram = partial(prometheus.Histogram, registry=into)
        by_action, by_status = ["action"], ["action", "status"]
        self._goals = counter("fibaction_goals", "Goals that ended or were rejected.", by_status)
        self._active = gauge(
            "fibaction_goals_active", "Accepted goals that have not ended.", by_action
        )
        self._waiting = gauge(
            "fibaction_goals_waiting", "Accepted goals whose executor has not begun.", by_action
        )
        self._durations = histogram(
            "fibaction_goal_duration_seconds", "Time from the acceptance of a goal to its end.",
            by_status, buckets=DURATIONS,
        )  # fmt: skip
        self._queued = histogram(
            "fibaction_goal_queue_seconds", "Time from the acceptance of a goal to its begin.",
            by_action, buckets=DURATIONS,
        )  # fmt: skip
        self._feedback = counter("fibaction_feedback", "Feedback messages of executors.", by_action)
        self._cancels = counter("fibaction_cancels", "Answers to cancels.", ["action", "answer"])
        self._taken = counter(
            "fibaction_goals_taken_over", "Goals of an earlier process, or of another server.",
            by_action,
        )  # fmt: skip
        self._left = counter(
            "fibaction_goals_left", "Accepted goals that a store keeps, or another server has.",
            by_action,
        )  # fmt: skip
        self._lag = histogram(
            "fibaction_event_loop_lag_seconds", "Delay of a task that was due.", buckets=LAGS
        )
        self._dropped = counter(
            "fibaction_feedback_dropped", "Feedback messages that followers have missed.", by_action
        )
        _add_connections(into)
        self._feedback_of: dict[str, Counter] = {}  # to look up a label takes longer than to count
        self._undecided: set[GoalID] = set()
        self._running: dict[GoalID, _ActiveGoal] = {}
        self.beat_at = monotonic()
        """Time of the last turn of the event loop that `run` has seen, by `time.monotonic`."""

    def text(self) -> bytes:
        """Return all series in the text format of Prometheus; `CONTENT_TYPE` is its type.

        Any thread may call it.
        """
        from prometheus_client import generate_latest

        return generate_latest(self.registry)

    def answer(self, accept: str = "") -> tuple[str, bytes]:
        """Return the content type and the text of all series, in the format that is asked for.

        `accept` is the header of the request: OpenMetrics if it names that, and otherwise the text
        format of Prometheus. Any thread may call it.
        """
        if not wants_openmetrics(accept):
            return CONTENT_TYPE, self.text()
        from prometheus_client.openmetrics import exposition

        untyped: Any = exposition
        text: bytes = untyped.generate_latest(self.registry)
        return OPENMETRICS_CONTENT_TYPE, text

    async def run(self) -> None:
        """Measure the lag of the event loop, until canceled."""
        while True:
            due = anyio.current_time() + BEAT
            await anyio.sleep(BEAT)
            self._lag.observe(max(0.0, anyio.current_time() - due))
            self.beat_at = monotonic()

    # As a watcher

    def offered(
        self, action: str, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> None:
        self._undecided.add(goal_id)

    def rejected(self, action: str, goal_id: GoalID, reason: str) -> None:
        self._undecided.discard(goal_id)
        self._goals.labels(action, "REJECTED").inc()

    def accepted(self, action: str, info: GoalInfo, goal: bytes) -> None:
        if info.goal_id in self._undecided:
            self._undecided.remove(info.goal_id)
        else:
            self._taken.labels(action).inc()
        self._active.labels(action).inc()
        is_waiting = info.status is GoalStatus.ACCEPTED
        self._running[info.goal_id] = _ActiveGoal(is_waiting=is_waiting)
        if is_waiting:
            self._waiting.labels(action).inc()

    def changed(self, action: str, info: GoalInfo) -> None:
        if info.status is not GoalStatus.EXECUTING:
            return
        goal = self._running[info.goal_id]
        goal.is_waiting = False
        self._waiting.labels(action).dec()
        self._queued.labels(action).observe(monotonic() - goal.accepted_at)

    def feedback(self, action: str, goal_id: GoalID, item: FeedbackItem) -> None:
        count = self._feedback_of.get(action)
        if count is None:
            count = self._feedback_of[action] = self._feedback.labels(action)
        count.inc()

    def missed(self, action: str, goal_id: GoalID, count: int) -> None:
        self._dropped.labels(action).inc(count)

    def canceled(self, action: str, goal_id: GoalID | None, answer: CancelAnswer) -> None:
        self._cancels.labels(action, answer.return_code.name).inc()

    def ended(self, action: str, info: GoalInfo, outcome: Outcome[bytes]) -> None:
        seconds = self._remove(action, info)
        status = outcome.status.name
        self._goals.labels(action, status).inc()
        self._durations.labels(action, status).observe(seconds)

    def left(self, action: str, info: GoalInfo, reason: str) -> None:
        self._remove(action, info)
        self._left.labels(action).inc()

    def _remove(self, action: str, info: GoalInfo) -> float:
        """Remove an active goal, and return the seconds since its acceptance."""
        goal = self._running.pop(info.goal_id)
        self._active.labels(action).dec()
        if goal.is_waiting:
            self._waiting.labels(action).dec()
        return monotonic() - goal.accepted_at
