"""`replayed`: servers that answer goals as a recording has it, for tests without a robot."""

from fibaction.observe.recordings.replay import (
    RecordingError,
    replayed,
)

__all__ = [
    "RecordingError",
    "replayed",
]
