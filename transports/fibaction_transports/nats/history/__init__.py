"""The history of a fleet: the goals that have ended, added by workers and read by clients."""
