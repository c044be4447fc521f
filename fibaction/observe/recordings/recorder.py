"""Recorders: `Recorder` watches a server and writes a file, and `record_from` follows one for it.

Theory of operation
-------------------

The server's event loop only puts records into a queue. A thread takes them out every FLUSH seconds,
makes JSON of them and writes them, so a slow disk delays no goal. The queue is bounded in bytes: if
the disk is slower than the executors for long, feedback is dropped, which is counted, logged once
and written to the recording. Goals, statuses and ends are never dropped.

The number of bytes in the queue is the difference of two numbers. Each is changed by one thread
only, so no lock is needed.

`record_from` records from outside, as a client. Each goal is followed as an observer, for which no
executor waits. What an observer is not told is missing in the recording: rejected goals, answers to
cancels, the goal itself of one that has ended at once or that ROS 2 carries, and feedback that came
faster than it was read, which is counted. A `Recorder` inside the server misses nothing of that.
"""

from __future__ import annotations

import base64
import threading
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self, TypeAlias, cast

import anyio
import msgspec
from anyio.abc import TaskGroup

from fibaction._api import ClientConnection
from fibaction._runtime.log import clean_logger
from fibaction.border.abc import Endpoint, FeedbackItem, Meta
from fibaction.border.event_loop import Background
from fibaction.border.watchers import Watcher
from fibaction.observe.action_listener import actions_after_pause
from fibaction.observe.recordings.recording_file import Record
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ActionError, UnknownGoal
from fibaction.words.goals import CancelAnswer, GoalID, GoalInfo, Outcome, Parent, Sender
from fibaction.words.meta import parent_in

__all__ = ["Recorder", "record_from"]

FLUSH = 0.05
"""Seconds for which records wait in memory at most; a kill of the process loses as much."""
MAX_WAITING_BYTES = 64 * 2**20
"""Bytes of feedback that may wait for the disk."""
OVERHEAD = 500
"""Bytes that a record takes in addition to its payload."""
BATCH = 1000
"""Records of one write."""

_Feedback: TypeAlias = tuple[str, GoalID, FeedbackItem]
"""A feedback message with its action and its goal; the thread makes the record, because there are
many."""

logger = clean_logger("fibaction.recorder")


