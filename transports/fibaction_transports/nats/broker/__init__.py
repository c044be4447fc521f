"""One connection to brokers of NATS: login, messages, JetStream."""
