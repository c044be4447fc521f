"""Shapes: the schemas of most types, prepared so that a value is checked and made in one pass."""
