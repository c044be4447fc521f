"""`Recorder`: a watcher that writes everything that happens to goals to a file."""

from fibaction.observe.recordings.recorder import (
    Recorder,
)

__all__ = [
    "Recorder",
]
