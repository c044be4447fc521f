"""Recordings of goals: written by a server or from outside, read, replayed and exported."""
