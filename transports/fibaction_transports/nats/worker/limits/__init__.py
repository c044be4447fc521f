"""Limits that all workers of a fleet have together: which of them may run a goal of a key next."""
