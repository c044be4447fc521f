"""A program of roslibpy 2, as its users write it. It prints what its callbacks get, a line each."""

from __future__ import annotations

import json
import sys
import threading
from typing import Any

import roslibpy

url, transport, token = sys.argv[1:]
headers = {"Authorization": f"Bearer {token}"} if token else None
ros = roslibpy.Ros(url, headers=headers, transport=transport)
ros.run(timeout=20)

action = roslibpy.ActionClient(ros, "/fibonacci", "arduinobot_msgs/action/Fibonacci")


def send(goal: dict[str, Any], cancel_after: int = 0) -> dict[str, Any]:
    ended, enough = threading.Event(), threading.Event()
    told: dict[str, Any] = {"feedback": []}

    def on_result(result: Any) -> None:
        told["result"] = [result["status"].name, result["values"]]
        ended.set()

    def on_feedback(feedback: Any) -> None:
        told["feedback"].append(dict(feedback))
        if len(told["feedback"]) == cancel_after:
            enough.set()

    def on_error(error: Any) -> None:
        told["error"] = [error["status"].name, error["values"]]
        ended.set()

    goal_id = action.send_goal(roslibpy.Goal(goal), on_result, on_feedback, on_error)
    if cancel_after:
        assert enough.wait(20)
        action.cancel_goal(goal_id)
    assert ended.wait(20)
    return told


def call(name: str, request: dict[str, Any]) -> Any:
    service = roslibpy.Service(ros, name, "any")
    try:
        return dict(service.call(roslibpy.ServiceRequest(request), timeout=20))
    except Exception as exc:
        return {"error": str(exc)}


def show(value: Any) -> None:
    print(json.dumps(value), flush=True)


show(send({"order": 3}))
show(send({"order": -1}))
show(send({"order": 6}))
show(send({"order": 7}))
show(send({"order": 50}, 2))
show(send({"order": "x"}))
show(send({"order": float("nan")}))
show(call("/rosapi/action_servers", {}))
show(call("/rosapi/action_type", {"action": "/fibonacci"}))
show(call("/add_two_ints", {"a": 1, "b": 2}))
ros.terminate()
