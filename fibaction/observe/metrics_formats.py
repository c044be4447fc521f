"""The text formats of metrics, and which one a request asks for by its header `Accept`."""

from __future__ import annotations

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""The content type of the text format of Prometheus."""
OPENMETRICS_CONTENT_TYPE = "application/openmetrics-text; version=1.0.0; charset=utf-8"
"""The content type of OpenMetrics."""

_OPENMETRICS = "application/openmetrics-text"
_PLAIN = "text/plain"


def wants_openmetrics(accept: str) -> bool:
    """Return whether a request with this header asks for OpenMetrics.

    It does if it names that format, in version 1.0.0 or in any, and does not prefer plain text. A
    wildcard names no format.
    """
    weights = {_OPENMETRICS: 0.0, _PLAIN: 0.0}
    for one in accept.lower().split(","):
        kind, *parameters = (part.strip() for part in one.split(";"))
        given: dict[str, str] = {}
        for part in parameters:
            name, _, value = part.partition("=")
            given[name] = value
        is_other = kind == _OPENMETRICS and given.get("version", "1.0.0").strip('"') != "1.0.0"
        if kind in weights and not is_other:
            weights[kind] = max(weights[kind], _weight_of(given.get("q", "1")))
    return weights[_OPENMETRICS] > 0 and weights[_OPENMETRICS] >= weights[_PLAIN]


def _weight_of(text: str) -> float:
    """Return a weight between 0 and 1; 0 if the text is not one."""
    try:
        weight = float(text)
    except ValueError:
        return 0.0
    return weight if 0 <= weight <= 1 else 0.0
