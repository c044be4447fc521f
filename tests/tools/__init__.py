"""Programs about the project itself: its figures, and pictures of it."""
