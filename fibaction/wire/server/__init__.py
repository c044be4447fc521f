"""The server's half of the wire: one session for each client, its goals and its credit."""
