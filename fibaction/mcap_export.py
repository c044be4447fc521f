"""`export_mcap`: a recording as an MCAP file, for Foxglove and other viewers."""

from fibaction.observe.recordings.mcap_export import (
    export_mcap,
)

__all__ = [
    "export_mcap",
]
