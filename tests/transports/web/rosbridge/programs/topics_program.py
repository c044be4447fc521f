"""A program of roslibpy 2 that watches the goals of another client by topics."""

from __future__ import annotations

import json
import sys
import threading
from typing import Any

import roslibpy

url, transport = sys.argv[1:]
watcher = roslibpy.Ros(url, transport=transport)
watcher.run(timeout=20)
topics = sorted(watcher.get_topics())
types = [watcher.get_topic_type(topic) for topic in topics]
begun, told, succeeded = threading.Event(), threading.Event(), threading.Event()
heard: list[Any] = []


def on_status(message: Any) -> None:
    begun.set()
    if [one["status"] for one in message["status_list"]] == [4]:
        succeeded.set()


def on_feedback(message: Any) -> None:
    heard.append(message["feedback"])
    if len(heard) == 2:
        told.set()


status = roslibpy.Topic(watcher, topics[1], types[1], throttle_rate=10)
feedback = roslibpy.Topic(watcher, topics[0], types[0], queue_length=10)
feedback.subscribe(on_feedback)
status.subscribe(on_status)
assert begun.wait(20)
sender = roslibpy.Ros(url, transport=transport)
sender.run(timeout=20)
action = roslibpy.ActionClient(sender, "/fibonacci", "arduinobot_msgs/action/Fibonacci")
action.send_goal(roslibpy.Goal({"order": 3}), lambda _: None, lambda _: None, lambda _: None)
assert told.wait(20)
assert succeeded.wait(20)
feedback.unsubscribe()
status.unsubscribe()
print(json.dumps([topics, types, heard]))
sender.close()
watcher.terminate()
