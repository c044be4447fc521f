"""Lines of the wire protocol over messages of a broker."""
