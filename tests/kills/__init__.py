"""A server that keeps its goals is killed at random moments, and its clients must not notice."""
