"""The REST interface: its paths, what each does, events, and its description."""
