"""`tcp://host:port`, `tls://host:port` and `unix:///path`: actions across processes."""

from fibaction_transports.tcp.tls import TlsFiles
from fibaction_transports.tcp.transport import TcpTransport, UnixTransport

__all__ = ["TcpTransport", "TlsFiles", "UnixTransport"]
