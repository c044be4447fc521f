"""The durability of goals: what a server writes to its store, and what it does without one."""
