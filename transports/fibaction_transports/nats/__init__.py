"""`nats://`: a fleet of workers behind brokers of NATS."""
