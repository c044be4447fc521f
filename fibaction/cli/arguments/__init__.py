"""The words that a user types: URLs, names, goals, namespaces, modules, and their completion."""
