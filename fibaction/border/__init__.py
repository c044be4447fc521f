"""The interfaces that an author of a transport, a store or a watcher implements or calls."""
