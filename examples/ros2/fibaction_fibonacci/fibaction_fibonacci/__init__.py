"""A node that serves the Fibonacci action with fibaction."""
