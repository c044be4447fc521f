"""`ws://host:port` and `wss://host:port`: actions over WebSocket."""

from fibaction.wire.tls_files import TlsFiles
from fibaction_transports.web.websocket_transport import WebSocketTransport

__all__ = ["TlsFiles", "WebSocketTransport"]
