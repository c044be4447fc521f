"""The shortest program of roslibpy 2: one goal, and its result."""

from __future__ import annotations

import sys

import roslibpy

ros = roslibpy.Ros(sys.argv[1], transport="asyncio")
ros.run(timeout=20)
action = roslibpy.ActionClient(ros, "/fibonacci", "arduinobot_msgs/action/Fibonacci")
results: list[object] = []
goal_id = action.send_goal(
    roslibpy.Goal({"order": 0}), lambda result: results.append(result["values"]), print, print
)
action.wait_goal(goal_id, timeout=20)
print(results[0])
ros.terminate()
