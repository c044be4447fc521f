"""The end of a process whose threads do not end."""

from __future__ import annotations

import logging
import os
import sys
from threading import Thread, Timer
from threading import enumerate as enumerate_threads
from typing import Self

from fibaction._runtime.log import clean_logger

logger = clean_logger(__name__)


class LastSeconds:
    """A block that ends the process if it does not end by itself soon after `begin()`.

    Python waits for threads at the end of the event loop and of the process. An executor may have
    started one that never ends, and the process was told to end.
    """

    def __init__(self, seconds: float, code: int) -> None:
        self._timer = Timer(seconds, end_now, [code])
        self._timer.daemon = True
        self._before: set[Thread] = set()

    def __enter__(self) -> Self:
        self._before.update(enumerate_threads())
        return self

    def begin(self) -> None:
        """Begin to count the seconds."""
        self._timer.start()

    def __exit__(self, *_: object) -> None:
        if all(thread.daemon for thread in set(enumerate_threads()) - self._before):
            self._timer.cancel()


def end_now(code: int) -> None:
    """End this process with that code, without waiting for threads and tasks."""
    logger.warning("this process ends without its threads and tasks that do not end")
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
