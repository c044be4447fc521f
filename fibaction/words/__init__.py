"""The words of an action: statuses and their table, goals and outcomes, errors, meta."""
