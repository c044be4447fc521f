"""The client's half of a fleet: which worker gets a goal, and where a goal is now."""
