"""What the user types: URLs, names, goals, namespaces, modules, and their completion."""
