"""What the command prints: lines, JSON, YAML, tables, progress and the live screen."""
