"""`LogKeeper`: the newest log records of each goal, for operators who ask for them."""

from __future__ import annotations

import logging
from collections import OrderedDict, deque
from collections.abc import Generator
from contextlib import contextmanager

from fibaction._runtime.log import traceback_text
from fibaction._runtime.text import sendable, shortened
from fibaction.border.abc import LogLine
from fibaction.words.goals import GoalID, current_goal

MOST_GOALS = 1000
"""Goals whose lines are kept; those of which nothing was logged for the longest time leave."""
MOST_LETTERS = 2_000_000
"""Characters of all lines, each of which has at most `REASON`; with more, the lines of goals leave
in the same order."""
MOST_LINES = 100_000
"""Lines of all goals, each of which takes memory of its own; with more, the same."""
MESSAGE, TRACEBACK = 400, 600
"""Characters of a message that is kept before a traceback, and of the end of that."""


class LogKeeper(logging.Handler):
    """Keeps the records that are logged inside executors of one action, in any thread to which the
    context of the executor comes. It gets the records that the levels of loggers let pass.
    """

    def __init__(self, action: str, most: int) -> None:
        """Keep so many lines of each goal; 0 to keep none."""
        super().__init__()
        self._action = action
        self._most = most
        self._lines: OrderedDict[GoalID, deque[LogLine]] = OrderedDict()
        self._letters = 0
        self._count = 0

    @contextmanager
    def open(self) -> Generator[None, None, None]:
        """Get the records of all loggers for as long as the block lasts."""
        root = logging.getLogger()
        if self._most:
            root.addHandler(self)
        try:
            yield
        finally:
            root.removeHandler(self)
            self.close()

    def of(self, goal_id: GoalID) -> list[LogLine] | None:
        """Return the newest lines of a goal, the oldest first; None if none are kept of any."""
        if not self._most:
            return None
        self.acquire()
        try:
            return list(self._lines.get(goal_id, ()))
        finally:
            self.release()

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record, if an executor of the action has logged it; called with the lock."""
        last = logging.lastResort
        if last is not None and record.levelno >= last.level and self._is_only_handler(record):
            last.handle(record)
        goal = current_goal.get()
        if goal is None or goal.action != self._action:
            return
        try:
            text = record.getMessage()
        except Exception:  # its arguments do not fit, as `logging` tells
            self.handleError(record)
            return
        if record.exc_info and record.exc_info[1] is not None:
            traceback = traceback_text(record.exc_info[1])  # whose end says the most
            text = f"{shortened(text, MESSAGE)}\n{traceback[-TRACEBACK:]}"
        at = int(record.created * 1e9)
        line = LogLine(at, record.levelname, sendable(record.name), sendable(text))
        lines = self._lines.setdefault(goal.goal_id, deque())
        self._lines.move_to_end(goal.goal_id)
        lines.append(line)
        self._letters += len(line.text)
        self._count += 1
        if len(lines) > self._most:
            self._forget(lines.popleft())
        while (
            len(self._lines) > MOST_GOALS
            or self._letters > MOST_LETTERS
            or self._count > MOST_LINES
        ):
            _, gone = self._lines.popitem(last=False)
            self._forget(*gone)

    def _forget(self, *gone: LogLine) -> None:
        self._letters -= sum(len(one.text) for one in gone)
        self._count -= len(gone)

    def _is_only_handler(self, record: logging.LogRecord) -> bool:
        """Return whether nothing else handles a record. `logging` itself would write it to stderr
        then, if the root logger did not have this handler.
        """
        root = logging.getLogger()
        if root.handlers[:1] != [self] or not all(
            isinstance(one, LogKeeper) for one in root.handlers
        ):
            return False
        logger: logging.Logger | None = logging.getLogger(record.name)
        while logger is not None and logger is not root:
            if logger.handlers:
                return False
            logger = logger.parent
        return True
