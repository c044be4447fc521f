"""`Metrics`: a watcher that counts for Prometheus what happens to goals."""

from fibaction.observe.metrics import (
    CONTENT_TYPE,
    Metrics,
)

__all__ = [
    "CONTENT_TYPE",
    "Metrics",
]
