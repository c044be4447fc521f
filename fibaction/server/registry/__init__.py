"""The goals that a server knows, and the rules for each, without I/O."""
