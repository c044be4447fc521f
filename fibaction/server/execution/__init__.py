"""Executors from their first step to their end: tasks, turns, interruption, watchdog."""
