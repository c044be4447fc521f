"""The process of the command: signals, log, exit codes, reload and its last seconds."""
