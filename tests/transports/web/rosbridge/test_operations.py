"""`fibaction_transports.web.rosbridge.operations`: messages of clients."""

from __future__ import annotations

import json
from typing import Any

from fibaction_transports.web.rosbridge.operations import Ignored, SendActionGoal, Wrong, read


def message(**more: Any) -> str:
    """Return a goal whose numbers msgspec would read slowly."""
    goal = {"op": "send_action_goal", "action": "move", "args": {"path": [1e308] * 200}}
    return json.dumps(goal | more)


def test_a_message_with_numbers_that_take_long_is_read_as_any_other() -> None:
    sent = read(message(feedback=True))
    assert isinstance(sent, SendActionGoal)
    assert (sent.action, sent.feedback, sent.args) == ("move", True, {"path": [1e308] * 200})
    wrong = read(message(feedback="x"))
    assert isinstance(wrong, Wrong)
    assert (wrong.op, wrong.name) == ("send_action_goal", "move")
    assert isinstance(read(message(op="dance")), Ignored)
