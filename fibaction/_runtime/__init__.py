"""Small parts below everything: logs, texts, signals between tasks, threads."""
