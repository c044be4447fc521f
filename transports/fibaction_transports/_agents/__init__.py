"""The parts that transports for agents share: policy, actions, goals, and what requests get in."""
