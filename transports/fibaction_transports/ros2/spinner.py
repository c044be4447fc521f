"""The thread that spins a node of fibaction's own."""

from __future__ import annotations

import atexit
import threading
from collections.abc import Callable
from typing import Any

from fibaction._log import clean_logger
from fibaction.exceptions import text_of
from fibaction_transports.ros2.rcl import (
    ExternalShutdownException,
    Future,
    SingleThreadedExecutor,
)

logger = clean_logger("fibaction.ros2")


class Spinner:
    """A thread that spins a node."""

    def __init__(self, node: Any, context: Any, on_end: Callable[[str], None]) -> None:
        """`on_end` is called in the thread, with the reason, if it ends before `stop`."""
        self._on_end = on_end
        self._context = context
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(node)
        self._stop = Future()
        # A daemon, because Python waits for other threads before it ends. A program that ends
        # while C++ waits in this thread would crash, so `stop` is also called at exit.
        self._thread = threading.Thread(target=self._run, name="fibaction-ros2", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        atexit.register(self.stop)
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread, and wait for it, which takes a moment. A second call does nothing."""
        atexit.unregister(self.stop)
        if not self._stop.done():
            self._stop.set_result(None)
            self._thread.join()
            self._executor.shutdown()

    def _run(self) -> None:
        reason = "rclpy was shut down"
        try:
            self._executor.spin_until_future_complete(self._stop)
        except ExternalShutdownException:
            pass
        except BaseException as exc:
            # rclpy looks whether ROS is up, and then makes its next wait set. If ROS is shut down
            # in between, rclpy raises whatever rcl says. With rclpy's own handlers of signals,
            # Ctrl-C shuts down all contexts of the process, and this one, too.
            if self._context.ok():
                reason = f"the thread of rclpy has ended: {text_of(exc)}"
                logger.error("%s", reason, exc_info=exc)
        if not self._stop.done():
            self._on_end(reason)
