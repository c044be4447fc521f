"""A provider of spans whose spans are read back from memory."""

from __future__ import annotations

from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from fibaction.observe.otel import Tracing


class Spans:
    """A provider, a tracer for the test's own spans, and the spans that have ended."""

    def __init__(self) -> None:
        self._exporter = InMemorySpanExporter()
        self.provider = TracerProvider(shutdown_on_exit=False)
        self.provider.add_span_processor(SimpleSpanProcessor(self._exporter))
        self.tracer = self.provider.get_tracer("test")
        self.tracing = Tracing(self.provider)

    @property
    def ended(self) -> list[ReadableSpan]:
        """The spans that have ended, in the order of their ends."""
        return list(self._exporter.get_finished_spans())

    def named(self, name: str) -> ReadableSpan:
        """Return the one span that has this label."""
        (found,) = (span for span in self.ended if label(span) == name)
        return found

    def path(self, name: str) -> list[str]:
        """Return the labels of a span and of the spans above it, of one trace, from the top."""
        span: ReadableSpan | None = self.named(name)
        assert span is not None
        by_id = {one.context.span_id: one for one in self.ended}
        labels: list[str] = []
        while span is not None:
            labels.insert(0, label(span))
            above = None if span.parent is None else by_id[span.parent.span_id]
            assert above is None or above.context.trace_id == span.context.trace_id
            span = above
        return labels


def label(span: ReadableSpan) -> str:
    """Return the name of a span, with its kind for those of goals."""
    return f"{span.kind.name}: {span.name}" if span.name.startswith("goal ") else span.name
