"""One worker of a fleet: its lease, its goals at the brokers, and goals it takes over."""
