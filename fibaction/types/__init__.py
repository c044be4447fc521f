"""An action: its name, the types of its messages, and how their values become bytes."""
