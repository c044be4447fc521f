"""The parts that transports for agents share: the policy, the actions, and their HTTP server."""
