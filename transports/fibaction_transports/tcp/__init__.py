"""`tcp://host:port`, `tls://host:port` and `unix:///path`: actions across processes."""

from fibaction.wire.tls_files import TlsFiles
from fibaction_transports.tcp.tcp_transport import TcpTransport, UnixTransport

__all__ = ["TcpTransport", "TlsFiles", "UnixTransport"]
