"""The parts that transports for agents share: policy, actions, goals, and the HTTP server."""
