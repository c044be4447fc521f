"""The store that keeps goals in a file, beyond the life of a process."""
