"""`Tracing`: spans of goals for OpenTelemetry, at clients and at servers."""

from fibaction.observe.otel import (
    Tracing,
)

__all__ = [
    "Tracing",
]
