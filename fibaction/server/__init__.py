"""The action server: `ActionServer`, and its parts.

`server` has the settings, start and stop, and the methods that clients call; `admission` decides on
goals and cancels; `runs` starts and ends executors; `registry` holds every goal and its rules.
"""

from fibaction.server.execution.executor import Executor
from fibaction.server.goal_handle import GoalHandle
from fibaction.server.scheduling.schedule import Schedule
from fibaction.server.server import ActionServer

__all__ = ["ActionServer", "Executor", "GoalHandle", "Schedule"]
