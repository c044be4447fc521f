"""Views of what happens to goals: metrics, monitor, recordings and replay, traces, log records."""
