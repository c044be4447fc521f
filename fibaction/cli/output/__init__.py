"""The output of the command: lines, log, JSON, YAML, tables, progress and the live screen."""
