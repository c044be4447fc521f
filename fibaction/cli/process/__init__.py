"""The process of the command: signals, exit codes, reload and its last seconds."""