class Recorder(Watcher):
    """A recording of any number of servers, of one event loop.

    For example:

        with Recorder("today.jsonl") as recorder:
            async with serve(server, "tcp://127.0.0.1:7400", watchers=[recorder]):
                ...

    The file is appended to. If it cannot be written to any longer, for example because the disk is
    full, the log says so once, and goals continue.
    """

    def __init__(self, path: str | Path, *, max_bytes: int = MAX_WAITING_BYTES) -> None:
        """Open the file. At most `max_bytes` bytes of feedback wait in memory to be written.

        Raises:
            OSError: The file cannot be written to.
        """
        self.path = Path(path)
        self.dropped = 0
        """The number of feedback messages that are not in the recording."""
        self.error: OSError | None = None
        """The error that has ended the recording; None if none has."""
        self._max_bytes = max_bytes
        self._file = _opened(self.path)
        self._queue: deque[Record | _Feedback] = deque()
        self._put = self._taken = 0
        self._dropped_before = 0
        self._is_slow = False
        self._undecided: dict[GoalID, tuple[bytes, str, Parent | None]] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._write_all, name="recorder", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Write what is left, and close the file. Closing twice does nothing.

        It waits for the disk, so call it when the servers have stopped.
        """
        self._stop.set()
        self._thread.join()

    # As a watcher

    def opened(self, info: ActionInfo) -> None:
        self._add(Record(time.time_ns(), "server", info.name, info=info))

    def offered(
        self, action: str, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> None:
        self._undecided[goal_id] = (goal, str(sender), parent_in(meta))

    def rejected(self, action: str, goal_id: GoalID, reason: str) -> None:
        goal, client, parent = self._undecided.pop(goal_id)
        facts: dict[str, Any] = {"reason": reason, "client": client, "data": goal}
        text, named = str(goal_id), _named(parent)
        self._add(Record(time.time_ns(), "rejected", action, text, **facts, **named))

    def accepted(self, action: str, info: GoalInfo, goal: bytes) -> None:
        self._undecided.pop(info.goal_id, None)
        facts = {"data": goal, **_named(info.parent)}
        self._add(_record("accepted", action, info, info.stamp, **facts))

    def changed(self, action: str, info: GoalInfo) -> None:
        self._add(_record("status", action, info))

    def feedback(self, action: str, goal_id: GoalID, item: FeedbackItem) -> None:
        if self._put - self._taken > self._max_bytes:
            if not self._is_slow:
                self._is_slow = True
                logger.warning(
                    "%s is written too slowly, and some feedback is left out of the recording",
                    self.path,
                )
            self.dropped += 1
            return
        if self.error is None:
            self._put += OVERHEAD + len(item.payload)
            self._queue.append((action, goal_id, item))

    def canceled(self, action: str, goal_id: GoalID | None, answer: CancelAnswer) -> None:
        text = "" if goal_id is None else str(goal_id)
        status, reason = answer.return_code.name, answer.reason
        self._add(Record(time.time_ns(), "cancel", action, text, status=status, reason=reason))

    def ended(self, action: str, info: GoalInfo, outcome: Outcome[bytes]) -> None:
        result = msgspec.UNSET if outcome.result is None else outcome.result
        self._add(
            _record("end", action, info, outcome.ended_at, reason=outcome.reason, data=result)
        )

    def left(self, action: str, info: GoalInfo, reason: str) -> None:
        self._add(_record("left", action, info, reason=reason))

    def add_dropped(self, count: int) -> None:
        """Note in the recording that feedback is missing which has not reached the recorder."""
        self.dropped += count

    def _add(self, record: Record) -> None:
        if self.error is None:
            self._put += _size_of(record)
            self._queue.append(record)

    # In the thread

    def _write_all(self) -> None:
        encoder = msgspec.json.Encoder(enc_hook=_without_extension)
        with self._file:
            while not self._stop.wait(FLUSH):
                self._write_queue(encoder)
            self._write_queue(encoder)

    def _write_queue(self, encoder: msgspec.json.Encoder) -> None:
        queue = self._queue
        while (queue or self.dropped > self._dropped_before) and self.error is None:
            records = [queue.popleft() for _ in range(min(BATCH, len(queue)))]
            if self.dropped > self._dropped_before:
                left_out = self.dropped - self._dropped_before
                self._dropped_before += left_out
                records.append(Record(time.time_ns(), "dropped", "", number=left_out))
            size = sum(map(_size_of, records))
            try:
                self._write(b"".join([_line(encoder, record) for record in records]))
            except OSError as exc:
                self.error = exc
                queue.clear()
                logger.error(
                    "the recording %s ends here, and goals continue: it cannot be written to: %s",
                    self.path,
                    exc.strerror,
                )
            self._taken += size

    def _write(self, lines: bytes) -> None:
        """Write all of it: a disk that is almost full may take a part first."""
        rest = memoryview(lines)
        while rest:
            rest = rest[self._file.write(rest) :]


def _opened(path: Path) -> BinaryIO:
    """Open a recording to append to it, after a line that a kill may have cut off."""
    file = open(path, "a+b", buffering=0)  # noqa: SIM115  # the thread closes it
    if file.tell():
        file.seek(-1, 2)
        if file.read(1) != b"\n":
            file.write(b"\n")
    return cast("BinaryIO", file)


def _named(parent: Parent | None) -> dict[str, Any]:
    """Return the fields of a record that name the parent of a goal and its step."""
    return {} if parent is None else {"parent": str(parent.goal_id), "step": parent.step}


def _record(event: Any, action: str, info: GoalInfo, at: int | None = None, **more: Any) -> Record:
    """Return a record of an event of a goal, which has happened at that time, or now."""
    goal_id, status = str(info.goal_id), info.status.name
    at, attempt, client = at or time.time_ns(), info.attempt, info.client
    return Record(at, event, action, goal_id, status, attempt=attempt, client=client, **more)


def _size_of(record: Record | _Feedback) -> int:
    payload = record[2].payload if isinstance(record, tuple) else record.data
    return OVERHEAD + (len(payload) if isinstance(payload, bytes) else 0)


def _line(encoder: msgspec.json.Encoder, record: Record | _Feedback) -> bytes:
    """Return the line of a record, whose payload becomes JSON data."""
    if isinstance(record, tuple):
        action, goal_id, item = record
        number, attempt, payload = item.number, item.attempt, item.payload
        record = Record(
            *(item.at, "feedback", action, goal_id.hex()),
            number=number,
            attempt=attempt,
            data=payload,
        )
    payload = record.data
    if isinstance(payload, bytes):
        try:
            record.data = msgspec.msgpack.decode(payload)
            return encoder.encode(record) + b"\n"
        except (msgspec.MsgspecError, UnicodeError, RecursionError, TypeError, ValueError):
            record.data, record.raw = msgspec.UNSET, payload
    return encoder.encode(record) + b"\n"


def _without_extension(value: Any) -> Any:
    if isinstance(value, msgspec.msgpack.Ext):
        return {"ext": value.code, "data": base64.b64encode(value.data).decode()}
    raise TypeError(f"JSON has no {type(value).__name__}")


RETRY_PAUSE = 1.0
"""Seconds before an action whose server has stopped is followed again."""
MOST_FOLLOWED = 1000
"""Goals that are followed at the same time; others wait for their turn."""
REMEMBERED = 10_000
"""Goals that are known to be followed: as many as a server keeps."""


async def record_from(connection: ClientConnection, recorder: Recorder) -> None:
    """Record the active and the new goals of all actions of a server, until canceled.

    Restarts of the server and new actions are waited for. For example:

        with Recorder("today.jsonl") as recorder:
            async with connect("tcp://127.0.0.1:7400") as connection:
                await record_from(connection, recorder)

    Raises:
        ActionError: The server is not found.
        OSError: The file cannot be written to any longer.
    """
    actions: list[ActionInfo] | None = await connection.actions()
    known: set[str] = set()
    async with Background() as tasks:
        observer = _Observer(connection, recorder, tasks)
        while recorder.error is None:
            for info in actions or ():
                if info.name not in known:
                    known.add(info.name)
                    tasks.start_soon(observer.record_action, info)
            actions, _ = await actions_after_pause(connection)
        raise recorder.error


class _Observer:
    """The tasks that follow actions and goals, and record what they are told."""

    def __init__(self, connection: ClientConnection, recorder: Recorder, tasks: TaskGroup) -> None:
        self._connection = connection
        self._recorder = recorder
        self._tasks = tasks
        self._room = anyio.CapacityLimiter(MOST_FOLLOWED)
        self._seen: dict[GoalID, None] = {}

    async def record_action(self, info: ActionInfo) -> None:
        """Record the goals of an action, even after restarts of its server, until canceled."""
        try:
            endpoint = self._connection.endpoint(info)
        except ActionError:  # its ROS type is not installed here
            return
        while True:
            with suppress(ActionError):
                await self._record_goals(endpoint)
            await anyio.sleep(RETRY_PAUSE)  # limits how often a permanent error is met
            await endpoint.wait_for_server()

    async def _record_goals(self, endpoint: Endpoint) -> None:
        with await endpoint.status() as statuses:
            self._recorder.opened(endpoint.info)
            known = statuses.known
            while (goal := await statuses.receive()) is not None:
                known -= 1
                has_ended = not goal.status.is_active
                if goal.goal_id not in self._seen and not (has_ended and known >= 0):
                    self._remember(goal.goal_id)
                    self._tasks.start_soon(self._record_goal, endpoint, goal)

    def _remember(self, goal_id: GoalID) -> None:
        self._seen[goal_id] = None
        if len(self._seen) > REMEMBERED:
            del self._seen[next(iter(self._seen))]

    async def _record_goal(self, endpoint: Endpoint, goal: GoalInfo) -> None:
        action, recorder = endpoint.info.name, self._recorder
        async with self._room:
            try:
                with await endpoint.feedback(goal.goal_id, after=0) as stream:
                    recorder.accepted(action, goal, stream.goal or b"")
                    async for update in stream:
                        if isinstance(update, FeedbackItem):
                            recorder.feedback(action, goal.goal_id, update)
                        elif isinstance(update, Outcome):
                            ended = msgspec.structs.replace(goal, status=update.status)
                            recorder.ended(action, ended, update)
                        else:
                            goal = msgspec.structs.replace(goal, status=update)
                            recorder.changed(action, goal)
                    recorder.add_dropped(stream.dropped)
            except UnknownGoal:
                pass  # it has ended and was forgotten in the meantime
            except ActionError as exc:
                recorder.left(action, goal, str(exc))
