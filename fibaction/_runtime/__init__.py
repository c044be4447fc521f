"""Small parts below everything: the version, logs, texts, signals between tasks, threads."""

RELEASE = "0.1.0"
"""The version of this release, which servers tell their clients; `fibaction.__version__` is it."""
