"""The messages of a node over DDS: their types, and how values become bytes."""
