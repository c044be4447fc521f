"""Soaks: fifty connections with goals of all kinds, for some minutes, between two processes."""
