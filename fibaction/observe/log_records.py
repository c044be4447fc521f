"""Log records with the goal that they belong to: `GoalFilter`, and `JsonFormatter`."""

from __future__ import annotations

import datetime
import json
import logging

from fibaction._runtime.log import traceback_text
from fibaction.words.goals import current_goal

__all__ = ["GoalFilter", "JsonFormatter"]


class GoalFilter(logging.Filter):
    """Adds `goal_id` and `action` to each record that is logged inside an executor, by the
    executor itself or by any function that it calls; elsewhere both are empty text.

    Add it to a handler, so that it sees the records of all loggers:

        handler = logging.StreamHandler()
        handler.addFilter(GoalFilter())
        handler.setFormatter(logging.Formatter("%(goal_id).8s %(action)s %(message)s"))
    """

    def filter(self, record: logging.LogRecord) -> bool:
        """Add the goal to a record; return True, since every record passes."""
        goal = current_goal.get()
        record.goal_id = "" if goal is None else str(goal.goal_id)
        record.action = "" if goal is None else goal.action
        return True


class JsonFormatter(logging.Formatter):
    """Writes each record as a JSON object on one line, for collectors of logs.

    The fields are `time` (UTC), `level`, `logger`, `message`, and where they apply `goal_id` and
    `action` (see `GoalFilter`) and `traceback`. The text is ASCII, so that nothing of a peer's text
    can change the terminal.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as one line of JSON."""
        at = datetime.datetime.fromtimestamp(record.created, datetime.UTC)
        fields = {
            "time": at.isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
        }
        for name in ("goal_id", "action"):
            if value := getattr(record, name, ""):
                fields[name] = str(value)
        if record.exc_info and record.exc_info[1] is not None:
            fields["traceback"] = traceback_text(record.exc_info[1])
        return json.dumps(fields)
