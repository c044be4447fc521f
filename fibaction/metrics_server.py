"""`serve_metrics`: `/metrics`, `/healthz` and `/readyz` over HTTP, for Prometheus and
Kubernetes.
"""

from fibaction.observe.metrics_server import (
    serve_metrics,
)

__all__ = [
    "serve_metrics",
]
