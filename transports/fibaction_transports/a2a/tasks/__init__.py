"""Goals as tasks of A2A: their skills, messages, updates and lists, and the consent of a user."""
