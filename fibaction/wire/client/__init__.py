"""The client's half of the wire: connections, calls, goals and statuses from far away."""
