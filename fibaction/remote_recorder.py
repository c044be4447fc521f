"""`record_from`: a recording of a server from outside, as one of its clients."""

from fibaction.observe.recordings.remote_recorder import (
    record_from,
)

__all__ = [
    "record_from",
]
