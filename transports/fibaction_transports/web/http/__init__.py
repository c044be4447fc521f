"""HTTP and WebSocket for all web transports: requests, answers, handshake, files, problems."""
