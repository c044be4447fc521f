"""The decision on a goal that a client sends: accepted or rejected, and why."""
