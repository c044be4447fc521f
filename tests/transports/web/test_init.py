"""`fibaction_transports.web`: what others import."""

from __future__ import annotations

from fibaction.border import urls
from fibaction_transports.web import HttpTransport, WebSocketTransport


def test_the_schemes_lead_to_the_transport() -> None:
    assert isinstance(urls.transport_for("ws://"), WebSocketTransport)
    assert isinstance(urls.transport_for("wss://"), WebSocketTransport)
    assert isinstance(urls.transport_for("http://"), HttpTransport)
    assert isinstance(urls.transport_for("https://"), HttpTransport)
