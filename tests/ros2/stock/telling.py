"""The other side of `process`: prints answers, and takes commands."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from threading import Thread
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException

LAST_WAIT = 1.0


def say(value: Any) -> None:
    print(json.dumps(value), flush=True)


def told() -> Iterator[dict[str, Any]]:
    """Yield the commands, until standard input ends."""
    for line in sys.stdin:
        yield json.loads(line)


def shut_down_at_the_end() -> None:
    """Shut rclpy down when standard input ends, while the main thread spins."""

    def wait() -> None:
        os.read(sys.stdin.fileno(), 1)
        rclpy.try_shutdown()

    Thread(target=wait, daemon=True).start()


def spin(executor: Any) -> None:
    """Spin until rclpy is shut down, in this thread or by a signal.

    rclpy looks whether it is up, and then makes its next wait set. If it is shut down in between,
    it raises an RCLError that says so, instead of ExternalShutdownException.
    """
    try:
        executor.spin()
    except ExternalShutdownException:
        pass
    except Exception:
        if executor.context.ok():
            raise


def leave(spinner: Thread, node: Any) -> None:
    """Leave the graph, so that the node does not seem alive, and end: rclpy may not stop."""
    rclpy.shutdown()
    spinner.join(LAST_WAIT)
    node.destroy_node()
    rclpy.get_default_context().destroy()
    os._exit(0)
