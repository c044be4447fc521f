"""The file of a recording: JSON objects, one on a line, which a kill cannot spoil."""

from fibaction.observe.recordings.recording_file import (
    Event,
    Record,
    RecordingError,
    payload_of,
    read_records,
)

__all__ = [
    "Event",
    "Record",
    "RecordingError",
    "payload_of",
    "read_records",
]
