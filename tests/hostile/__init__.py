"""Hostile clients: attacks on a real server, and what each may cost the others."""
