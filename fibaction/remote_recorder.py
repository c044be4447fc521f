"""`record_from`: a recording of a server from outside, as one of its clients."""

from fibaction.observe.remote_recorder import (
    record_from,
)

__all__ = [
    "record_from",
]
