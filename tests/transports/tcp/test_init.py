"""`fibaction_transports.tcp`: what others import."""

from __future__ import annotations

from fibaction.border import urls
from fibaction_transports.tcp import TcpTransport, UnixTransport


def test_the_schemes_lead_to_the_transports() -> None:
    assert isinstance(urls.transport_for("tcp://"), TcpTransport)
    assert isinstance(urls.transport_for("tls://"), TcpTransport)
    assert isinstance(urls.transport_for("unix:///run/x"), UnixTransport)
