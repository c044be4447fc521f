"""Names of the tools that a bridge has in addition to one for each action."""

from __future__ import annotations

SEND, STATUS, CANCEL = "send_goal", "goal_status", "cancel_goal"
