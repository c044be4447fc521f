"""The version of this release, which servers tell their clients; `fibaction.__version__` is it."""

RELEASE = "0.1.0"
