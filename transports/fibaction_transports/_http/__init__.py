"""The HTTP server that all transports over HTTP have in common, and the requests of its clients."""
