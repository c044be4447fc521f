"""The format of metrics that a request asks for, by the headers of programs that are about."""

from __future__ import annotations

import pytest

from fibaction.observe.metrics_formats import wants_openmetrics

PROMETHEUS = (
    "application/openmetrics-text;version=1.0.0;escaping=allow-utf-8;q=0.6,"
    "application/openmetrics-text;version=0.0.1;q=0.5,text/plain;version=1.0.0;q=0.4,"
    "text/plain;version=0.0.4;q=0.3,*/*;q=0.2"
)


@pytest.mark.parametrize(
    "accept",
    [
        PROMETHEUS,
        "application/openmetrics-text",
        'Application/OpenMetrics-Text; Version="1.0.0"',
        "text/plain;q=0.5, application/openmetrics-text",
        "text/plain, application/openmetrics-text",
    ],
)
def test_a_request_that_names_openmetrics_gets_it(accept: str) -> None:
    assert wants_openmetrics(accept)


def test_every_other_request_gets_the_format_of_prometheus() -> None:
    accepts = [
        *("", "*/*", ";;,=,", "text/plain;version=0.0.4"),
        "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8",
        "application/openmetrics-text;q=0.3, text/plain;q=0.5",
        "application/openmetrics-text;version=0.0.1",
        *(f"application/openmetrics-text;q={quality}" for quality in ("0", "high", "nan", "2")),
    ]
    assert [accept for accept in accepts if wants_openmetrics(accept)] == []
