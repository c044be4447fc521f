"""The output of the command: lines, JSON, YAML, tables, progress and the live screen."""
