"""Actions for web clients, over HTTP and WebSocket, and for clients of rosbridge.

The URLs are `http://host:port`, `ws://host:port` and, for clients of a robot with rosbridge,
`rosbridge://host:port`. `WebTransport` makes an ASGI application. All of them need the extra `web`.
"""

from fibaction.wire.transport import TlsFiles
from fibaction.words.extras import NeedsExtra

with NeedsExtra("fibaction_transports.web", "fibaction[web]"):
    from fibaction_transports.web.http_transport import HttpTransport
    from fibaction_transports.web.rosbridge_transport import RosbridgeTransport
    from fibaction_transports.web.web_transport import WebTransport
    from fibaction_transports.web.websocket_transport import WebSocketTransport

__all__ = [
    "HttpTransport",
    "RosbridgeTransport",
    "TlsFiles",
    "WebSocketTransport",
    "WebTransport",
]
