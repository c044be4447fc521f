"""The stores that keep goals beyond the life of a process: the interface, and one in a file."""
