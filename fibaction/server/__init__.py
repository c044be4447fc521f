"""The action server: `ActionServer`, and its parts.

`server` has start and stop, and the methods that clients call; `settings` the settings; `parts`
makes the parts. `admission` decides on goals, and `cancels` on cancels. `registry` holds every goal
and its rules, and `life` the table of a goal's phases. `scheduling` says which goal runs, waits or
gives way; `execution` runs executors; `durability` writes to a store and takes over what it has.
`goal_logs` tells followers and has the streams that they read, `log_keeper` keeps log records of
executors; `watchers` call the watchers of a user, which `fibaction.border.watchers` defines.
`functions` makes executors of plain functions.
"""

from fibaction.server.execution.executor import Executor
from fibaction.server.functions.decorator import action
from fibaction.server.functions.function_action import FunctionAction, actions_of
from fibaction.server.functions.report import Report
from fibaction.server.goal_handle import GoalHandle
from fibaction.server.scheduling.schedule import Schedule
from fibaction.server.server import ActionServer

__all__ = [
    "ActionServer",
    "Executor",
    "FunctionAction",
    "GoalHandle",
    "Report",
    "Schedule",
    "action",
    "actions_of",
]
