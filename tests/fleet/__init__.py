"""Workers and brokers of a fleet are killed and frozen, and every goal must end exactly once."""
